import { describe, expect, test } from "vitest";
import { likelyShare, quantileOf, ticks } from "../src/report/charts";
import type { HeldOutRun, ReportData } from "../src/report/data";
import { uncertaintyBounds } from "../src/report/scale";
import { worstRuns } from "../src/report/trials";
import {
  byLeftOut,
  classOfChance,
  clock,
  kindestRuns,
  length,
  percent,
  placeName,
  sharesOfChance,
  succeeded,
  verdict,
} from "../src/report/words";

const WITHIN = { position: 0.05, orientation_deg: 5 };

function run(image: number, left_out: number, position_error: number | null): HeldOutRun {
  return {
    image,
    left_out,
    localized: position_error !== null,
    reason: position_error === null ? "too_few_inliers" : null,
    position_error,
    orientation_error_deg: position_error === null ? null : 1,
    inliers: 50,
    expected_inliers: 60,
    probability: 0.8,
  };
}

function data(held_out: HeldOutRun[], probabilities: number[][]): ReportData {
  const cells = probabilities.map((probability, index) => ({
    position: [index, 0, 0],
    probability,
    expected_inliers: probability.map(() => 10),
    position_std: probability.map(() => null),
  }));
  const coverage = {
    within: WITHIN,
    right: [1, 0, 0],
    ahead: [0, 1, 0],
    cells,
    weak_spots: [{ position: [0, 0, 0], direction_deg: 180, probability: 0.03, why: "far" }],
  };
  return { held_out, coverage } as unknown as ReportData;
}

describe("numbers in words", () => {
  test("shares are never rounded to all or nothing", () => {
    expect(percent(0)).toBe("0\u00a0%");
    expect(percent(1)).toBe("100\u00a0%");
    expect(percent(0.999)).toBe("over\u00a099\u00a0%");
    expect(percent(0.001)).toBe("under\u00a01\u00a0%");
    expect(percent(0.974)).toBe("97\u00a0%");
  });

  test("lengths have two digits and a unit", () => {
    expect(length(0.01234, true)).toBe("1.2 cm");
    expect(length(12.34, true)).toBe("12 m");
    expect(length(0.5, false)).toBe("0.5 units");
  });

  test("directions are hours of a clock, twelve being up on the plan", () => {
    expect([90, 0, -90, 180, 60].map(clock)).toEqual(
      [12, 3, 6, 9, 1].map((hour) => `${hour}\u00a0o’clock`),
    );
  });
});

describe("chances", () => {
  test("belong to the class that they reach", () => {
    expect([1, 0.9, 0.8999, 0.5, 0.1, 0.0999, 0].map(classOfChance)).toEqual([
      ...[0, 0, 1, 1, 2, 3, 3],
    ]);
  });

  test("are shared out over all places and directions", () => {
    expect(
      sharesOfChance(
        data(
          [],
          [
            [1, 0.95],
            [0.6, 0],
          ],
        ).coverage,
      ),
    ).toEqual([0.5, 0.25, 0, 0.25]);
    expect(sharesOfChance(data([], []).coverage)).toEqual([0, 0, 0, 0]);
  });
});

describe("held-out trials", () => {
  test("count only within the limits", () => {
    expect(succeeded(run(0, 1, 0.05), WITHIN)).toBe(true);
    expect(succeeded(run(0, 1, 0.06), WITHIN)).toBe(false);
    expect(succeeded(run(0, 1, null), WITHIN)).toBe(false);
  });

  test("of each photo the one with the fewest left out is the kindest", () => {
    const runs = [run(0, 7, null), run(0, 1, 0.01), run(1, 3, 0.02)];
    expect(kindestRuns(runs).map(({ image, left_out }) => [image, left_out])).toEqual([
      [0, 1],
      [1, 3],
    ]);
  });

  test("are grouped by how many were left out, without empty groups", () => {
    const groups = byLeftOut([run(0, 1, 0.01), run(0, 3, 0.01), run(1, 4, 0.01), run(1, 90, null)]);
    expect(groups.map(({ name, runs }) => [name, runs.length])).toEqual([
      ["1", 1],
      ["2 to 4", 2],
      ["50 and more", 1],
    ]);
  });

  test("list refusals first, then those furthest off", () => {
    const runs = [run(0, 1, 0.01), run(1, 1, null), run(2, 1, 0.5), run(2, 9, null)];
    expect(worstRuns(data(runs, [])).map(({ run: { image }, failed }) => [image, failed])).toEqual([
      [1, true],
      [2, true],
      [0, false],
    ]);
  });
});

describe("the verdict", () => {
  test("says how photos fared and where it is weakest", () => {
    const [trials, anywhere, weakest] = verdict(
      data([run(0, 1, 0.01), run(1, 1, null)], [[1], [0.6], [0.2], [0]]),
    );
    expect(trials).toContain("50\u00a0% of trials: 1 of 2 mapping photos");
    expect(anywhere).toContain("50\u00a0% of places and directions");
    expect(weakest).toContain("at the left of the plan, looking towards 9\u00a0o’clock");
  });

  test("says so when nothing could be held out", () => {
    expect(verdict(data([], [[1]]))[0]).toContain("No mapping photo could be held out");
  });

  test("calls the place of a single cell the middle", () => {
    expect(placeName(data([], [[1]]).coverage, { x: 0, y: 0 })).toBe("middle");
  });
});

describe("charts", () => {
  test("have round ticks within the range", () => {
    expect(ticks(0, 1, 5)).toEqual([0, 0.2, 0.4, 0.6, 0.8, 1]);
    expect(ticks(1.5, 16.5, 5)).toEqual([5, 10, 15]);
    expect(ticks(3, 3, 5)).toEqual([3]);
  });

  test("find quantiles within bins", () => {
    const histogram = { edges: [0, 1, 2, 3], counts: [1, 0, 1] };
    expect(quantileOf(histogram, 0.25)).toBe(0.5);
    expect(quantileOf(histogram, 0.75)).toBe(2.5);
    expect(quantileOf(histogram, 1)).toBe(3);
  });

  test("give what chance allows by Wilson's interval", () => {
    const [low, high] = likelyShare(0.5, 10);
    expect(low).toBeCloseTo(0.2366, 4);
    expect(high).toBeCloseTo(0.7634, 4);
    expect(likelyShare(1, 3)[1]).toBe(1);
  });
});

test("classes of uncertainty are of the series 1, 2, 5, about where the values lie", () => {
  expect(uncertaintyBounds([0.004, 0.012, 0.02, 0.03, null])).toEqual([0.02, 0.05, 0.1]);
  expect(uncertaintyBounds([3, 3, 3, 3])).toEqual([5, 10, 20]);
  expect(uncertaintyBounds([null])).toEqual([0.01, 0.02, 0.05]);
});
