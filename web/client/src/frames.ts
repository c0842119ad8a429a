// From the pose of a photo to the frame of an AR session (docs/ar-and-robots.md): clients/frames.py
// in TypeScript. Matrices are 4 x 4 for column vectors, kept column by column in 16 numbers, as
// three.js, WebXR, ARKit and Unity keep them.
import { ownError } from "./errors.js";
import type { Transform } from "./words.js";

/**
 * The axes of a camera, and of the frame that it is in.
 *
 * `opencv` is ours: x right, y down, z forward. ROS calls it an optical frame.
 * `opengl` is ARKit's, ARCore's, WebXR's and three.js's: x right, y up, z backward.
 * `unity` is left-handed: x right, y up, z forward. Unity's frames mirror right-handed ones, so a
 * point (x, y, z) of the map is (x, y, -z) there.
 */
export type Axes = "opencv" | "opengl" | "unity";

/** 16 numbers, column by column. */
export type Matrix4 = number[];

/** The pose of an answer, or of a photo of a rig's answer. */
export interface Posed {
  cam_from_world: Transform;
  metric?: boolean | null;
}

/** One warning is enough: a session asks several times a second. */
let warned = false;

/** How much a matrix may differ from a rigid one: what float32 leaves of it. */
const TOLERANCE = 1e-4;

/** Where the camera is in the map: map_from_camera. With `unity`, these are the map's axes too. */
export function cameraMatrix(pose: Posed, axes: Axes = "opencv"): Matrix4 {
  const { rotation_wxyz, translation } = pose.cam_from_world;
  const matrix = rigidInverse(rigid(rotation_wxyz, translation));
  if (axes === "opencv") return matrix;
  const upright = matrix.map((value, i) => (i >= 4 && i < 12 ? -value : value));
  if (axes === "opengl") return upright;
  // Unity's frames mirror z: of points in the map (the third row) and in the camera (column).
  return upright.map((value, i) => ((i % 4 === 2) !== (i >= 8 && i < 12) ? -value : value));
}

/**
 * Where the map lies in the session: what moves content of the map to its place.
 *
 * `sessionFromCamera` is the device's own pose when the photo was taken. Keep it with the photo: the
 * answer comes later, and the device has moved on. Of a pose whose unit has an unknown length, the
 * console is warned once: content gets the wrong size and distance. Throws ServiceError
 * `frames.not_rigid`.
 */
export function sessionFromMap(
  sessionFromCamera: ArrayLike<number>,
  pose: Posed,
  axes: Axes,
): Matrix4 {
  if (pose.metric === false && !warned) {
    warned = true;
    console.warn(
      "visloc: the unit of this map has an unknown length, and that of the session is the metre: " +
        "content is placed in the wrong size. mapping edit --scale gives the map its size",
    );
  }
  const session = Array.from(sessionFromCamera);
  checkRigid(session);
  return multiply(session, rigidInverse(cameraMatrix(pose, axes)));
}

/**
 * A rigid transform between two: positions linearly, rotations along the shortest way.
 *
 * With `share = oldVariance / (oldVariance + newVariance)` this is the best estimate of a transform
 * that does not change, such as sessionFromMap. `share`, of the new one, is 0 to 1.
 */
export function blended(
  before: ArrayLike<number>,
  after: ArrayLike<number>,
  share: number,
): Matrix4 {
  const [old, next] = [Array.from(before), Array.from(after)];
  [old, next].forEach(checkRigid);
  const p = quaternionOf(old);
  let q = quaternionOf(next);
  let cosine = p.reduce((sum, part, i) => sum + part * q[i]!, 0);
  // A quaternion and its negative are one rotation; this is the nearer of both.
  if (cosine < 0) [q, cosine] = [q.map((part) => -part), -cosine];
  const angle = Math.acos(Math.min(1, cosine));
  // Spherical; for angles too small to divide by, linear is the same.
  const [a, b] =
    angle < 1e-6
      ? [1 - share, share]
      : [Math.sin((1 - share) * angle), Math.sin(share * angle)].map((x) => x / Math.sin(angle));
  const between = p.map((part, i) => a! * part + b! * q[i]!);
  const at = [12, 13, 14].map((i) => (1 - share) * old[i]! + share * next[i]!);
  return rigid(between, at);
}

