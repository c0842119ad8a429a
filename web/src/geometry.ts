// Small linear algebra of poses and views: pure functions, no three.js.
// Conventions as in docs/conventions.md: cameras look along +z, +y is down in the image;
// pixels as in COLMAP. Matrices are 3 x 3, row by row.
import type { Camera, MapImage, Quaternion, Vector3 } from "visloc-client";

export type Matrix3 = [number, number, number, number, number, number, number, number, number];

/** Of chi square with three degrees of freedom, 95 %: how far the ellipsoid reaches, in stds. */
export const REACH_95 = Math.sqrt(7.814727903251179);

export function add(a: Vector3, b: Vector3): Vector3 {
  return [a[0] + b[0], a[1] + b[1], a[2] + b[2]];
}

export function subtract(a: Vector3, b: Vector3): Vector3 {
  return [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
}

export function scale(a: Vector3, by: number): Vector3 {
  return [a[0] * by, a[1] * by, a[2] * by];
}

export function dot(a: Vector3, b: Vector3): number {
  return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

export function cross(a: Vector3, b: Vector3): Vector3 {
  return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
}

export function length(a: Vector3): number {
  return Math.hypot(a[0], a[1], a[2]);
}

/** Of length 1; a vector of no length stays as it is. */
export function normalized(a: Vector3): Vector3 {
  const norm = length(a);
  return norm > 0 ? scale(a, 1 / norm) : a;
}

/** The rotation of a unit quaternion w, x, y, z. */
export function rotationMatrix([w, x, y, z]: Quaternion): Matrix3 {
  return [
    1 - 2 * (y * y + z * z),
    2 * (x * y - w * z),
    2 * (x * z + w * y),
    2 * (x * y + w * z),
    1 - 2 * (x * x + z * z),
    2 * (y * z - w * x),
    2 * (x * z - w * y),
    2 * (y * z + w * x),
    1 - 2 * (x * x + y * y),
  ];
}

/** The quaternion of the rotation by `b`, then by `a`. */
export function product(a: Quaternion, b: Quaternion): Quaternion {
  const [w1, x1, y1, z1] = a;
  const [w2, x2, y2, z2] = b;
  return [
    w1 * w2 - x1 * x2 - y1 * y2 - z1 * z2,
    w1 * x2 + x1 * w2 + y1 * z2 - z1 * y2,
    w1 * y2 - x1 * z2 + y1 * w2 + z1 * x2,
    w1 * z2 + x1 * y2 - y1 * x2 + z1 * w2,
  ];
}

export function apply(m: Matrix3, [x, y, z]: Vector3): Vector3 {
  return [
    m[0] * x + m[1] * y + m[2] * z,
    m[3] * x + m[4] * y + m[5] * z,
    m[6] * x + m[7] * y + m[8] * z,
  ];
}

export function transposed(m: Matrix3): Matrix3 {
  return [m[0], m[3], m[6], m[1], m[4], m[7], m[2], m[5], m[8]];
}

export function multiply(a: Matrix3, b: Matrix3): Matrix3 {
  const columns = transposed(b);
  const row = (i: number): Vector3 => [a[i]!, a[i + 1]!, a[i + 2]!];
  const column = (j: number): Vector3 => [columns[j]!, columns[j + 1]!, columns[j + 2]!];
  return [0, 3, 6].flatMap((i) => [0, 3, 6].map((j) => dot(row(i), column(j)))) as Matrix3;
}

/** Where a camera is in the world: -R^T t of cam_from_world. */
export function cameraCentre(rotation: Quaternion, translation: Vector3): Vector3 {
  return scale(apply(transposed(rotationMatrix(rotation)), translation), -1);
}

/**
 * Covariance of a camera's place in the world, 3 x 3, from that of cam_from_world, 6 x 6: rotation
 * (rad) then translation, for R <- Exp(w) R and t <- t + dt.
 *
 * The place is C = -R^T t. Moved, it is -R^T Exp(w)^T (t + dt), so that to first order
 * dC = R^T (w x t) - R^T dt = -R^T ([t] w + dt), with [t] the matrix of the cross product.
 */
export function positionCovariance(
  rotation: Quaternion,
  translation: Vector3,
  covariance: ArrayLike<number>,
): Matrix3 {
  const turned = transposed(rotationMatrix(rotation));
  const [x, y, z] = translation;
  const byRotation = multiply(turned, [0, -z, y, z, 0, -x, -y, x, 0]);
  // The sign of the whole Jacobian does not matter: it comes in twice.
  const jacobian = (row: number, column: number): number =>
    column < 3 ? byRotation[3 * row + column]! : turned[3 * row + column - 3]!;
  const made = new Array<number>(9).fill(0);
  for (let i = 0; i < 3; i++) {
    for (let j = 0; j < 3; j++) {
      for (let a = 0; a < 6; a++) {
        for (let b = 0; b < 6; b++) {
          made[3 * i + j]! += jacobian(i, a) * covariance[6 * a + b]! * jacobian(j, b);
        }
      }
    }
  }
  return made as Matrix3;
}

/**
 * Eigenvalues of a symmetric matrix, largest first, and their unit vectors as the columns of a
 * rotation, by Jacobi's method (Golub and Van Loan, section 8.5).
 */
export function symmetricEigen(matrix: Matrix3): { values: Vector3; vectors: Matrix3 } {
  let a: Matrix3 = [...matrix];
  let vectors: Matrix3 = [1, 0, 0, 0, 1, 0, 0, 0, 1];
  for (let sweep = 0; sweep < 12; sweep++) {
    for (const [p, q] of [
      [0, 1],
      [0, 2],
      [1, 2],
    ] as const) {
      const off = a[3 * p + q]!;
      if (off === 0) continue;
      const theta = (a[4 * q]! - a[4 * p]!) / (2 * off);
      const tangent = (theta < 0 ? -1 : 1) / (Math.abs(theta) + Math.hypot(theta, 1));
      const cosine = 1 / Math.hypot(tangent, 1);
      const turn: Matrix3 = [1, 0, 0, 0, 1, 0, 0, 0, 1];
      turn[4 * p] = turn[4 * q] = cosine;
      turn[3 * p + q] = tangent * cosine;
      turn[3 * q + p] = -tangent * cosine;
      a = multiply(transposed(turn), multiply(a, turn));
      vectors = multiply(vectors, turn);
    }
  }
  const order = [0, 1, 2].sort((i, j) => a[4 * j]! - a[4 * i]!);
  const column = (i: number): Vector3 => [vectors[i]!, vectors[3 + i]!, vectors[6 + i]!];
  const [first, second] = [column(order[0]!), column(order[1]!)];
  const third = cross(first, second);
  return {
    values: order.map((i) => a[4 * i]!) as Vector3,
    vectors: [0, 1, 2].flatMap((i) => [first[i]!, second[i]!, third[i]!]) as Matrix3,
  };
}

/** Half axes of the 95 % ellipsoid of a covariance, longest first, and their directions. */
export function ellipsoid95(covariance: Matrix3): { halfAxes: Vector3; directions: Matrix3 } {
  const { values, vectors } = symmetricEigen(covariance);
  return {
    // Rounding may leave a variance of almost zero below it.
    halfAxes: values.map((v) => REACH_95 * Math.sqrt(Math.max(v, 0))) as Vector3,
    directions: vectors,
  };
}

const ONE_FOCAL_LENGTH = new Set([
  "SIMPLE_PINHOLE",
  "SIMPLE_RADIAL",
  "RADIAL",
  "SIMPLE_RADIAL_FISHEYE",
  "RADIAL_FISHEYE",
]);
// Wider than this from the axis, a pyramid no longer says what a camera sees.
const MAX_ANGLE = (65 / 180) * Math.PI;

/**
 * Rays through the corners of the image, in the camera's frame with z = 1: top left, top right,
 * bottom right, bottom left. Distortion is left out; what fisheyes and others see beyond 65
 * degrees from the axis is cut off.
 */
export function cornerRays({ model, width, height, params }: Camera): Vector3[] {
  const single = ONE_FOCAL_LENGTH.has(model);
  const fx = params[0] ?? width;
  const fy = single ? fx : (params[1] ?? fx);
  const cx = params[single ? 1 : 2] ?? width / 2;
  const cy = params[single ? 2 : 3] ?? height / 2;
  const equidistant = model.endsWith("FISHEYE") || model === "FOV";
  return [
    [0, 0],
    [width, 0],
    [width, height],
    [0, height],
  ].map(([u, v]) => {
    const x = (u! - cx) / fx;
    const y = (v! - cy) / fy;
    const radius = Math.hypot(x, y);
    const angle = Math.min(equidistant ? radius : Math.atan(radius), MAX_ANGLE);
    const by = radius > 0 ? Math.tan(angle) / radius : 0;
    return [x * by, y * by, 1];
  });
}

/** The corners of the image in the world, so far from the camera as `depth`. */
export function frustumCorners(
  position: Vector3,
  orientation: Quaternion,
  rays: Vector3[],
  depth: number,
): Vector3[] {
  const rotation = rotationMatrix(orientation);
  return rays.map((ray) => add(position, apply(rotation, scale(ray, depth))));
}

/** Where a camera looks, a unit vector of the world. */
export function viewingDirection(orientation: Quaternion): Vector3 {
  return apply(rotationMatrix(orientation), [0, 0, 1]);
}

// What the mean of the upper edges counts beside the rows: enough where all photos look one way.
const MEAN_WEIGHT = 0.01;

/**
 * Up in the world: against `down` where the map knows it, else the direction to which the rows of
 * the photos are most nearly level: people hold a camera level, but look up or down as they like.
 * Photos that cancel each other out leave -y, up of a world made from the first photo.
 */
export function worldUp(down: number[], images: Pick<MapImage, "orientation">[]): Vector3 {
  if (down.length === 3) return normalized(scale(down as Vector3, -1));
  const mean = images.reduce<Vector3>(
    (total, { orientation }) => add(total, apply(rotationMatrix(orientation), [0, -1, 0])),
    [0, 0, 0],
  );
  if (length(mean) < 0.1 * images.length || images.length === 0) return [0, -1, 0];
  const upper = normalized(mean);
  const tilts: Matrix3 = [0, 1, 2].flatMap((i) =>
    [0, 1, 2].map((j) => MEAN_WEIGHT * ((i === j ? 1 : 0) - upper[i]! * upper[j]!)),
  ) as Matrix3;
  for (const { orientation } of images) {
    const row = apply(rotationMatrix(orientation), [1, 0, 0]);
    for (let k = 0; k < 9; k++)
      tilts[k]! += (row[Math.floor(k / 3)]! * row[k % 3]!) / images.length;
  }
  const { vectors } = symmetricEigen(tilts);
  const up: Vector3 = [vectors[2]!, vectors[5]!, vectors[8]!];
  return dot(up, upper) < 0 ? scale(up, -1) : up;
}

/** The largest of ..., 0.1, 0.2, 0.5, 1, 2, 5, ... that is not above `most`. */
export function niceLength(most: number): number {
  const decade = 10 ** Math.floor(Math.log10(most));
  // The tenth guards against log10 landing just below a whole decade.
  const step = [10, 5, 2, 1].find((s) => s * decade <= most * (1 + 1e-9)) ?? 1;
  return step * decade;
}

/** A length in words: metres in their usual units, or units of a world without scale. */
export function lengthText(value: number, metric: boolean, significant = 3): string {
  const text = (v: number): string => String(Number(v.toPrecision(significant)));
  if (!metric) return value === 1 ? "1 unit" : `${text(value)} units`;
  if (value >= 1000) return `${text(value / 1000)} km`;
  if (value >= 1) return `${text(value)} m`;
  return value >= 0.01 ? `${text(value * 100)} cm` : `${text(value * 1000)} mm`;
}

/** The value below which a share of the values lie; NaN of none. */
export function percentile(values: ArrayLike<number>, share: number): number {
  const sorted = Float64Array.from(values).sort();
  return sorted[Math.round(share * (sorted.length - 1))] ?? NaN;
}

/** Median distance of positions to their nearest other one, by a sample; null of fewer than two. */
export function medianSpacing(positions: Vector3[]): number | null {
  if (positions.length < 2) return null;
  const stride = Math.ceil(positions.length / 100);
  const nearest: number[] = [];
  for (let i = 0; i < positions.length; i += stride) {
    let best = Infinity;
    for (let j = 0; j < positions.length; j++) {
      if (j !== i) best = Math.min(best, length(subtract(positions[i]!, positions[j]!)));
    }
    nearest.push(best);
  }
  return percentile(nearest, 0.5);
}
