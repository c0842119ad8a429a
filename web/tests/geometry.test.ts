import { describe, expect, test } from "vitest";
import type { Camera, Quaternion, Vector3 } from "visloc-client";
import {
  REACH_95,
  add,
  apply,
  cameraCentre,
  cornerRays,
  ellipsoid95,
  frustumCorners,
  lengthText,
  medianSpacing,
  multiply,
  niceLength,
  normalized,
  percentile,
  positionCovariance,
  rotationMatrix,
  symmetricEigen,
  transposed,
  viewingDirection,
  worldUp,
  type Matrix3,
} from "../src/geometry";

const IDENTITY: Quaternion = [1, 0, 0, 0];
const HALF = Math.SQRT1_2;

function unit(...values: [number, number, number, number]): Quaternion {
  const norm = Math.hypot(...values);
  return values.map((v) => v / norm) as Quaternion;
}

function expectClose(got: ArrayLike<number>, expected: ArrayLike<number>, digits = 9): void {
  expect(got.length).toBe(expected.length);
  for (let i = 0; i < got.length; i++) expect(got[i]).toBeCloseTo(expected[i]!, digits);
}

/** Quaternions are multiplied as rotations are. */
function after(a: Quaternion, b: Quaternion): Quaternion {
  const [aw, ax, ay, az] = a;
  const [bw, bx, by, bz] = b;
  return [
    aw * bw - ax * bx - ay * by - az * bz,
    aw * bx + ax * bw + ay * bz - az * by,
    aw * by - ax * bz + ay * bw + az * bx,
    aw * bz + ax * by - ay * bx + az * bw,
  ];
}

describe("rotations", () => {
  test("a quarter turn about z takes x to y", () => {
    expectClose(apply(rotationMatrix([HALF, 0, 0, HALF]), [1, 0, 0]), [0, 1, 0]);
  });

  test("a matrix times its transpose is the identity", () => {
    const rotation = rotationMatrix(unit(0.3, -0.5, 0.7, 0.2));
    expectClose(multiply(rotation, transposed(rotation)), [1, 0, 0, 0, 1, 0, 0, 0, 1]);
  });

  test("a camera without rotation looks along z", () => {
    expectClose(viewingDirection(IDENTITY), [0, 0, 1]);
  });

  test("a camera centre is taken to nothing by cam_from_world", () => {
    const rotation = unit(0.9, 0.1, -0.3, 0.2);
    const translation: Vector3 = [1, -2, 3];
    const centre = cameraCentre(rotation, translation);
    expectClose(add(apply(rotationMatrix(rotation), centre), translation), [0, 0, 0]);
  });
});

describe("the covariance of a position", () => {
  const rotation = unit(0.8, 0.2, -0.4, 0.3);
  const translation: Vector3 = [4, -7, 12];

  /** Where the camera is after R <- Exp(w) R and t <- t + dt. */
  function moved(change: number[]): Vector3 {
    const angle = Math.hypot(change[0]!, change[1]!, change[2]!);
    const by = angle > 0 ? Math.sin(angle / 2) / angle : 0;
    const turn: Quaternion = [
      Math.cos(angle / 2),
      change[0]! * by,
      change[1]! * by,
      change[2]! * by,
    ];
    return cameraCentre(
      after(turn, rotation),
      add(translation, change.slice(3) as unknown as Vector3),
    );
  }

  test("follows the derivatives of the position, by differences", () => {
    const root = Array.from({ length: 36 }, (_, i) => Math.sin(3.1 * i + 0.4) / 100);
    const covariance = Array.from({ length: 36 }, (_, i) => {
      const [row, column] = [Math.floor(i / 6), i % 6];
      return root
        .slice(0, 6)
        .reduce((sum, _v, k) => sum + root[6 * row + k]! * root[6 * column + k]!, 0);
    });
    const step = 1e-5;
    const jacobian = Array.from({ length: 6 }, (_, k) => {
      const change = (sign: number): number[] =>
        Array.from({ length: 6 }, (_v, i) => (i === k ? sign * step : 0));
      const [ahead, back] = [moved(change(1)), moved(change(-1))];
      return ahead.map((v, axis) => (v - back[axis]!) / (2 * step));
    });
    const expected = Array.from({ length: 9 }, (_, i) => {
      let sum = 0;
      for (let a = 0; a < 6; a++) {
        for (let b = 0; b < 6; b++) {
          const [row, column] = [Math.floor(i / 3), i % 3];
          sum += jacobian[a]![row]! * covariance[6 * a + b]! * jacobian[b]![column]!;
        }
      }
      return sum;
    });
    expectClose(positionCovariance(rotation, translation, covariance), expected, 7);
  });

  test("of a translation alone is turned to the world", () => {
    const covariance = new Array<number>(36).fill(0);
    covariance[21] = 4; // x of the camera
    const quarter: Quaternion = [HALF, 0, 0, HALF]; // x of the camera is -y of the world
    expectClose(positionCovariance(quarter, [0, 0, 0], covariance), [0, 0, 0, 0, 4, 0, 0, 0, 0]);
  });
});

