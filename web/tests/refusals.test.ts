import { describe, expect, test } from "vitest";
import documentation from "../../docs/api.md?raw";
import type { LocalizeResponse } from "../src/api";
import { ADVICE, advice, outcomes, STAGES } from "../src/page/refusals";

const section = documentation.split("## When there is no pose")[1]!.split("\n## ")[0]!;
const table = [...section.matchAll(/^\| (\w+) \| `(\w+)` \|/gm)].map((row) => ({
  stage: row[1]!,
  reason: row[2]!,
}));

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
    const { meaning, tries } = advice(refused(stage, reason));
    expect(meaning).toBe(ADVICE[reason]!.meaning);
    expect(tries.length).toBeGreaterThan(0);
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
    expect(advice(refused("gate", "too_few_inliers", { camera })).tries[0]).toMatch(/^Type the/);
    expect(advice(refused("gate", "too_few_inliers")).tries[0]).not.toMatch(/^Type the/);
  });

  test("speaks of turning only for a photo that is stored turned", () => {
    const turned = refused("matching", "too_few_matches", {
      orientation: { exif: 6, read_as: "stored" },
    });
    expect(advice(turned).tries.join()).toContain("upright");
    expect(advice(refused("matching", "too_few_matches")).tries.join()).not.toContain("upright");
  });

  test("a reason that is newer than the page is not passed over", () => {
    expect(advice(refused("gate", "toString")).meaning).toContain("does not know the reason");
    expect(advice(refused("gate", "something_new")).tries).toHaveLength(1);
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
