import { describe, expect, test } from "vitest";
import documentation from "../../docs/api.md?raw";
import type { LocalizeResponse } from "visloc-client";
import { ADVICE, advice, outcomes, STAGES } from "../src/page/refusals";

const section = documentation.split("## When there is no pose")[1]!.split("\n## ")[0]!;
const table = [...section.matchAll(/^\| (\w+) \| `(\w+)` \|.*\| (.*) \|$/gm)].map((row) => ({
  stage: row[1]!,
  reason: row[2]!,
  cell: row[3]!,
}));
// What the documentation says to try, and the page after it.
const KEYWORDS = [
  "camera",
  "top_k",
  "priors",
  "sharper",
  "step back",
  "odometry",
  "config1",
  "map",
];

function refused(
  stage: string,
  reason: string,
  more: Partial<LocalizeResponse> = {},
): LocalizeResponse {
  return {
    refusal: { stage, reason, message: "the message" },
    camera: { source: "given" },
    orientation: { exif: 1, read_as: "stored" },
    ...more,
  } as LocalizeResponse;
}

describe("advice", () => {
  test("the table of the documentation is found", () => {
    expect(table.length).toBeGreaterThanOrEqual(10);
  });

  test.each(table)("there is some for $reason", ({ stage, reason }) => {
    const { meaning, tries } = advice(refused(stage, reason), {});
    expect(meaning).toBe(ADVICE[reason]!.meaning);
    expect(tries.length).toBeGreaterThan(0);
  });

  test.each(table)("for $reason is what the documentation says", ({ stage, reason, cell }) => {
    const tries = advice(refused(stage, reason), { preset: "config1" }).tries.join(" ");
    for (const word of KEYWORDS.filter((one) => cell.toLowerCase().includes(one))) {
      expect(tries.toLowerCase()).toContain(word);
    }
  });

  test("speaks of the preset only when that was chosen", () => {
    const answer = refused("gate", "low_inlier_ratio");
    expect(advice(answer, { preset: "config1" }).tries.join()).toContain("config1");
    expect(advice(answer, {}).tries.join()).not.toContain("config1");
  });

  test("there is none for reasons that the documentation does not know", () => {
    expect(Object.keys(ADVICE).sort()).toEqual(table.map(({ reason }) => reason).sort());
  });

  test("every stage of the documentation is one of the page", () => {
    const stages = STAGES.map(([stage]) => stage as string);
    expect(stages).toEqual(expect.arrayContaining(table.map(({ stage }) => stage)));
  });

  test("asks for the camera first when it was guessed", () => {
    const camera = { source: "guess" } as LocalizeResponse["camera"];
    const first = (more: Partial<LocalizeResponse>): string =>
      advice(refused("gate", "too_few_inliers", more), {}).tries[0]!;
    expect(first({ camera })).toMatch(/^Type the/);
    expect(first({})).not.toMatch(/^Type the/);
  });

  test.each(["too_few_matches", "no_pose", "too_few_inliers", "low_inlier_ratio"])(
    "for %s is to turn the photo first, if it is stored rotated and was read so",
    (reason) => {
      const { stage } = table.find((row) => row.reason === reason)!;
      const camera = { source: "guess" } as LocalizeResponse["camera"];
      const tries = (exif: number, read_as: string): string[] =>
        advice(refused(stage, reason, { camera, orientation: { exif, read_as, turned: 0 } }), {})
          .tries;
      expect(tries(6, "stored")[0]).toContain("upright");
      expect(tries(6, "upright").join()).not.toContain("upright");
      expect(tries(1, "stored").join()).not.toContain("upright");
    },
  );

  test("a reason that is newer than the page is not passed over", () => {
    expect(advice(refused("gate", "toString"), {}).meaning).toContain("does not know the reason");
    expect(advice(refused("gate", "something_new"), {}).tries).toHaveLength(1);
  });
});

describe("how far a photo came", () => {
  test("stops at the stage that gave up", () => {
    expect(outcomes(refused("matching", "too_few_matches"))).toEqual([
      ...["passed", "passed", "stopped", "not_reached", "not_reached"],
    ]);
  });

  test("is the whole way of one that was localized", () => {
    expect(outcomes({ refusal: null } as LocalizeResponse)).toEqual(Array(5).fill("passed"));
  });
});
