// The coverage seen from above, drawn as SVG: rosettes of directions, photos, weak spots.
import { element } from "../dom";
import { niceLength, viewingDirection } from "../geometry";
import { countText } from "../words";
import type { CoverageCell, ReportData } from "./data";
import {
  headingOf,
  headingsApart,
  nearestDirection,
  onPlan,
  petal,
  planBox,
  type PlanBox,
  type PlanPoint,
} from "./plan";
import type { Scale } from "./scale";
import { format, svg } from "./svg";
import { clock, length, percent } from "./words";

/** A cell is never drawn smaller than this, pixels: a wide plan scrolls instead. */
const LEAST_CELL = 12;
const MOST_CELL = 76;
/** Photos that look this far off a chosen direction count as looking that way. */
const LOOKS_THAT_WAY_DEG = 45;

export interface PlanChoice {
  scale: Scale;
  /** One of the directions, or all as rosettes. */
  direction: number | null;
  photos: boolean;
}

export interface PlanView {
  show(choice: PlanChoice): void;
  /** Make one weak spot stand out. */
  stress(spot: number | null): void;
}

/** Fill `host` with the plan. `tell` gets what is under the pointer, in words. */
export function createPlan(
  host: HTMLElement,
  data: ReportData,
  landmarks: PlanPoint[],
  first: PlanChoice,
  tell: (text: string | null) => void,
): PlanView {
  const { coverage } = data;
  const cells = coverage.cells.map((cell) => ({ cell, at: onPlan(coverage, cell.position) }));
  const photos = data.images.map((image) => ({
    name: image.name,
    at: onPlan(coverage, image.position),
    heading: headingOf(coverage, viewingDirection(image.orientation)),
  }));
  const shown = [...cells, ...photos].map(({ at }) => at);
  const box = planBox(shown.length > 0 ? shown : landmarks, landmarks, coverage.cell);
  const density = densityPicture(box, landmarks);

  let choice = first;
  let stressed: number | null = null;
  let pixels = 1; // of a unit of the world
  let marked: SVGGElement | null = null;

  const place = (point: PlanPoint) => ({
    x: (point.x - box.min.x) * pixels,
    y: (point.y - box.min.y) * pixels,
  });

  function draw(): void {
    const width = box.max.x - box.min.x;
    const fitting = host.clientWidth / width;
    pixels = Math.min(Math.max(fitting, LEAST_CELL / coverage.cell), MOST_CELL / coverage.cell);
    const size = { x: width * pixels, y: (box.max.y - box.min.y) * pixels };
    const picture = svg("svg", {
      viewBox: `0 0 ${format(size.x)} ${format(size.y)}`,
      width: size.x,
      height: size.y,
      role: "img",
      "aria-label":
        "Plan of the map, seen from above, with how likely photos are localized; " +
        "the tables below have the same numbers.",
    });
    picture.append(
      svg("image", {
        href: density,
        width: size.x,
        height: size.y,
        preserveAspectRatio: "none",
        class: "density",
      }),
      drawCells(),
      choice.photos ? drawPhotos() : "",
      drawSpots(),
      scaleBar(size),
    );
    marked = svg("g", { class: "marked" });
    picture.append(marked);
    host.replaceChildren(picture);
  }

  function drawCells(): SVGGElement {
    const group = svg("g", { class: "cells" });
    const radius = 0.47 * coverage.cell * pixels;
    for (const { cell, at } of cells) {
      const centre = place(at);
      if (choice.direction === null) {
        group.append(svg("circle", { cx: centre.x, cy: centre.y, r: radius, class: "rim" }));
        drawRosette(group, cell, centre, radius);
      } else {
        const side = 2 * radius;
        group.append(
          svg("rect", {
            x: centre.x - radius,
            y: centre.y - radius,
            width: side,
            height: side,
            class: className(choice.scale.classOf(cell, choice.direction)),
          }),
        );
      }
    }
    return group;
  }

  /** One path for all petals of a class: a plan of thousands of cells stays light. */
  function drawRosette(
    group: SVGGElement,
    cell: CoverageCell,
    centre: PlanPoint,
    radius: number,
  ): void {
    const paths = new Map<number | null, string>();
    const directions = coverage.directions_deg;
    directions.forEach((heading, index) => {
      const reach = radius * choice.scale.reach(cell, index);
      const kind = choice.scale.classOf(cell, index);
      const path = petal(centre, reach, heading, 360 / directions.length);
      paths.set(kind, (paths.get(kind) ?? "") + path);
    });
    for (const [kind, path] of paths) {
      group.append(svg("path", { d: path, class: className(kind) }));
    }
  }

  function drawPhotos(): SVGGElement {
    const group = svg("g", { class: "photos" });
    const chosen =
      choice.direction === null ? null : (coverage.directions_deg[choice.direction] ?? null);
    const tick = Math.min(14, Math.max(6, 0.3 * coverage.cell * pixels));
    for (const { name, at, heading } of photos) {
      if (chosen !== null) {
        if (heading === null || headingsApart(heading, chosen) > LOOKS_THAT_WAY_DEG) continue;
      }
      const { x, y } = place(at);
      const mark = svg("g", {}, svg("circle", { cx: x, cy: y, r: 1.8 }));
      if (heading !== null) {
        const angle = (heading * Math.PI) / 180;
        const [x2, y2] = [x + tick * Math.cos(angle), y - tick * Math.sin(angle)];
        mark.append(svg("line", { x1: x, y1: y, x2, y2 }));
      }
      mark.append(svg("title", {}, name));
      group.append(mark);
    }
    return group;
  }

  function drawSpots(): SVGGElement {
    const group = svg("g", { class: "spots" });
    const size = Math.min(1, Math.max(0.7, (0.3 * coverage.cell * pixels) / 10));
    coverage.weak_spots.forEach((spot, index) => {
      const { x, y } = place(onPlan(coverage, spot.position));
      const turn = -spot.direction_deg;
      group.append(
        svg(
          "g",
          {
            class: index === stressed ? "spot stressed" : "spot",
            transform: `translate(${format(x)} ${format(y)}) scale(${format(size)})`,
          },
          svg("path", { d: "M11 -6L22 0L11 6Z", transform: `rotate(${format(turn)})` }),
          svg("circle", { r: 10 }),
          svg("text", { "text-anchor": "middle", dy: "0.35em" }, String(index + 1)),
          svg("title", {}, spot.why),
        ),
      );
    });
    return group;
  }

  function scaleBar(size: PlanPoint): SVGGElement {
    const units = niceLength(Math.min(120, size.x / 3) / pixels);
    const [x, y, end] = [12, size.y - 12, 12 + units * pixels];
    return svg(
      "g",
      { class: "scale-bar" },
      svg("path", { d: `M${x} ${y - 5}V${y}H${format(end)}V${y - 5}` }),
      svg(
        "text",
        { x: (x + end) / 2, y: y - 6, "text-anchor": "middle" },
        length(units, data.map.metric),
      ),
    );
  }

  function point(event: PointerEvent): void {
    const picture = host.querySelector("svg");
    if (!picture || !marked) return;
    const frame = picture.getBoundingClientRect();
    const factor = picture.viewBox.baseVal.width / frame.width;
    const x = (event.clientX - frame.left) * factor;
    const y = (event.clientY - frame.top) * factor;
    const under = { x: x / pixels + box.min.x, y: y / pixels + box.min.y };
    const nearest = cells.reduce<(typeof cells)[number] | null>((best, one) => {
      const away = distance(one.at, under);
      return away <= 0.75 * coverage.cell && (!best || away < distance(best.at, under))
        ? one
        : best;
    }, null);
    marked.replaceChildren();
    if (!nearest) {
      tell(null);
      return;
    }
    const away = { x: under.x - nearest.at.x, y: nearest.at.y - under.y };
    const heading = (Math.atan2(away.y, away.x) * 180) / Math.PI;
    const index = choice.direction ?? nearestDirection(coverage.directions_deg, heading);
    const radius = 0.47 * coverage.cell * pixels;
    marked.append(
      svg("path", {
        d: petal(
          place(nearest.at),
          radius,
          coverage.directions_deg[index] ?? 0,
          360 / coverage.directions_deg.length,
        ),
      }),
    );
    tell(describe(data, nearest.cell, index));
  }

  host.addEventListener("pointermove", point);
  host.addEventListener("pointerdown", point);
  host.addEventListener("pointerleave", () => {
    marked?.replaceChildren();
    tell(null);
  });
  let width = host.clientWidth;
  new ResizeObserver(() => {
    if (host.clientWidth === width) return;
    width = host.clientWidth;
    draw();
  }).observe(host);
  draw();
  return {
    show: (next) => {
      choice = next;
      draw();
    },
    stress: (spot) => {
      stressed = spot;
      host
        .querySelectorAll(".spot")
        .forEach((mark, index) => mark.classList.toggle("stressed", index === spot));
    },
  };
}

