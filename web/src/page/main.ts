// The page that the service serves at `/`: puts its parts together.
import { connect, mapRef, ServiceError, type MapInfo, type Problem } from "../api";
import { button, byId, element } from "../dom";
import { PointsError } from "../points";
import { createViewer } from "../viewer/viewer";
import type { PageContext } from "./context";
import { takePhotos } from "./intake";
import { createKeyEntry } from "./key";
import { createLive } from "./live";
import { createMapChoice, type Choice } from "./map_choice";
import { loadMap } from "./map_loading";
import { createMapPanel } from "./map_panel";
import { createPhotoPanel } from "./photo_panel";
import { problemView } from "./problem_view";
import { createTabs } from "./tabs";
import { createTheme } from "./theme";
import { counted } from "./words";
import "../style/tokens.css";
import "../style/base.css";
import "../style/page.css";

// Also where a proxy serves the page below another path.
const server = new URL(".", location.href);
server.search = server.hash = "";

const announcer = byId("announcer", HTMLElement);
const announce = (text: string): void => void (announcer.textContent = text);
const key = createKeyEntry(byId("key", HTMLButtonElement));
const service = connect(server, key.current);
const theme = createTheme(byId("theme", HTMLSelectElement));
const viewer = createViewer(byId("viewer", HTMLElement), theme.current());
const tabs = createTabs(document.querySelector<HTMLElement>("#panel > .tabs")!);

const mapPanel = createMapPanel(byId("panel-map", HTMLElement), viewer, theme.current());
theme.onChange((now) => {
  viewer.setTheme(now);
  mapPanel.setTheme(now);
});

const wholeMap = byId("whole-map", HTMLButtonElement);
wholeMap.addEventListener("click", () => viewer.overview());
const progress = byId("loading", HTMLProgressElement);

let shownMap: MapInfo | null = null;
let mapProblem: Problem | null = null;
let loading = new AbortController();
const mapListeners: ((map: MapInfo | null) => void)[] = [];

const photos = createPhotoPanel(byId("panel-photo", HTMLElement), {
  ...{ service, server, viewer, announce },
  map: () => shownMap,
  hasKey: () => key.current() !== null,
  askForKey,
  open: () => tabs.choose("tab-photo"),
});
takePhotos(byId("drop", HTMLElement), photos.add);

const context: PageContext = {
  ...{ service, viewer, announce },
  map: () => shownMap,
  camera: photos.camera,
  options: photos.options,
  onMapChange: (listener) => void mapListeners.push(listener),
};
const live = createLive(byId("panel-live", HTMLElement), context);

const choice = createMapChoice(byId("map", HTMLSelectElement), service, choose);
key.onChange(() => {
  choice.reload();
  photos.keyChanged();
});
choice.reload();

function askForKey(): void {
  key.ask("The service answers only those who send an API key.");
}

function choose(chosen: Choice): void {
  mapProblem = null;
  if (chosen.kind === "asking") return;
  if (chosen.kind === "map") {
    void show(chosen.map);
    return;
  }
  loading.abort();
  progress.hidden = true;
  setMap(null);
  if (chosen.kind === "no_maps") {
    mapPanel.showInstead(noMaps());
    announce("There are no maps yet");
    return;
  }
  mapProblem = chosen.error.problem;
  mapPanel.showInstead(
    problemView(chosen.error, { giveKey: askForKey, again: () => choice.reload() }),
  );
  announce(chosen.error.problem.detail);
  if (chosen.error.problem.status === 401) askForKey();
}

async function show(map: MapInfo): Promise<void> {
  if (shownMap !== null && mapRef(map) === mapRef(shownMap)) return;
  loading.abort();
  const { signal } = (loading = new AbortController());
  setMap(map);
  mapPanel.showMap(map);
  announce(`Map ${map.id}, ${counted(map.landmarks, "landmark")}`);
  progress.hidden = false;
  progress.value = 0;
  try {
    await loadMap(map, service, viewer, {
      signal,
      // What was drawn of a photo is gone with the map before.
      onReset: photos.mapChanged,
      onImages: mapPanel.showImages,
      onBlock(block, loaded) {
        progress.max = block.total;
        progress.value = loaded;
        mapPanel.showBlock(block, loaded);
      },
    });
  } catch (error) {
    if (signal.aborted) return;
    const shown = errorOfLoading(error);
    mapProblem = shown.problem;
    const again = (): void => {
      setMap(null);
      void show(map);
    };
    mapPanel.showProblem(problemView(shown, { giveKey: askForKey, again }));
    announce(shown.problem.detail);
  }
  progress.hidden = true;
}

function setMap(map: MapInfo | null): void {
  shownMap = map;
  wholeMap.disabled = map === null;
  document.title = map === null ? "visloc" : `${map.id} · visloc`;
  if (map === null) viewer.reset({ origin: [0, 0, 0], up: [0, 0, 1], metric: true });
  for (const listener of mapListeners) listener(map);
}

function errorOfLoading(error: unknown): ServiceError {
  if (error instanceof ServiceError) return error;
  if (!(error instanceof PointsError)) throw error;
  return new ServiceError({
    ...{ title: "No landmarks", status: 0, detail: error.message, code: "server.answer" },
    ...{ field: null, expected: null, got: null, request_id: "" },
  });
}

function noMaps(): HTMLElement {
  return element(
    "div",
    { class: "stack" },
    element("h2", {}, "No maps yet"),
    element("p", {}, "A map is made of photos, where the service runs:"),
    element("pre", { tabindex: 0 }, "mapping build DATASET --map kitchen --maps-dir maps"),
    element(
      "p",
      { class: "quiet" },
      "A service that watches the folder shows it as soon as it is made.",
    ),
    element("div", { class: "row" }, reloadButton()),
  );
}

function reloadButton(): HTMLButtonElement {
  return button("Look again", () => choice.reload());
}

/** What tests, and those who look for a fault, may read; nothing can be changed here. */
const state = Object.freeze({
  get map() {
    return shownMap;
  },
  get answer() {
    return photos.answer;
  },
  get problem() {
    return photos.problem ?? mapProblem;
  },
  get view() {
    return viewer.viewpoint;
  },
  get statistics() {
    return viewer.statistics;
  },
  get live() {
    return live.state;
  },
});
Object.defineProperty(window, "visloc", { value: state });
