// The tab "Map": what the map is, and how it is shown.
import type { MapImages, MapInfo, PointBlock, Vector3 } from "visloc-client";
import { element, facts, field } from "../dom";
import { lengthText } from "../geometry";
import { MAX_POINTS } from "../points";
import { PALETTES, SEEN_BY_MOST } from "../viewer/themes";
import type { PointColours, Theme, Viewer } from "../viewer/types";
import { MAX_IMAGES, shownTiles } from "./map_loading";
import { bytesText, counted, countText, instantText, shortRef } from "../words";

export interface MapPanel {
  /** Something else than a map: why there is none. */
  showInstead(content: Node): void;
  showMap(map: MapInfo): void;
  showBlock(block: PointBlock, loaded: number): void;
  /** No more landmarks come. */
  showEnd(loaded: number, total: number): void;
  showImages(images: MapImages): void;
  /** Below the facts: what could not be loaded. */
  showProblem(problem: Node): void;
  setTheme(theme: Theme): void;
}

export function createMapPanel(host: HTMLElement, viewer: Viewer, theme: Theme): MapPanel {
  const about = element("div", { class: "stack" });
  const numbers = element("div");
  const problems = element("div", { class: "stack" });
  const progress = element("p", { class: "quiet small number" });
  const camerasNote = element("p", { class: "quiet small" });
  const looks = element("div", { class: "stack" });

  const photo = radio("colours", "photo", "Colours of the photos");
  const seenBy = radio("colours", "seen_by", "Number of photos that see them");
  const noColours = element("span", { class: "quiet", hidden: true }, "(this map keeps none)");
  photo.label.append(noColours);
  const legend = element("div", { class: "legend", hidden: true });
  const legendScale = element("div", { class: "legend-scale", role: "img" });
  legendScale.setAttribute("aria-label", `Colours from 1 to ${SEEN_BY_MOST} photos or more`);
  // Where the four colours are: by the logarithm of the number.
  const ticks = [0, 1, 2, 3].map((i) => Math.round(SEEN_BY_MOST ** (i / 3)));
  legend.append(
    legendScale,
    element(
      "div",
      { class: "legend-ticks number" },
      ...ticks.map((n, i) => element("span", {}, i < 3 ? `${n}` : `${n}+`)),
    ),
  );
  paintLegend(legendScale, theme);
  /** What the user said last; a map without colours does not change it. */
  let preferred: PointColours = "photo";
  const showColours = (by: PointColours): void => {
    (by === "photo" ? photo : seenBy).input.checked = true;
    legend.hidden = by === "photo";
    viewer.setPointColours(by);
  };
  for (const { input } of [photo, seenBy]) {
    input.addEventListener("change", () => {
      preferred = input.value as PointColours;
      showColours(preferred);
    });
  }

  const size = element("input", { id: "point-size", type: "range", min: 1, max: 6, step: 0.5 });
  size.value = "2";
  size.addEventListener("input", () => viewer.setPointSize(Number(size.value)));
  const cameras = element("input", { type: "checkbox", checked: true });
  cameras.addEventListener("change", () => viewer.showMappingCameras(cameras.checked));
  looks.append(
    element(
      "fieldset",
      { class: "stack near" },
      element("legend", {}, "Landmarks"),
      photo.label,
      seenBy.label,
      legend,
    ),
    field("Size of the points", size),
    element("label", { class: "check" }, cameras, "Mapping cameras"),
    camerasNote,
  );

  let shown: MapInfo | null = null;
  /** How large the map is can be said only once its landmarks or cameras have come. */
  const showFacts = (): void => {
    if (shown !== null) numbers.replaceChildren(mapFacts(shown, viewer.extent));
  };

  /** The button that had the focus, such as "Ask again", may be gone then: it stays in the tab. */
  function fill(content: Node): void {
    const focused = host.contains(document.activeElement);
    problems.replaceChildren();
    host.replaceChildren(content);
    if (focused) host.focus();
  }

  return {
    showInstead: fill,
    showMap(map) {
      shown = map;
      numbers.replaceChildren(mapFacts(map, null));
      about.replaceChildren(
        element("h2", {}, map.id),
        element("p", {}, "Drop or paste a photo anywhere to see where it was taken."),
        ...map.doubts.map(({ message }) =>
          element("p", { class: "note" }, `What speaks against this map: ${message}.`),
        ),
        numbers,
        element("p", { class: "quiet small", hidden: shownTiles(map) === "" }, shownTiles(map)),
        element(
          "p",
          { class: "quiet small" },
          "Where would a photo be localized, and where not? Where the service runs: ",
          element("code", {}, `mapping report ${shortRef(map)}`),
        ),
      );
      say(camerasNote, "");
      say(
        progress,
        map.landmarks === 0 ? "This map has no landmarks: no photo can be localized in it." : "",
      );
      fill(element("div", { class: "stack" }, about, progress, problems, looks));
      // What was chosen is chosen for this map too.
      showColours(preferred);
      photo.input.disabled = false;
      noColours.hidden = true;
      viewer.setPointSize(Number(size.value));
      viewer.showMappingCameras(cameras.checked);
    },
    showBlock(block, loaded) {
      if (block.first === 0) showFacts();
      if (!block.coloured && noColours.hidden) {
        noColours.hidden = false;
        photo.input.disabled = true;
        showColours("seen_by");
      }
      const all = Math.min(block.total, MAX_POINTS);
      if (loaded < all)
        say(progress, `${countText(loaded)} of ${counted(all, "landmark")} are here`);
      else this.showEnd(all, block.total);
    },
    showEnd(loaded, total) {
      const sample = `An even sample of ${countText(loaded)} landmarks is shown`;
      say(progress, loaded < total ? sample : "");
    },
    showImages(images) {
      showFacts();
      if (images.total > MAX_IMAGES) {
        say(camerasNote, `The first ${countText(images.images.length)} are shown.`);
      }
    },
    showProblem(problem) {
      problems.replaceChildren(problem);
    },
    setTheme(now) {
      paintLegend(legendScale, now);
    },
  };

  function radio(name: string, value: string, text: string) {
    const input = element("input", { type: "radio", name, value });
    return { input, label: element("label", { class: "check" }, input, text) };
  }
}

