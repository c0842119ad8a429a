import { expect, test } from "vitest";
import type { LocalizeResponse } from "visloc-client";
import { poseLink, sharedPose, type SharedPose } from "../src/page/share";

const PAGE = new URL("https://maps.example.org/visloc/?x=1#map=other");
const ANSWER = {
  request_id: "abc-1",
  map: { id: "große halle", version: "2026-7" },
  pose: {
    cam_from_world: { rotation_wxyz: [1, 0, 0, 0], translation: [-1.25, -2, -3] },
    ...{ position: [1.25, 2, 3], orientation: [1, 0, 0, 0], probability: 0.99816 },
    covariance: Array.from({ length: 36 }, (_, i) => (i % 7 === 0 ? [1e-12, 4e-4][+(i > 20)]! : 0)),
  },
  camera: { model: "SIMPLE_PINHOLE", width: 4, height: 3, params: [4, 2, 1.5], source: "exif" },
  geopose: {
    position: { lat: 46.84254822, lon: -91.99370322, h: 198.65 },
    quaternion: { x: 0, y: 0, z: Math.SQRT1_2, w: Math.SQRT1_2 },
  },
} as unknown as LocalizeResponse;

const link = (answer = ANSWER): URL => new URL(poseLink(PAGE, answer)!);

test("a link holds the pose, its map's version and where on Earth it is", () => {
  expect(link().href).toMatch(/^https:\/\/maps\.example\.org\/visloc\/#map=/);
  const read = sharedPose(link().hash) as SharedPose;

  expect(read.map).toBe("große halle@2026-7");
  expect(read.shown.position).toEqual([1.25, 2, 3]);
  expect(read.shown.orientation).toEqual([1, 0, 0, 0]);
  expect(read.shown.camera.params).toEqual([4, 2, 1.5]);
  [0, 4, 8].forEach((i) => expect(read.shown.positionCovariance[i]).toBeCloseTo(4e-4, 7));
  expect(read.probability).toBe(0.998);
  expect(read.geopose!.position).toEqual(ANSWER.geopose!.position);
  expect(read.geopose!.quaternion.z).toBeCloseTo(Math.SQRT1_2, 6);
  expect(read.request).toBe("abc-1");
});

test("a map without a place, and a pose that was not judged, have links too", () => {
  const pose = { ...ANSWER.pose!, probability: null };
  const read = sharedPose(link({ ...ANSWER, geopose: null, pose }).hash) as SharedPose;
  expect([read.geopose, read.probability]).toEqual([null, null]);
});

test("a refused photo has no link", () => {
  expect(poseLink(PAGE, { ...ANSWER, pose: null })).toBeNull();
});

test("an address without a pose is a link to a map only", () => {
  expect(sharedPose("#map=kitchen")).toBeNull();
  expect(sharedPose("")).toBeNull();
});

test.each([
  ["cut off", link().hash.slice(0, link().hash.indexOf("camera"))],
  ["without a map", link().hash.replace(/map=[^&]*&/, "")],
  ["with words for numbers", link().hash.replace("1.25", "here")],
  ["with a number missing", link().hash.replace("1.25,", "")],
  ["with a number that is none", link().hash.replace("1.25", "")],
  ["with a rotation that is none", link().hash.replace("3,1,0,0,0", "3,1,1,0,0")],
  ["with another thing for a camera", link().hash.replace("SIMPLE_PINHOLE", "<img src=x>")],
  ["with half of a place", link().hash.replace(/earth=[^&]*/, "earth=46.8,-91.9")],
  ["with a number too large to draw", link().hash.replace("1.25", "1e300")],
  ["with a number that is infinite", link().hash.replace("1.25", "Infinity")],
  ["with a negative variance", link().hash.replace("spread=", "spread=-")],
  ["without a focal length", link().hash.replace("SIMPLE_PINHOLE,4,3,4,2", "PINHOLE,4,3,4,0")],
  ["of no latitude", link().hash.replace("46.8", "146.8")],
  ["of no heading", link().hash.replace(/(earth=[^&]*,)[^,&]*/, "$15")],
  ["more than certain", link().hash.replace("probability=0", "probability=7")],
])("a link %s is damaged", (_, hash) => {
  expect(sharedPose(hash)).toBe("damaged");
});
