import { expect, test } from "vitest";
import type { Candidate, LocalizeResponse, PoseEstimate } from "visloc-client";
import { isSure, shownPlaces, verdictOf } from "../src/page/shown_pose";

const HALL = { id: "hall", version: "v1" };

function candidate(x: number, map = HALL): Candidate {
  return {
    ...{ map, tile: null, position: [x, 0, 0], orientation: [1, 0, 0, 0] },
    ...{ inliers: 40, image: "door.jpg", preference: 0.3 },
  };
}

function refusedWith(...candidates: Candidate[]): LocalizeResponse {
  return {
    map: HALL,
    pose: null,
    refusal: { stage: "gate", reason: "ambiguous", message: "two doors", candidates },
    camera: { model: "SIMPLE_PINHOLE", width: 4, height: 3, params: [4, 2, 1.5], source: "given" },
  } as unknown as LocalizeResponse;
}

test.each([
  [0.98, true, "Localized", ""],
  [0.9, true, "Localized", ""],
  [0.85, false, "Perhaps here", "0.85"],
  [0.42, false, "Perhaps here", "0.42"],
  [0, false, "Perhaps here", "0.00"],
  [null, false, "Localized", "did not judge"],
])("a pose of probability %s is sure: %s", (probability, sure, name, doubt) => {
  const pose = { probability } as PoseEstimate;
  expect(isSure(pose)).toBe(sure);
  expect(verdictOf(pose).name).toBe(name);
  expect(verdictOf(pose).doubt).toContain(doubt);
  expect(verdictOf(pose).doubt === "").toBe(sure);
});

test("both places of an ambiguous photo are drawn, with its camera", () => {
  const places = shownPlaces(refusedWith(candidate(1), candidate(7)));

  expect(places.map(({ position }) => position[0])).toEqual([1, 7]);
  expect(places[0]!.camera.params).toEqual([4, 2, 1.5]);
  expect(places[0]!.positionCovariance).toBeUndefined();
});

test("a place in the frame of another map is not drawn in this one", () => {
  const places = shownPlaces(
    refusedWith(candidate(1, { id: "shed", version: "v1" }), candidate(7)),
  );

  expect(places.map(({ position }) => position[0])).toEqual([7]);
});

test("a photo refused for another reason is drawn nowhere", () => {
  expect(shownPlaces(refusedWith())).toEqual([]);
});

test("a coarse place is drawn with its spread", () => {
  const covariance = Array.from({ length: 36 }, (_, i) =>
    i % 7 === 0 ? [1e-9, 4][+(i > 20)]! : 0,
  );
  const answer = {
    ...refusedWith(),
    status: "coarse",
    coarse: {
      cam_from_world: { rotation_wxyz: [1, 0, 0, 0], translation: [-1, -2, -3] },
      ...{ position: [1, 2, 3], orientation: [1, 0, 0, 0], covariance },
      ...{ position_std: [2, 2, 2], orientation_std_deg: [1, 1, 1], method: "bdi" },
    },
  } as unknown as LocalizeResponse;

  const [place, ...others] = shownPlaces(answer);

  expect(others).toEqual([]);
  expect(place!.position).toEqual([1, 2, 3]);
  // A standard deviation of 2 in each direction.
  [4, 4, 4].forEach((variance, i) => {
    expect(place!.positionCovariance![4 * i]).toBeCloseTo(variance, 5);
  });
});
