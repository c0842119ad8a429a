// Small charts in SVG: bars of a histogram, and what was predicted against what was measured.
import { element } from "../dom";
import { countText, counted } from "../words";
import type { Histogram, ReportData } from "./data";
import { svg } from "./svg";
import { percent } from "./words";

const [WIDTH, HEIGHT] = [320, 190];
const EDGE = { left: 56, right: 10, top: 10, bottom: 38 };

/** Bars, with both axes named. `unit` is written along the horizontal one; `whole`: it is counted. */
export function histogramChart(
  histogram: Histogram,
  title: string,
  unit: string,
  counted: string,
  whole = false,
): HTMLElement {
  const { edges, counts } = histogram;
  const [low, high] = [edges[0] ?? 0, edges.at(-1) ?? 1];
  const most = Math.max(1, ...counts);
  const x = scaleOf(low, high, EDGE.left, WIDTH - EDGE.right);
  const y = scaleOf(0, most, HEIGHT - EDGE.bottom, EDGE.top);
  const picture = chart(`${title}: ${summaryOf(histogram, whole)}`);
  for (const tick of ticks(0, most, 3)) {
    picture.append(...level(y(tick), short(tick)));
  }
  counts.forEach((number, index) => {
    const [from, to] = [x(edges[index] ?? 0), x(edges[index + 1] ?? 0)];
    picture.append(
      svg(
        "rect",
        {
          x: from + 0.5,
          width: Math.max(0.5, to - from - 1),
          y: y(number),
          height: y(0) - y(number),
          class: "bar",
        },
        svg(
          "title",
          {},
          `${short(edges[index] ?? 0)} to ${short(edges[index + 1] ?? 0)}: ${number}`,
        ),
      ),
    );
  });
  for (const tick of ticks(low, high, 5)) {
    picture.append(
      svg(
        "text",
        { x: x(tick), y: HEIGHT - EDGE.bottom + 15, "text-anchor": "middle" },
        short(tick),
      ),
    );
  }
  nameAxes(picture, unit, counted);
  return element(
    "figure",
    { class: "chart" },
    element("figcaption", {}, element("strong", {}, title), ` ${summaryOf(histogram, whole)}`),
    picture,
  );
}

/** Where the values of a histogram lie, in words. */
function summaryOf(histogram: Histogram, whole: boolean): string {
  const total = histogram.counts.reduce((sum, number) => sum + number, 0);
  if (total === 0) return "nothing was counted";
  const at = (share: number): string => {
    const value = quantileOf(histogram, share);
    return short(whole ? Math.floor(value) : value);
  };
  return `median ${at(0.5)}, 10 to 90 %: ${at(0.1)} to ${at(0.9)}`;
}

/** By counts, and evenly within each bin. */
export function quantileOf({ edges, counts }: Histogram, share: number): number {
  let left = share * counts.reduce((sum, number) => sum + number, 0);
  for (const [index, number] of counts.entries()) {
    const [from, to] = [edges[index] ?? 0, edges[index + 1] ?? 0];
    if (number > 0 && left <= number) return from + ((to - from) * left) / number;
    left -= number;
  }
  return edges.at(-1) ?? 0;
}

/** Each group of runs at what was predicted and what was measured, with what chance allows. */
export function calibrationChart(calibration: ReportData["coverage"]["calibration"]): HTMLElement {
  const x = scaleOf(0, 1, EDGE.left, WIDTH - EDGE.right);
  const y = scaleOf(0, 1, HEIGHT - EDGE.bottom, EDGE.top);
  const words = calibration.map(
    ({ predicted, measured, runs }) =>
      `predicted ${percent(predicted)}, measured ${percent(measured)} of ${counted(runs, "run")}`,
  );
  const picture = chart(`Predicted against measured: ${words.join("; ")}`);
  for (const tick of [0, 0.5, 1]) {
    picture.append(
      ...level(y(tick), percent(tick)),
      svg(
        "text",
        { x: x(tick), y: HEIGHT - EDGE.bottom + 15, "text-anchor": tick === 1 ? "end" : "middle" },
        percent(tick),
      ),
    );
  }
  picture.append(svg("line", { x1: x(0), y1: y(0), x2: x(1), y2: y(1), class: "even" }));
  calibration.forEach(({ predicted, measured, runs }, index) => {
    const [low, high] = likelyShare(measured, runs);
    const at = x(predicted);
    picture.append(
      svg("line", { x1: at, x2: at, y1: y(low), y2: y(high), class: "interval" }),
      svg(
        "circle",
        { cx: at, cy: y(measured), r: 3 + Math.min(5, Math.sqrt(runs) / 2.5), class: "mark" },
        svg("title", {}, words[index] ?? ""),
      ),
    );
  });
  nameAxes(picture, "predicted chance", "measured share");
  return element(
    "figure",
    { class: "chart" },
    element(
      "figcaption",
      {},
      element("strong", {}, "Predicted against measured."),
      " On the dashed line, predictions come true; bars are what chance allows (95\u00a0%).",
    ),
    picture,
  );
}

/** Wilson's 95 % interval of a share that was measured in so many runs. */
export function likelyShare(share: number, runs: number): [number, number] {
  if (runs === 0) return [0, 1];
  const z = 1.96;
  const middle = share + (z * z) / (2 * runs);
  const half = z * Math.sqrt((share * (1 - share)) / runs + (z * z) / (4 * runs * runs));
  const scale = 1 + (z * z) / runs;
  return [Math.max(0, (middle - half) / scale), Math.min(1, (middle + half) / scale)];
}

/** Round numbers within a range, about so many. */
export function ticks(low: number, high: number, about: number): number[] {
  const rough = (high - low) / about;
  if (!(rough > 0)) return [low];
  const power = 10 ** Math.floor(Math.log10(rough));
  const step = ([1, 2, 5, 10].find((digit) => digit * power >= rough) ?? 10) * power;
  const found: number[] = [];
  for (let index = Math.ceil(low / step - 1e-9); index * step <= high + 1e-9 * step; index += 1) {
    found.push(Number((index * step).toPrecision(12)));
  }
  return found;
}

function chart(label: string): SVGSVGElement {
  return svg("svg", { viewBox: `0 0 ${WIDTH} ${HEIGHT}`, role: "img", "aria-label": label });
}

function nameAxes(picture: SVGSVGElement, horizontal: string, vertical: string): void {
  const middle = (EDGE.top + HEIGHT - EDGE.bottom) / 2;
  picture.append(
    svg(
      "text",
      {
        x: (EDGE.left + WIDTH - EDGE.right) / 2,
        y: HEIGHT - 6,
        "text-anchor": "middle",
        class: "axis",
      },
      horizontal,
    ),
    svg(
      "text",
      { transform: `translate(10 ${middle}) rotate(-90)`, "text-anchor": "middle", class: "axis" },
      vertical,
    ),
  );
}

function scaleOf(low: number, high: number, from: number, to: number): (value: number) => number {
  return (value) => from + ((to - from) * (value - low)) / (high - low || 1);
}

/** Few digits: what fits beside an axis. */
function short(value: number): string {
  if (Math.abs(value) >= 10000) return `${countText(value / 1000)}k`;
  if (Math.abs(value) >= 100) return countText(value);
  return String(Number(value.toPrecision(3)));
}

/** A line across the chart, and what it stands for beside it. */
function level(y: number, name: string): SVGElement[] {
  return [
    svg("line", { x1: EDGE.left, x2: WIDTH - EDGE.right, y1: y, y2: y, class: "rule" }),
    svg("text", { x: EDGE.left - 6, y, dy: "0.35em", "text-anchor": "end" }, name),
  ];
}