describe("ellipsoids", () => {
  test("eigenvalues come largest first, with a right-handed frame that gives the matrix back", () => {
    const turn = rotationMatrix(unit(0.4, 0.8, -0.1, 0.5));
    const matrix = multiply(turn, multiply([1, 0, 0, 0, 9, 0, 0, 0, 4], transposed(turn)));
    const { values, vectors } = symmetricEigen(matrix);
    expectClose(values, [9, 4, 1]);
    const stretched: Matrix3 = [values[0], 0, 0, 0, values[1], 0, 0, 0, values[2]];
    expectClose(multiply(vectors, multiply(stretched, transposed(vectors))), matrix);
    const [a, b, c] = [0, 1, 2].map((i) => apply(transposed(vectors), unitAxis(i)));
    expect(determinant([...a!, ...b!, ...c!] as Matrix3)).toBeCloseTo(1);
  });

  test("keep very small axes beside large ones", () => {
    const { values } = symmetricEigen([1e6, 1e-3, 0, 1e-3, 1e-6, 0, 0, 0, 1]);
    expectClose(values, [1e6, 1, 1e-6 - 1e-12]);
  });

  test("reach 2.795 standard deviations: the 95 % of three dimensions", () => {
    expect(REACH_95).toBeCloseTo(2.7955, 4);
    const { halfAxes } = ellipsoid95([0.25, 0, 0, 0, 0.01, 0, 0, 0, 0]);
    expectClose(halfAxes, [0.5 * REACH_95, 0.1 * REACH_95, 0]);
  });

  test("a variance that rounding left below zero is none", () => {
    expect(ellipsoid95([1, 0, 0, 0, 1, 0, 0, 0, -1e-18]).halfAxes[2]).toBe(0);
  });
});

function unitAxis(i: number): Vector3 {
  return [0, 1, 2].map((k) => (k === i ? 1 : 0)) as Vector3;
}

function determinant([a, b, c, d, e, f, g, h, i]: Matrix3): number {
  return a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g);
}

