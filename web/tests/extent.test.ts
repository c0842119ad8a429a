import { PerspectiveCamera, Vector3 } from "three";
import { expect, test } from "vitest";
import { extentOf, wholeView } from "../src/viewer/surroundings";

const GROUND = Array.from({ length: 400 }, (_, i) => new Vector3(i % 20, 0, Math.floor(i / 20)));
const FLIGHT = Array.from({ length: 8 }, (_, i) => new Vector3(4 * i, 90, 10));

test("the first view shows every camera, also those far above the landmarks", () => {
  const camera = new PerspectiveCamera(50, 1.4, 0.01, 1000);
  const { position, target } = wholeView(
    extentOf(GROUND, FLIGHT),
    new Vector3(0.55, 0.62, 0.75).normalize(),
    camera,
  );
  camera.position.copy(position);
  camera.lookAt(target);
  camera.updateMatrixWorld();

  const seen = [...GROUND, ...FLIGHT].map((place) => place.clone().project(camera));
  for (const { x, y } of seen) expect(Math.max(Math.abs(x), Math.abs(y))).toBeLessThan(1);
  // Nor is the view further away than that takes.
  expect(Math.max(...seen.map(({ x, y }) => Math.max(Math.abs(x), Math.abs(y))))).toBeGreaterThan(
    0.8,
  );
});

test("a few landmarks far away do not make the map small", () => {
  const { max } = extentOf([...GROUND, new Vector3(9000, 0, 0)], []);
  expect(max.x).toBeLessThan(25);
});

test("a map of cameras alone has an extent, a single one too", () => {
  expect(extentOf([], FLIGHT).max.toArray()).toEqual([28, 90, 10]);
  expect(extentOf([], FLIGHT.slice(0, 1)).radius).toBe(1);
});
