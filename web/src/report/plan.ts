// Where things lie on the plan: the map seen from above, `right` to the right and `ahead` up.
import type { Quaternion, Vector3 } from "visloc-client";
import { add, cross, dot, percentile, scale } from "../geometry";
import type { ReportData } from "./data";

/** On the plan, units of the world; y grows downwards, as pixels do. */
export interface PlanPoint {
  x: number;
  y: number;
}

export interface PlanBox {
  min: PlanPoint;
  max: PlanPoint;
}

type Coverage = ReportData["coverage"];
type Axes = Pick<Coverage, "right" | "ahead">;

/** Straight down onto the plan. */
export function onPlan(axes: Axes, point: Vector3): PlanPoint {
  return { x: dot(point, axes.right), y: -dot(point, axes.ahead) };
}

/** Angle from `right` towards `ahead`, degrees in [0, 360); null for what looks straight up or down. */
export function headingOf(axes: Axes, direction: Vector3): number | null {
  const [right, ahead] = [dot(direction, axes.right), dot(direction, axes.ahead)];
  if (Math.hypot(right, ahead) < 1e-6) return null;
  return ((Math.atan2(ahead, right) * 180) / Math.PI + 360) % 360;
}

/** Degrees between two headings, 0 to 180. */
export function headingsApart(a: number, b: number): number {
  return Math.abs(((((a - b) % 360) + 540) % 360) - 180);
}

/** Where a camera of the coverage looks: along a heading, and as far below the level as all do. */
export function directionOf(coverage: Axes & { pitch_deg: number }, heading: number): Vector3 {
  const [turn, pitch] = [(heading * Math.PI) / 180, (coverage.pitch_deg * Math.PI) / 180];
  const up = cross(coverage.right, coverage.ahead);
  const level = add(scale(coverage.right, Math.cos(turn)), scale(coverage.ahead, Math.sin(turn)));
  return add(scale(level, Math.cos(pitch)), scale(up, -Math.sin(pitch)));
}

/** world_from_cam of a camera that looks along a heading and is held level. */
export function orientationOf(coverage: Axes & { pitch_deg: number }, heading: number): Quaternion {
  const turn = (heading * Math.PI) / 180;
  const forward = directionOf(coverage, heading);
  const rightward = add(
    scale(coverage.right, Math.sin(turn)),
    scale(coverage.ahead, -Math.cos(turn)),
  );
  return quaternionOf(rightward, cross(forward, rightward), forward);
}

/** Of the rotation with these columns (Shepperd's method: divide by the largest component). */
function quaternionOf(x: Vector3, y: Vector3, z: Vector3): Quaternion {
  const squares = [
    1 + x[0] + y[1] + z[2],
    1 + x[0] - y[1] - z[2],
    1 - x[0] + y[1] - z[2],
    1 - x[0] - y[1] + z[2],
  ];
  const largest = squares.indexOf(Math.max(...squares));
  const double = Math.sqrt(squares[largest] ?? 1); // twice the largest component
  const rows: Quaternion[] = [
    [double * double, y[2] - z[1], z[0] - x[2], x[1] - y[0]],
    [y[2] - z[1], double * double, x[1] + y[0], z[0] + x[2]],
    [z[0] - x[2], x[1] + y[0], double * double, y[2] + z[1]],
    [x[1] - y[0], z[0] + x[2], y[2] + z[1], double * double],
  ];
  const row = rows[largest] ?? [1, 0, 0, 0];
  const sign = row[0] < 0 ? -1 : 1;
  return row.map((value) => (sign * value) / (2 * double)) as Quaternion;
}

/** A petal of a rosette as an SVG path; the heading turns against the clock. */
export function petal(centre: PlanPoint, radius: number, heading: number, width: number): string {
  const end = (degrees: number) => {
    const angle = (degrees * Math.PI) / 180;
    const x = centre.x + radius * Math.cos(angle);
    const y = centre.y - radius * Math.sin(angle);
    return `${x.toFixed(2)} ${y.toFixed(2)}`;
  };
  const [from, to] = [end(heading - width / 2), end(heading + width / 2)];
  const [r, start] = [radius.toFixed(2), `${centre.x.toFixed(2)} ${centre.y.toFixed(2)}`];
  return `M${start}L${from}A${r} ${r} 0 0 0 ${to}Z`;
}

/** Which direction of the list is nearest to a heading. */
export function nearestDirection(directions: number[], heading: number): number {
  let best = 0;
  directions.forEach((direction, index) => {
    const [now, before] = [direction, directions[best] ?? 0];
    if (headingsApart(now, heading) < headingsApart(before, heading)) best = index;
  });
  return best;
}

export function boxOf(points: PlanPoint[]): PlanBox {
  const box = {
    min: { x: Infinity, y: Infinity },
    max: { x: -Infinity, y: -Infinity },
  };
  for (const { x, y } of points) {
    box.min.x = Math.min(box.min.x, x);
    box.min.y = Math.min(box.min.y, y);
    box.max.x = Math.max(box.max.x, x);
    box.max.y = Math.max(box.max.y, y);
  }
  return box;
}

/**
 * What of the world the plan shows: all cells and photos, and of the landmarks what lies not much
 * further out. A few landmarks on the horizon must not shrink a room to a dot.
 */
export function planBox(shown: PlanPoint[], landmarks: PlanPoint[], cell: number): PlanBox {
  const inner = boxOf(shown);
  const side = Math.max(inner.max.x - inner.min.x, inner.max.y - inner.min.y, cell);
  const [xs, ys] = [landmarks.map((point) => point.x), landmarks.map((point) => point.y)];
  const far = 0.25 * side;
  const low = (least: number, values: number[]) =>
    Math.min(least, Math.max(least - far, percentile(values, 0.01))) - cell / 2;
  const high = (most: number, values: number[]) =>
    Math.max(most, Math.min(most + far, percentile(values, 0.99))) + cell / 2;
  if (landmarks.length === 0) [xs[0], ys[0]] = [inner.min.x, inner.min.y];
  return {
    min: { x: low(inner.min.x, xs), y: low(inner.min.y, ys) },
    max: { x: high(inner.max.x, xs), y: high(inner.max.y, ys) },
  };
}
