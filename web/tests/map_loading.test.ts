import { afterEach, beforeEach, describe, expect, test, vi } from "vitest";
import {
  ownError,
  parsePoints,
  ServiceError,
  type Client,
  type MapImages,
  type MapInfo,
} from "visloc-client";
import { loadMap, movedBlock, shownTiles } from "../src/page/map_loading";
import { patiently } from "../src/page/patience";
import type { Viewer } from "../src/viewer/types";

const MAP = {
  ...{ id: "kitchen", version: "7", metric: true, down: [] as number[] },
  extent: { min: [0, 0, 0], max: [2, 4, 6] },
} as MapInfo;
const UPRIGHT = [0.5, -0.5, 0.5, -0.5] as const; // world_from_cam: y down becomes z down
const IMAGES = {
  ...{ total: 1, first: 0, cameras: {} },
  images: [{ name: "a", camera: "0", position: [0, 0, 0], orientation: [...UPRIGHT] }],
} as unknown as MapImages;

/** A body of GET /maps/{ref}/points with all of `total` landmarks. */
function points(total: number): ArrayBuffer {
  const body = new ArrayBuffer(48 + 16 * total);
  const view = new DataView(body);
  new Uint8Array(body).set([0x56, 0x4c, 0x50, 0x54]);
  [1, total, 0, total, 0].forEach((value, i) => view.setUint32(4 + 4 * i, value, true));
  return body;
}

function busy(status: number, wait: number | null): ServiceError {
  const { problem } = ownError("server.busy", "Busy", "busy");
  return new ServiceError({ ...problem, status }, wait);
}

/** What the viewer and the page were told, in order. */
function load(service: Partial<Client>, map = MAP) {
  const told: string[] = [];
  const viewer = {
    reset: ({ up }: { up: number[] }) => told.push(`reset ${up.map(Math.round).join()}`),
    addPoints: ({ count }: { count: number }) => told.push(`points ${count}`),
    setMappingCameras: (images: unknown[]) => told.push(`cameras ${images.length}`),
  } as unknown as Viewer;
  const given = new AbortController();
  const whole: Partial<Client> = {
    images: async () => structuredClone(IMAGES),
    points: async () => parsePoints(points(3)),
    ...service,
  };
  const done = loadMap(map, patiently(whole as Client), viewer, {
    signal: given.signal,
    onReset: () => told.push("forgotten"),
    onBlock: () => undefined,
    onEnd: (loaded, total) => told.push(`${loaded} of ${total}`),
    onImages: () => undefined,
  });
  return { done, told, give_up: () => given.abort() };
}

beforeEach(() => void vi.useFakeTimers());
afterEach(() => void vi.useRealTimers());