/** An empty line takes no room. */
function say(line: HTMLElement, text: string): void {
  line.textContent = text;
  line.hidden = text === "";
}

function paintLegend(scale: HTMLElement, theme: Theme): void {
  scale.style.backgroundImage = `linear-gradient(to right, ${PALETTES[theme].seenBy.join(", ")})`;
}

function mapFacts(map: MapInfo, extent: Vector3 | null): HTMLElement {
  const rows: [string, string][] = [
    ["Photos", countText(map.images)],
    ["Landmarks", countText(map.landmarks)],
  ];
  if (map.observations !== null) rows.push(["Observations", countText(map.observations)]);
  if (map.kind === "set") rows.unshift(["Maps in it", countText(map.tiles.length)]);
  if (extent !== null) {
    const sides = extent.map((side) => lengthText(side, map.metric)).join(" × ");
    const name = shownTiles(map) === "" ? "Extent" : "Extent shown";
    const unit = map.metric ? "" : " (not metric)";
    rows.push([name, `${sides}${unit}, cameras included, without the outermost landmarks`]);
  }
  if (map.own_test !== null) {
    const { tested, localized, wrong } = map.own_test;
    const words = `${countText(localized - wrong)} of ${counted(tested, "photo")} came back where they were`;
    rows.push(["Own test", wrong === 0 ? words : `${words}, ${countText(wrong)} elsewhere`]);
  }
  if (map.pieces.length > 0) {
    const pieces = map.pieces.map((ref) => ref.split("@")[0]).join(", ");
    rows.push(["Other pieces", `${pieces}: photos that nothing links to these`]);
  }
  if (map.place !== null) {
    const { latitude, longitude } = map.place;
    rows.push(["On Earth", `around ${latitude.toFixed(5)}, ${longitude.toFixed(5)}`]);
  }
  rows.push(
    ...(map.method === null ? [] : [["Method", map.method] as [string, string]]),
    ["Features", [map.local_features, ...map.global_features].join(", ")],
    ["Created", instantText(map.created)],
    ["Version", map.current ? map.version : `${map.version}, not current`],
    ["Size", bytesText(map.size_bytes)],
  );
  return facts(rows);
}