/** The numbers of a cell in one direction. */
export function describe(data: ReportData, cell: CoverageCell, direction: number): string {
  const std = cell.position_std[direction] ?? null;
  return (
    `Looking towards ${clock(data.coverage.directions_deg[direction] ?? 0)}: localized in ` +
    `${percent(cell.probability[direction] ?? 0)} of cases, ` +
    `${countText(cell.expected_inliers[direction] ?? 0)} inliers expected, position ` +
    (std === null ? "not expected." : `± ${length(std, data.map.metric)} (standard deviation).`)
  );
}

/** What a colour, or a direction of view, stands for. */
export function legend(scale: Scale): HTMLElement {
  const item = (kind: number | null, name: string) =>
    element("li", {}, element("span", { class: `swatch ${className(kind)}` }), name);
  const list = element(
    "ul",
    { class: "legend" },
    ...scale.names.map((name, kind) => item(kind, name)),
  );
  if (scale.none !== null) list.append(item(null, scale.none));
  return list;
}

function className(kind: number | null): string {
  return kind === null ? "class-none" : `class-${kind}`;
}

function distance(a: PlanPoint, b: PlanPoint): number {
  return Math.hypot(a.x - b.x, a.y - b.y);
}

/** Landmarks as a picture of their density: as many dots as elements would be too many. */
function densityPicture(box: PlanBox, landmarks: PlanPoint[]): string {
  const [width, height] = [box.max.x - box.min.x, box.max.y - box.min.y];
  const perUnit = 900 / Math.max(width, height);
  const canvas = element("canvas", {
    width: Math.max(1, Math.round(width * perUnit)),
    height: Math.max(1, Math.round(height * perUnit)),
  });
  const counts = new Uint32Array(canvas.width * canvas.height);
  for (const { x, y } of landmarks) {
    const column = Math.floor((x - box.min.x) * perUnit);
    const row = Math.floor((y - box.min.y) * perUnit);
    if (column < 0 || row < 0 || column >= canvas.width || row >= canvas.height) continue;
    const index = row * canvas.width + column;
    counts[index] = (counts[index] ?? 0) + 1;
  }
  const context = canvas.getContext("2d");
  if (!context) return "data:,";
  const picture = context.createImageData(canvas.width, canvas.height);
  counts.forEach((number, index) => {
    // A grey that shows on light ground and on dark.
    picture.data.set([118, 128, 138, Math.min(255, 90 * Math.log2(1 + number))], 4 * index);
  });
  context.putImageData(picture, 0, 0);
  return canvas.toDataURL("image/png");
}
