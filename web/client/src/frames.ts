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
}

/** How much a matrix may differ from a rigid one: what float32 leaves of it. */
const TOLERANCE = 1e-4;

/** Where the camera is in the map: map_from_camera. With `unity`, these are the map's axes too. */
export function cameraMatrix(pose: Posed, axes: Axes = "opencv"): Matrix4 {
  const { rotation_wxyz, translation } = pose.cam_from_world;
  // Upright: the camera's y and z turn. Mirrored: z of points in the map, and of the camera.
  const [cameraY, cameraZ, mapZ] =
    axes === "opencv" ? [1, 1, 1] : axes === "opengl" ? [-1, -1, 1] : [-1, 1, -1];
  const norm = Math.hypot(...rotation_wxyz);
  const [w, x, y, z] = rotation_wxyz.map((part) => part / norm) as [number, number, number, number];
  // Rows of cam_from_world's rotation are columns of its inverse's.
  const right = [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)];
  const down = [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)];
  const forward = [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)];
  const centre = [0, 1, 2].map(
    (i) => -(right[i]! * translation[0] + down[i]! * translation[1] + forward[i]! * translation[2]),
  );
  const column = ([a, b, c]: number[], sign: number, last: number): number[] => [
    ...[sign * a!, sign * b!, sign * mapZ! * c!, last],
  ];
  return [
    ...column(right, 1, 0),
    ...column(down, cameraY!, 0),
    ...column(forward, cameraZ!, 0),
    ...column(centre, 1, 1),
  ];
}

/**
 * Where the map lies in the session: what moves content of the map to its place.
 *
 * `sessionFromCamera` is the device's own pose when the photo was taken. Keep it with the photo: the
 * answer comes later, and the device has moved on. The map must be metric. Throws ServiceError
 * `frames.not_rigid`.
 */
export function sessionFromMap(
  sessionFromCamera: ArrayLike<number>,
  pose: Posed,
  axes: Axes,
): Matrix4 {
  const session = Array.from(sessionFromCamera);
  checkRigid(session);
  return multiply(session, rigidInverse(cameraMatrix(pose, axes)));
}

/** The product a b. */
export function multiply(a: ArrayLike<number>, b: ArrayLike<number>): Matrix4 {
  return Array.from({ length: 16 }, (_, at) => {
    const row = at % 4;
    const column = at - row;
    return [0, 1, 2, 3].reduce((sum, k) => sum + a[4 * k + row]! * b[column + k]!, 0);
  });
}

/** The inverse of a rotation and a translation; of Unity's frames too. */
export function rigidInverse(m: ArrayLike<number>): Matrix4 {
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
  const rigid =
    m.length === 16 &&
    m.every(Number.isFinite) &&
    parts.every(([is, shall]) => Math.abs(is - shall) < TOLERANCE);
  if (rigid) return;
  throw ownError("frames.not_rigid", "No rigid transform", "the matrix is no rigid transform", {
    field: "sessionFromCamera",
    expected: "16 numbers, column by column: a rotation and a translation",
    got: m.slice(0, 16).join(", "),
  });
}
