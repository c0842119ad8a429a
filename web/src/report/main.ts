// The page that `mapping report` writes: what a map is worth, where, and looking which way.
import "../style/tokens.css";
import "../style/report.css";
import { element } from "../dom";
import { parsePoints, type PointBlock } from "visloc-client";
import { bytesText, countText } from "../words";
import { histogramChart } from "./charts";
import type { ReportData } from "./data";
import { coverageSection } from "./coverage";
import { aboutSection } from "./about";
import { onPlan } from "./plan";
import { createScene } from "./scene";
import { trials } from "./trials";
import {
  kindestRuns,
  percent,
  sharesOfChance,
  succeeded,
  verdict,
  lookAlikesInWords,
} from "./words";

function main(): void {
  const data = JSON.parse(document.getElementById("report")?.textContent ?? "") as ReportData;
  const block = parsePoints(bytesOf(data.points));
  const landmarks = placesOf(block).map((place) => onPlan(data.coverage, place));

  const stage = element("div", { class: "scene" });
  let scene: ReturnType<typeof createScene> = null;
  const coverage = coverageSection(data, landmarks, {
    visit: (spot) => {
      stage.scrollIntoView({ block: "center" });
      scene?.visit(spot);
    },
    chooseDirection: (direction) => scene?.showDirection(direction),
  });
  document.body.append(
    element("header", {}, ...heading(data)),
    element(
      "main",
      {},
      section("Coverage", ...coverage.nodes),
      section("In 3D", stage),
      section("Held-out trials", ...trials(data)),
      section("Places that look alike", lookAlikes(data)),
      section("The map in numbers", statistics(data)),
      section("How this was computed", ...aboutSection(data)),
    ),
  );
  coverage.ready();
  scene = createScene(stage, data, block);
}

function section(title: string, ...children: (Node | string)[]): HTMLElement {
  return element("section", {}, element("h2", {}, title), ...children);
}

function heading(data: ReportData): HTMLElement[] {
  const { map, coverage } = data;
  const kindest = kindestRuns(data.held_out);
  const good = kindest.filter((run) => succeeded(run, coverage.within)).length;
  const shares = sharesOfChance(coverage);
  const figures: [string, string][] = [
    [countText(map.images), "mapping photos"],
    [countText(map.landmarks), "landmarks"],
    [
      kindest.length > 0 ? percent(good / kindest.length) : "–",
      "of photos localized without themselves",
    ],
    [percent(shares[0] ?? 0), "of places and directions with 90 % chance or more"],
    [percent(shares[3] ?? 0), "of them with less than 10 %"],
  ];
  return [
    element("p", { class: "kind" }, "Coverage report of a map"),
    element("h1", {}, map.id),
    element("p", { class: "verdict" }, ...verdict(data).flatMap((one) => [one, " "])),
    element(
      "dl",
      { class: "figures" },
      ...figures.map(([value, name]) =>
        element("div", {}, element("dt", {}, name), element("dd", {}, value)),
      ),
    ),
    element(
      "p",
      { class: "note" },
      `${map.id}@${map.version}, made ${map.created.slice(0, 10)} by ${map.method} of ` +
        `${map.local_features} and ${map.global_features.join(", ")}; ` +
        `${countText(map.observations)} observations, ${bytesText(map.size_bytes)}` +
        (map.metric ? "." : "; not metric: lengths are in units of its own."),
    ),
    element("p", { class: "note" }, `Cameras: ${map.cameras.join("; ")}.`),
    ...map.notes.map((text) => element("p", { class: "note" }, `Note: ${text}`)),
  ];
}

function lookAlikes({ look_alikes: pairs, look_alikes_asked: asked }: ReportData): HTMLElement {
  if (pairs.length > 0) {
    return element("ul", {}, ...pairs.map(({ told }) => element("li", {}, told)));
  }
  return element("p", {}, lookAlikesInWords(asked));
}

function statistics({ statistics: all }: ReportData): HTMLElement {
  const charts = [
    histogramChart(all.track_length, "Photos that see a landmark.", "photos", "landmarks", true),
    histogramChart(
      all.landmarks_per_image,
      "Landmarks that a photo sees.",
      "landmarks",
      "photos",
      true,
    ),
  ];
  if (all.error_px) {
    charts.push(histogramChart(all.error_px, "Reprojection error.", "pixels", "landmarks"));
  }
  if (all.angle_deg) {
    charts.push(histogramChart(all.angle_deg, "Angle between rays.", "degrees", "landmarks"));
  }
  return element("div", { class: "charts" }, ...charts);
}

function bytesOf(base64: string): ArrayBuffer {
  const text = atob(base64);
  const made = new Uint8Array(text.length);
  for (let index = 0; index < text.length; index += 1) made[index] = text.charCodeAt(index);
  return made.buffer;
}

function placesOf(block: PointBlock): [number, number, number][] {
  const view = new DataView(block.rows);
  const [x, y, z] = block.origin;
  return Array.from({ length: block.count }, (_, row) => [
    x + view.getFloat32(16 * row, true),
    y + view.getFloat32(16 * row + 4, true),
    z + view.getFloat32(16 * row + 8, true),
  ]);
}

main();