describe("a map", () => {
  test("that says which way is down is there at once", async () => {
    const { done, told } = load({}, { ...MAP, down: [0, 0, -1] });
    await done;
    expect(told.slice(0, 2)).toEqual(["reset 0,0,1", "forgotten"]);
    expect(told.slice(2).sort()).toEqual(["cameras 1", "points 3"]);
  });

  test("that does not is turned as its photos were held before its landmarks come", async () => {
    const { done, told } = load({});
    await done;
    expect(told.filter((text) => text.startsWith("reset"))).toHaveLength(2);
    expect(told.indexOf("points 3")).toBeGreaterThan(told.lastIndexOf("forgotten"));
  });

  test.each(["images", "points"])(
    "whose %s fail leaves nothing of the one before",
    async (what) => {
      const { done, told } = load({ [what]: () => Promise.reject(busy(500, null)) });
      await expect(done).rejects.toThrow("busy");
      expect(told[0]).toMatch(/^reset/);
    },
  );

  test("that is not wanted any more draws nothing, whatever still comes", async () => {
    let send: (images: MapImages) => void = () => undefined;
    const images = (): Promise<MapImages> => new Promise((done) => (send = done));
    const { done, told, give_up } = load({ images });
    const ended = expect(done).rejects.toThrow();
    give_up();
    const before = told.length;
    send(IMAGES);
    await ended;
    expect(told).toHaveLength(before);
  });

  test("waits for a busy service as long as that asks", async () => {
    const failures = [busy(429, 2), busy(503, 3)];
    const asked = vi.fn(async () => {
      const failure = failures.shift();
      if (failure !== undefined) throw failure;
      return parsePoints(points(3));
    });
    const { done, told } = load({ points: asked });
    await vi.advanceTimersByTimeAsync(1_900);
    expect(asked).toHaveBeenCalledTimes(1);
    await vi.advanceTimersByTimeAsync(3_200);
    await done;
    expect(asked).toHaveBeenCalledTimes(3);
    expect(told).toContain("points 3");
  });

  test.each([
    ["always busy", busy(429, 1)],
    ["busy for long", busy(503, 600)],
  ])("is given up, in the words of the service, when that is %s", async (_, failure) => {
    const asked = vi.fn(() => Promise.reject(failure));
    const { done } = load({ points: asked });
    const ended = expect(done).rejects.toBe(failure);
    await vi.advanceTimersByTimeAsync(60_000);
    await ended;
    expect(asked.mock.calls.length).toBeLessThan(10);
  });

  test("that waits is not asked for when another one was chosen", async () => {
    const asked = vi.fn(() => Promise.reject(busy(429, 2)));
    const { done, give_up } = load({ points: asked });
    const ended = expect(done).rejects.toThrow();
    await vi.advanceTimersByTimeAsync(100);
    give_up();
    await vi.advanceTimersByTimeAsync(10_000);
    await ended;
    expect(asked).toHaveBeenCalledTimes(1);
  });
});

describe("a set", () => {
  const moved = {
    // A quarter turn about z, at half the size.
    rotation_wxyz: [Math.SQRT1_2, 0, 0, Math.SQRT1_2] as [number, number, number, number],
    translation: [10, 0, 1] as [number, number, number],
    scale: 0.5,
  };
  const tile = { map: "kitchen", version: "7", set_from_tile: moved };

  test("shows its tiles, and asks for each by its version", async () => {
    const asked: string[] = [];
    const set = { ...MAP, id: "house", kind: "set", landmarks: 6, images: 2 } as MapInfo;
    const { done, told } = load(
      {
        points: async (ref) => (asked.push(ref), parsePoints(points(3))),
      },
      { ...set, tiles: [tile, { ...tile, map: "hall" }] },
    );
    await done;
    expect(asked).toEqual(["kitchen@7", "hall@7"]);
    expect(told.slice(-4)).toEqual(["points 3", "points 3", "6 of 6", "cameras 2"]);
  });

  test("of more landmarks than are shown says when all that are shown are here", async () => {
    const set = { ...MAP, id: "house", kind: "set", landmarks: 600_000, images: 1 } as MapInfo;
    const { done, told } = load({}, { ...set, tiles: [tile] });
    await done;
    expect(told).toContain("3 of 600000");
  });

  test("has the landmarks of a tile in its own frame", () => {
    const body = points(1);
    const view = new DataView(body);
    view.setFloat64(24, 4, true); // the origin is (4, 0, 0)
    view.setFloat32(48, 2, true); // and the landmark 2 further
    const block = movedBlock(parsePoints(body), tile);
    const row = new DataView(block.rows);
    const at = [0, 1, 2].map((axis) => row.getFloat32(4 * axis, true) + block.origin[axis]!);
    [10, 3, 1].forEach((value, axis) => expect(at[axis]).toBeCloseTo(value));
  });
});

test("a set of more maps than are shown says how many are", () => {
  const setOf = (count: number): MapInfo =>
    ({ ...MAP, kind: "set", tiles: new Array(count).fill({}) }) as MapInfo;
  expect(shownTiles(setOf(10_000))).toMatch(/^The first 200 of 10.000 maps are shown\.$/);
  expect(shownTiles(setOf(200))).toBe("");
  expect(shownTiles({ ...MAP, kind: "map", tiles: [] } as MapInfo)).toBe("");
});
