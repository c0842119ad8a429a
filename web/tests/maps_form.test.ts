import { expect, test } from "vitest";
import type { MapInfo } from "visloc-client";
import { chosenFirst, MAX_OTHERS, offeredMaps } from "../src/page/maps_form";

const map = (id: string, pieces: string[] = []): MapInfo => ({ id, pieces }) as MapInfo;
const ids = (maps: MapInfo[]): string[] => maps.map(({ id }) => id);

test("the other pieces of a build come first, and are chosen", () => {
  const shown = map("room", ["room-2@v1", "room-3@v1"]);
  const maps = [map("hall"), shown, map("room-2"), map("shed")];
  expect(ids(offeredMaps(maps, shown))).toEqual(["room-2", "hall", "shed"]);
  // A piece that is not in use is not listed, and cannot be asked.
  expect(chosenFirst(maps, shown)).toEqual(["room-2"]);
});

test.each([
  ["no map is shown", null, []],
  ["the map has no pieces", map("hall"), ["room", "shed"]],
])("nothing is chosen where %s", (_, shown, offered) => {
  const maps = [map("hall"), map("room"), map("shed")];
  expect(ids(offeredMaps(maps, shown))).toEqual(offered);
  expect(chosenFirst(maps, shown)).toEqual([]);
});

test("no more are chosen than the service searches", () => {
  const pieces = Array.from({ length: 40 }, (_, i) => `room-${i + 2}`);
  const shown = map(
    "room",
    pieces.map((id) => `${id}@v1`),
  );
  expect(
    chosenFirst(
      pieces.map((id) => map(id)),
      shown,
    ),
  ).toHaveLength(MAX_OTHERS);
});