/** The transform of a quaternion w, x, y, z of any length, and a translation. */
function rigid(quaternion: ArrayLike<number>, translation: ArrayLike<number>): Matrix4 {
  const parts = Array.from(quaternion);
  const norm = Math.hypot(...parts);
  const [w, x, y, z] = parts.map((part) => part / norm) as [number, number, number, number];
  return [
    ...[1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y), 0],
    ...[2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x), 0],
    ...[2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y), 0],
    ...[translation[0]!, translation[1]!, translation[2]!, 1],
  ];
}

/** Of unit length: w, x, y, z of a matrix's rotation. */
function quaternionOf(m: number[]): number[] {
  const [xx, yy, zz] = [m[0]!, m[5]!, m[10]!];
  // Four times the products of each component with all; the largest is the safest to divide by.
  const products = [
    [1 + xx + yy + zz, m[6]! - m[9]!, m[8]! - m[2]!, m[1]! - m[4]!],
    [m[6]! - m[9]!, 1 + xx - yy - zz, m[1]! + m[4]!, m[8]! + m[2]!],
    [m[8]! - m[2]!, m[1]! + m[4]!, 1 - xx + yy - zz, m[6]! + m[9]!],
    [m[1]! - m[4]!, m[8]! + m[2]!, m[6]! + m[9]!, 1 - xx - yy + zz],
  ];
  const best = products.reduce((a, b, i) => (b[i]! > a[products.indexOf(a)]! ? b : a));
  const norm = Math.hypot(...best);
  return best.map((part) => part / norm);
}

/** The product a b. */
function multiply(a: ArrayLike<number>, b: ArrayLike<number>): Matrix4 {
  return Array.from({ length: 16 }, (_, at) => {
    const row = at % 4;
    const column = at - row;
    return [0, 1, 2, 3].reduce((sum, k) => sum + a[4 * k + row]! * b[column + k]!, 0);
  });
}

/** The inverse of a rotation and a translation. */
function rigidInverse(m: ArrayLike<number>): Matrix4 {
  const turned = [0, 1, 2].map((column) => [m[column]!, m[4 + column]!, m[8 + column]!, 0]);
  const moved = [0, 1, 2].map(
    (i) => -(m[4 * i]! * m[12]! + m[4 * i + 1]! * m[13]! + m[4 * i + 2]! * m[14]!),
  );
  return [...turned.flat(), ...moved, 1];
}

function checkRigid(m: number[]): void {
  const [a, b, c] = [0, 4, 8].map((at) => m.slice(at, at + 3)) as [number[], number[], number[]];
  const dot = (u: number[], v: number[]): number => u.reduce((sum, x, i) => sum + x * v[i]!, 0);
  const cross = [b[1]! * c[2]! - b[2]! * c[1]!, b[2]! * c[0]! - b[0]! * c[2]!];
  const determinant = dot(a, [...cross, b[0]! * c[1]! - b[1]! * c[0]!]);
  const parts: [number, number][] = [
    ...[a, b, c].map((u): [number, number] => [dot(u, u), 1]),
    ...[dot(a, b), dot(b, c), dot(c, a)].map((product): [number, number] => [product, 0]),
    ...[m[3]!, m[7]!, m[11]!].map((last): [number, number] => [last, 0]),
    [m[15]!, 1],
    [determinant, 1],
  ];
  const isRigid =
    m.length === 16 &&
    m.every(Number.isFinite) &&
    parts.every(([is, shall]) => Math.abs(is - shall) < TOLERANCE);
  if (isRigid) return;
  throw ownError("frames.not_rigid", "No rigid transform", "the matrix is no rigid transform", {
    expected: "16 numbers, column by column: a rotation and a translation",
    got: m.slice(0, 16).join(", "),
  });
}
