// The map in 3D, by the viewer of the service's page.
import { element } from "../dom";
import { NoGraphics } from "../viewer/graphics";
import { createViewer } from "../viewer/viewer";
import type { PointBlock } from "visloc-client";
import type { CoverageArrow, Theme, Viewer } from "../viewer/types";
import type { ReportData } from "./data";
import { directionOf, orientationOf } from "./plan";

export interface Scene {
  /** Look from a place along a heading. */
  visit(spot: { position: [number, number, number]; direction_deg: number }): void;
  /** Arrows of one direction, or of all. */
  showDirection(direction: number | null): void;
}

/** Fill `host`; null where the browser has no WebGL, which `host` then says. */
export function createScene(host: HTMLElement, data: ReportData, block: PointBlock): Scene | null {
  const { coverage } = data;
  const stage = element("div", { class: "stage" });
  const dark = matchMedia("(prefers-color-scheme: dark)");
  const theme = (): Theme => (dark.matches ? "dark" : "light");
  let viewer: Viewer;
  try {
    viewer = createViewer(stage, theme());
  } catch (error) {
    if (!(error instanceof NoGraphics)) throw error;
    const text = `${error.message} The plan and the tables have all of the numbers.`;
    host.replaceChildren(element("p", { class: "note" }, text));
    return null;
  }
  let direction: number | null = null;
  let arrowsShown = true;

  const arrows = (): CoverageArrow[] =>
    coverage.cells.flatMap((cell) =>
      coverage.directions_deg.flatMap((heading, index) =>
        direction === null || direction === index
          ? [
              {
                position: cell.position,
                direction: directionOf(coverage, heading),
                probability: cell.probability[index] ?? 0,
              },
            ]
          : [],
      ),
    );
  const drawArrows = () => viewer.setCoverage(arrowsShown ? arrows() : []);

  const box = (label: string, checked: boolean, change: (on: boolean) => void) => {
    const input = element("input", { type: "checkbox", checked });
    input.addEventListener("change", () => change(input.checked));
    return element("label", { class: "choice" }, input, label);
  };
  const whole = element("button", { type: "button" }, "Whole map");
  whole.addEventListener("click", () => viewer.overview());
  host.replaceChildren(
    element(
      "div",
      { class: "controls" },
      whole,
      box("Chances as arrows", true, (on) => {
        arrowsShown = on;
        drawArrows();
      }),
      box("Mapping photos", true, (on) => viewer.showMappingCameras(on)),
      ...(block.coloured
        ? [
            box("Colours of the photos", true, (on) =>
              viewer.setPointColours(on ? "photo" : "seen_by"),
            ),
          ]
        : []),
    ),
    stage,
  );

  viewer.reset({ origin: block.origin, up: data.up.direction, metric: data.map.metric });
  viewer.addPoints(block);
  viewer.setPointColours(block.coloured ? "photo" : "seen_by");
  viewer.setMappingCameras(data.images, data.cameras);
  drawArrows();
  viewer.overview();
  dark.addEventListener("change", () => viewer.setTheme(theme()));
  return {
    visit: (spot) => {
      viewer.flyTo({
        position: spot.position,
        orientation: orientationOf(coverage, spot.direction_deg),
        camera: coverage.camera,
      });
    },
    showDirection: (chosen) => {
      direction = chosen;
      drawArrows();
    },
  };
}
