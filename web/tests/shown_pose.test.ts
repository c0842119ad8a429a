import { expect, test } from "vitest";
import type { Candidate, LocalizeResponse } from "visloc-client";
import { shownPlaces } from "../src/page/shown_pose";

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
