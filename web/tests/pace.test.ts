import { expect, test } from "vitest";
import { Pace } from "../src/viewer/pace";

/** Turn the view on a machine of which a picture takes so long, beside so much per point. */
function turn(pace: Pace, fixed: number, perPoint: number, pictures = 60): void {
  let now = 0;
  for (let i = 0; i < pictures; i++) {
    const drawn = Math.min(pace.points, 1e6);
    pace.moved(now, drawn);
    now += fixed + perPoint * drawn;
  }
}

test("a slow machine draws as many points as fit", () => {
  const pace = new Pace(1e6);
  turn(pace, 10, 2e-4);
  expect(10 + 2e-4 * pace.points).toBeLessThan(46);
  expect(pace.points).toBeGreaterThan(80_000);
  expect(pace.framesPerSecond).toBeGreaterThan(20);
});

test("a fast machine comes to draw all of them", () => {
  const pace = new Pace(40_000);
  turn(pace, 16.7, 0);
  expect(pace.points).toBeGreaterThan(1e6);
  expect(pace.framesPerSecond).toBeCloseTo(59.9, 0);
});

test("a machine that is too slow anyhow still draws some", () => {
  const pace = new Pace(1e6);
  turn(pace, 100, 0);
  expect(pace.points).toBe(20_000);
  expect(pace.framesPerSecond).toBeCloseTo(10, 0);
});

test("a pause between two movements says nothing", () => {
  const pace = new Pace(100_000);
  for (const now of [0, 33, 66, 5066, 5099]) pace.moved(now, 100_000);
  expect(pace.points).toBe(100_000);
  expect(pace.framesPerSecond).toBeNull();
});