describe("the corners of an image", () => {
  const camera = (model: string, params: number[]): Camera => ({
    model,
    width: 640,
    height: 480,
    params,
  });

  test.each([
    ["PINHOLE", [500, 400, 300, 260]],
    ["OPENCV", [500, 400, 300, 260, 0.1, 0, 0, 0]],
    ["FULL_OPENCV", [500, 400, 300, 260, 0, 0, 0, 0, 0, 0, 0, 0]],
  ])("%s has two focal lengths", (model, params) => {
    expectClose(cornerRays(camera(model, params))[0]!, [-300 / 500, -260 / 400, 1]);
    expectClose(cornerRays(camera(model, params))[2]!, [340 / 500, 220 / 400, 1]);
  });

  test.each([
    ["SIMPLE_PINHOLE", [500, 300, 260]],
    ["SIMPLE_RADIAL", [500, 300, 260, 0.1]],
    ["RADIAL", [500, 300, 260, 0.1, 0.2]],
  ])("%s has one focal length", (model, params) => {
    expectClose(cornerRays(camera(model, params))[1]!, [340 / 500, -260 / 500, 1]);
  });

  test("of a fisheye are cut off at 65 degrees", () => {
    const [corner] = cornerRays(camera("OPENCV_FISHEYE", [200, 200, 320, 240, 0, 0, 0, 0]));
    expect(Math.hypot(corner![0], corner![1])).toBeCloseTo(Math.tan((65 / 180) * Math.PI));
    expect(corner![0] / corner![1]).toBeCloseTo(320 / 240);
  });

  test("of a fisheye lie at the angle that is the radius over the focal length", () => {
    const [corner] = cornerRays(camera("SIMPLE_RADIAL_FISHEYE", [800, 320, 240, 0]));
    expect(Math.atan(Math.hypot(corner![0], corner![1]))).toBeCloseTo(400 / 800);
  });

  test("lie in the world where the pose puts them", () => {
    const quarter: Quaternion = [HALF, HALF, 0, 0]; // about x: z of the camera is -y of the world
    expectClose(frustumCorners([1, 2, 3], quarter, [[0, 0, 1]], 2)[0]!, [1, 0, 3]);
  });
});

describe("up", () => {
  test("is against gravity where it is known", () => {
    expectClose(worldUp([0, 0, -2], []), [0, 0, 1]);
  });

  test("is where photos have their upper edge otherwise", () => {
    const orientations = [unit(1, 0.1, 0, 0), unit(1, -0.1, 0, 0)];
    const images = orientations.map((orientation) => ({ orientation }));
    expectClose(worldUp([], images), [0, -1, 0]);
  });

  test("is not led astray by photos that all look down", () => {
    // Turned about the world's -y by 0 and 90 degrees, then each 30 degrees down about its own x.
    const down: Quaternion = [Math.cos(Math.PI / 12), -Math.sin(Math.PI / 12), 0, 0];
    const aside: Quaternion = [HALF * down[0], HALF * down[1], HALF * down[0], -HALF * down[1]];
    const images = [down, aside].map((orientation) => ({ orientation }));
    const up = worldUp([], images);
    expect(up[1]).toBeLessThan(-0.999);
  });

  test("is that of the first photo where photos cancel each other out", () => {
    const images = [IDENTITY, unit(0, 0, 0, 1)].map((orientation) => ({ orientation }));
    expectClose(worldUp([], images), [0, -1, 0]);
  });
});

describe("lengths", () => {
  test.each([
    [0.7, 0.5],
    [1, 1],
    [1000, 1000],
    [0.001, 0.001],
    [19.9, 10],
    [49, 20],
    [3e-7, 2e-7],
  ])("of at most %f are rounded down to %f", (most, nice) => {
    expect(niceLength(most)).toBeCloseTo(nice, 12);
  });

  test("are told in the unit that people use", () => {
    const said = [2000, 5, 0.2, 0.005].map((v) => lengthText(v, true));
    expect(said).toEqual(["2 km", "5 m", "20 cm", "5 mm"]);
    expect(lengthText(0.2, false)).toBe("0.2 units");
    expect(lengthText(1, false)).toBe("1 unit");
  });

  test("between cameras are those to the nearest", () => {
    const places: Vector3[] = [
      [0, 0, 0],
      [1, 0, 0],
      [3, 0, 0],
      [4, 0, 0],
    ];
    expect(medianSpacing(places)).toBe(1);
    expect(medianSpacing([[0, 0, 0]])).toBeNull();
  });

  test("percentiles are values of the list", () => {
    expect(percentile([5, 1, 3], 0.5)).toBe(3);
    expect(percentile([], 0.5)).toBeNaN();
    expectClose(normalized([0, 0, 0]), [0, 0, 0]);
  });
});
