import { describe, expect, test } from "vitest";
import type { Vector3 } from "visloc-client";
import { apply, rotationMatrix, viewingDirection } from "../src/geometry";
import {
  directionOf,
  headingOf,
  headingsApart,
  nearestDirection,
  onPlan,
  orientationOf,
  petal,
  planBox,
} from "../src/report/plan";

// A world whose z is up, seen with x to the right.
const UPRIGHT = { right: [1, 0, 0] as Vector3, ahead: [0, 1, 0] as Vector3 };
// As cameras without gravity often have it: y down, so that up is -y.
const Y_DOWN = { right: [1, 0, 0] as Vector3, ahead: [0, 0, 1] as Vector3 };
const DIRECTIONS = Array.from({ length: 12 }, (_, index) => 30 * index);

function expectClose(got: Vector3, expected: Vector3): void {
  got.forEach((value, axis) => expect(value).toBeCloseTo(expected[axis]!, 12));
}

describe("the plan", () => {
  test("has right to the right and ahead up", () => {
    expect(onPlan(UPRIGHT, [2, 3, 9])).toEqual({ x: 2, y: -3 });
    expect(onPlan(Y_DOWN, [2, 9, 3])).toEqual({ x: 2, y: -3 });
  });

  test("measures headings from right towards ahead", () => {
    expect(headingOf(UPRIGHT, [1, 0, 0])).toBe(0);
    expect(headingOf(UPRIGHT, [0, 1, -5])).toBe(90);
    expect(headingOf(UPRIGHT, [0, -1, 0])).toBe(270);
  });

  test("gives no heading to what looks straight down", () => {
    expect(headingOf(UPRIGHT, [0, 0, -1])).toBeNull();
  });

  test("takes headings the short way round", () => {
    expect(headingsApart(350, 10)).toBe(20);
    expect(headingsApart(10, 350)).toBe(20);
    expect(headingsApart(-180, 180)).toBe(0);
    expect(nearestDirection(DIRECTIONS, 350)).toBe(0);
    expect(nearestDirection(DIRECTIONS, -100)).toBe(9);
  });

  test("is not shrunk by landmarks on the horizon", () => {
    const near = Array.from({ length: 99 }, (_, index) => ({ x: index / 99, y: 0.5 }));
    const shown = [
      { x: 0, y: 0 },
      { x: 1, y: 1 },
    ];
    const box = planBox(shown, [...near, { x: 1e6, y: -1e6 }], 0.2);
    expect(box.min).toEqual({ x: -0.1, y: -0.1 });
    expect(box.max.x).toBeLessThan(1.5);
  });

  test("has a size when there is one photo and no landmark", () => {
    const box = planBox([{ x: 5, y: 5 }], [], 1);
    expect(box).toEqual({ min: { x: 4.5, y: 4.5 }, max: { x: 5.5, y: 5.5 } });
  });
});

describe("a camera of the coverage", () => {
  for (const [name, axes, up] of [
    ["z up", UPRIGHT, [0, 0, 1]],
    ["y down", Y_DOWN, [0, -1, 0]],
  ] as [string, typeof UPRIGHT, Vector3][]) {
    test(`looks along its heading and below the level (${name})`, () => {
      for (const heading of DIRECTIONS) {
        const coverage = { ...axes, pitch_deg: 10 };
        const direction = directionOf(coverage, heading);
        const down = -direction.reduce((sum, value, axis) => sum + value * up[axis]!, 0);
        expect(down).toBeCloseTo(Math.sin((10 * Math.PI) / 180), 12);
        expect(headingsApart(headingOf(axes, direction)!, heading)).toBeCloseTo(0, 9);
        expectClose(viewingDirection(orientationOf(coverage, heading)), direction);
      }
    });

    test(`is held upright: its x axis is level, its y axis points down (${name})`, () => {
      for (const heading of DIRECTIONS) {
        const rotation = rotationMatrix(orientationOf({ ...axes, pitch_deg: -5 }, heading));
        const along = (axis: Vector3) =>
          apply(rotation, axis).reduce((sum, value, i) => sum + value * up[i]!, 0);
        expect(along([1, 0, 0])).toBeCloseTo(0, 12);
        expect(along([0, 1, 0])).toBeLessThan(-0.9);
      }
    });
  }
});

test("a petal starts at the centre and opens about its heading, up being less y", () => {
  expect(petal({ x: 10, y: 10 }, 4, 90, 180)).toBe(
    "M10.00 10.00L14.00 10.00A4.00 4.00 0 0 0 6.00 10.00Z",
  );
});
