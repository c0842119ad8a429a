import { expect, test } from "vitest";
import type { GeoPose } from "visloc-client";
import { headingOf, headingText, positionText } from "../src/earth";

/** The body turned by yaw (0 east, 90 north), then by pitch (positive looks down), degrees. */
function looking(yaw: number, pitch: number): GeoPose {
  const [a, b] = [yaw, pitch].map((degrees) => (degrees * Math.PI) / 360) as [number, number];
  const quaternion = {
    ...{ w: Math.cos(a) * Math.cos(b), x: -Math.sin(a) * Math.sin(b) },
    ...{ y: Math.cos(a) * Math.sin(b), z: Math.sin(a) * Math.cos(b) },
  };
  return { position: { lat: 46.84254822, lon: -91.99370322, h: 198.65 }, quaternion };
}

test.each([
  [0, 90, "90° (E), level"],
  [90, 0, "0° (N), level"],
  [180, 270, "270° (W), level"],
  [-45, 135, "135° (SE), level"],
])("yaw %d is the heading %d", (yaw, heading, text) => {
  expect(headingOf(looking(yaw, 0)).heading).toBeCloseTo(heading, 6);
  expect(headingText(looking(yaw, 0))).toBe(text);
});

test("a camera that looks up or down says so", () => {
  expect(headingText(looking(90, 30))).toBe("0° (N), 30° down");
  expect(headingText(looking(0, -10.4))).toBe("90° (E), 10° up");
});

test("of a camera that looks straight down, the photo's upper edge has a heading", () => {
  const down = headingOf(looking(90, 90));
  expect(down.steep).toBe(true);
  // The body that looked north and turned down has its upper side in the north.
  expect(Math.cos((down.heading * Math.PI) / 180)).toBeCloseTo(1, 9);
  expect(headingText(looking(45, 86))).toBe(
    "Down, 86° from level; the photo’s upper edge is at 45° (NE)",
  );
});

test("a heading of almost 360 is written as 0", () => {
  expect(headingText(looking(90.2, 0))).toBe("0° (N), level");
});

test("latitude and longitude are written to a centimetre", () => {
  expect(positionText(looking(0, 0))).toBe("46.8425482, -91.9937032");
});
