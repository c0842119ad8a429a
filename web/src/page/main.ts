// The page that the service serves at `/`: puts its parts together.
import {
  connect,
  mapRef,
  ownError,
  PointsError,
  ServiceError,
  type MapInfo,
  type Problem,
} from "visloc-client";
import { button, byId, element } from "../dom";
import { NoGraphics } from "../viewer/graphics";
import type { Viewer } from "../viewer/types";
import { createViewer } from "../viewer/viewer";
import type { PageContext } from "./context";
import { takePhotos } from "./intake";
import { createKeyEntry } from "./key";
import { createLive } from "./live";
import { createMapChoice, hashOf, type Choice } from "./map_choice";
import { loadMap } from "./map_loading";
import { createMapPanel } from "./map_panel";
import { patiently } from "./patience";
import { createPhotoPanel } from "./photo_panel";
import { problemView, sentence } from "./problem_view";
import { sharedPose } from "./share";
import { createTabs } from "./tabs";
import { createTheme } from "./theme";
import { withoutView } from "./without_view";
import { counted, shortRef } from "../words";
import "../style/tokens.css";
import "../style/base.css";
import "../style/page.css";

// Also where a proxy serves the page below another path.
const server = new URL(".", location.href);
server.search = server.hash = "";

const announcer = byId("announcer", HTMLElement);
const announce = (text: string): void => void (announcer.textContent = text);
const key = createKeyEntry(byId("key", HTMLButtonElement));
// Without a limit of its own: a photo over a slow line takes its time.
const service = connect(server, { apiKey: key.current, timeoutSeconds: null });
const theme = createTheme(byId("theme", HTMLSelectElement));
const viewer = openViewer(byId("viewer", HTMLElement));
const tabs = createTabs(document.querySelector<HTMLElement>("#panel > .tabs")!);

const mapPanel = createMapPanel(byId("panel-map", HTMLElement), viewer, theme.current());
theme.onChange((now) => {
  viewer.setTheme(now);
  mapPanel.setTheme(now);
});

// As a link it would replace the map in the address.
document.querySelector(".skip")!.addEventListener("click", (event) => {
  event.preventDefault();
  byId("panel", HTMLElement).focus();
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
  maps: () => choice.maps,
  hasKey: () => key.current() !== null,
  askForKey,
  chooseMap: (ref) => choice.choose(ref),
  reloadMaps,
  open: () => tabs.choose("tab-photo"),
  beforeDrawing: () => live.stop("Stopped: a photo is being looked at."),
  linkLeft() {
    if (shownMap !== null) history.replaceState(null, "", hashOf(shortRef(shownMap)));
  },
});
takePhotos(byId("drop", HTMLElement), photos.add);

const context: PageContext = {
  ...{ service, viewer, announce },
  map: () => shownMap,
  camera: photos.camera,
  options: photos.options,
  walkBegins: photos.undraw,
  onMapChange: (listener) => void mapListeners.push(listener),
};
const live = createLive(byId("panel-live", HTMLElement), context);

const choice = createMapChoice(byId("map", HTMLSelectElement), service, choose);
key.onChange(() => {
  choice.reload();
  photos.keyChanged();
});
choice.reload();

/** A link to a pose shows it. */
function openLink(): void {
  const pose = sharedPose(location.hash);
  if (pose !== null) photos.showShared(pose);
}
addEventListener("hashchange", openLink);
openLink();

/** Where the browser cannot draw, the page does without a view. */
function openViewer(host: HTMLElement): Viewer {
  try {
    return createViewer(host, theme.current());
  } catch (error) {
    if (!(error instanceof NoGraphics)) throw error;
    return withoutView(host, `${error.message} Photos and Live work without.`);
  }
}

function askForKey(problem: Problem): void {
  key.ask(sentence(problem.detail));
}

function reloadMaps(): void {
  choice.reload();
}

/** A map that cannot be shown is told of in its tab, whichever is open. */
function tellOfMap(error: ServiceError, again: () => void): HTMLElement {
  mapProblem = error.problem;
  tabs.choose("tab-map");
  announce(error.problem.detail);
  return problemView(error, { giveKey: () => askForKey(error.problem), reloadMaps, again });
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
  mapPanel.showInstead(tellOfMap(chosen.error, reloadMaps));
  if (chosen.error.problem.status === 401) askForKey(chosen.error.problem);
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
    await loadMap(map, patiently(service), viewer, {
      signal,
      // What was drawn of a photo is gone with the map before.
      onReset: photos.mapChanged,
      onImages: mapPanel.showImages,
      onBlock(block, loaded) {
        progress.max = block.total;
        progress.value = loaded;
        mapPanel.showBlock(block, loaded);
        if (block.first === 0) photos.mapDrawn();
      },
      onEnd: (loaded, total) => mapPanel.showEnd(loaded, total),
    });
    photos.mapDrawn();
  } catch (error) {
    if (signal.aborted) return;
    const again = (): void => {
      setMap(null);
      void show(map);
    };
    mapPanel.showProblem(tellOfMap(errorOfLoading(error), again));
  }
  progress.hidden = true;
}

function setMap(map: MapInfo | null): void {
  shownMap = map;
  wholeMap.disabled = map === null;
  document.title = map === null ? "visloc" : `${map.id} · visloc`;
  if (map === null) {
    viewer.reset({ origin: [0, 0, 0], up: [0, 0, 1], metric: true });
    photos.mapChanged();
  }
  for (const listener of mapListeners) listener(map);
}

function errorOfLoading(error: unknown): ServiceError {
  if (error instanceof ServiceError) return error;
  if (!(error instanceof PointsError)) throw error;
  return ownError("server.answer", "No landmarks", error.message);
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
    element("div", { class: "row" }, button("Look again", reloadMaps)),
  );
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
