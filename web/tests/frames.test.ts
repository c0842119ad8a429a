import { describe, expect, test, vi } from "vitest";
import {
  blended,
  cameraMatrix,
  ServiceError,
  sessionFromMap,
  type Axes,
  type Matrix4,
  type Posed,
} from "visloc-client";
// The numbers that clients/frames.py gives, which tests/clients/test_frames.py checks.
import truths from "../../tests/clients/frames.json";

const AXES: Axes[] = ["opencv", "opengl", "unity"];
const QUARTER = Math.SQRT1_2;

const posed = (rotation: number[], translation: number[]): Posed =>
  ({ cam_from_world: { rotation_wxyz: rotation, translation } }) as Posed;

function expectClose(got: Matrix4, expected: number[]): void {
  expect(got).toHaveLength(16);
  got.forEach((value, i) => expect(value).toBeCloseTo(expected[i]!, 7));
}

/** m (x, y, z, 1), kept by columns. */
const moved = (m: number[], [x, y, z]: number[]): number[] =>
  [0, 1, 2].map((row) => m[row]! * x! + m[4 + row]! * y! + m[8 + row]! * z! + m[12 + row]!);

describe.each(AXES)("in the axes of %s", (axes) => {
  test.each(truths)("matrices are those of Python: $translation", (truth) => {
    const pose = posed(truth.rotation_wxyz, truth.translation);
    expectClose(cameraMatrix(pose, axes), truth.camera_matrix[axes]);
    expectClose(
      sessionFromMap(truth.session_from_camera, pose, axes),
      truth.session_from_map[axes],
    );
  });

  test("a session that began at the camera has the map where the camera sees it", () => {
    // A camera at (1, 2, 3) that looks along x of the map, with z of the map up.
    const pose = posed([0.5, 0.5, -0.5, 0.5], [2, 3, -1]);
    const identity = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1];
    const ahead = axes === "unity" ? [5, 2, -3] : [5, 2, 3];
    const seen = { opencv: [0, 0, 4], opengl: [0, 0, -4], unity: [0, 0, 4] }[axes];
    moved(sessionFromMap(identity, pose, axes), ahead).forEach((value, i) =>
      expect(value).toBeCloseTo(seen[i]!, 12),
    );
  });
});

test("a pose whose unit has an unknown length is warned of once", async () => {
  const warn = vi.spyOn(console, "warn").mockImplementation(() => undefined);
  const identity = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1];
  const pose = posed([1, 0, 0, 0], [0, 0, 0]);
  for (const known of [{ metric: true }, { metric: null }, {}]) {
    sessionFromMap(identity, { ...pose, ...known }, "opengl");
  }
  expect(warn).not.toHaveBeenCalled();
  sessionFromMap(identity, { ...pose, metric: false }, "opengl");
  sessionFromMap(identity, { ...pose, metric: false }, "opengl");
  expect(warn).toHaveBeenCalledOnce();
  expect(String(warn.mock.calls[0]![0])).toContain("unknown length");
  warn.mockRestore();
});

test.each(truths)("what lies between is as in Python: $translation", (truth) => {
  const [old, next] = [truth.session_from_camera, truth.session_from_map.opengl];
  expectClose(blended(old, next, 0.3), truth.blended);
  expectClose(blended(old, next, 0), old);
  expectClose(blended(old, next, 1), next);
  expectClose(blended(old, old, 0.5), old);
});

test("half a turn, and nearly none, are blended", () => {
  const turned = (angle: number): Matrix4 => [
    ...[Math.cos(angle), Math.sin(angle), 0, 0, -Math.sin(angle), Math.cos(angle), 0, 0],
    ...[0, 0, 1, 0, 0, 0, 0, 1],
  ];
  for (const angle of [1e-9, 0.1, 3, Math.PI - 1e-9, -2]) {
    expectClose(blended(turned(0), turned(angle), 0.25), turned(angle / 4));
    expectClose(blended(turned(3), turned(3 + angle), 0.25), turned(3 + angle / 4));
  }
});

test("a quaternion counts by its direction", () => {
  const pose = posed([QUARTER, QUARTER, 0, 0], [1, 2, 3]);
  expectClose(cameraMatrix(posed([5, 5, 0, 0], [1, 2, 3])), cameraMatrix(pose));
});

test.each([
  ["kept row by row", [1, 0, 0, 3, 0, 1, 0, 2, 0, 0, 1, 1, 0, 0, 0, 1]],
  ["scaled", [2, 0, 0, 0, 0, 2, 0, 0, 0, 0, 2, 0, 0, 0, 0, 1]],
  ["mirrored", [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, -1, 0, 0, 0, 0, 1]],
  ["sheared", [1, 0, 0, 0, 0.1, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]],
  ["too short", [1, 0, 0, 0, 1, 0, 0, 0, 1]],
  ["no numbers", new Array<number>(16).fill(NaN)],
])("a matrix that is %s is refused", (_, matrix) => {
  const pose = posed([1, 0, 0, 0], [0, 0, 0]);
  expect(() => sessionFromMap(matrix, pose, "opengl")).toThrow(ServiceError);
  try {
    sessionFromMap(matrix, pose, "opengl");
  } catch (error) {
    expect((error as ServiceError).code).toBe("frames.not_rigid");
  }
});
