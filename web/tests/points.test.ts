import { describe, expect, test } from "vitest";
import { parsePoints, PointsError, type PointBlock } from "visloc-client";
import { streamPoints, type FetchPage } from "../src/points";

interface Page {
  magic?: string;
  version?: number;
  total?: number;
  first?: number;
  count?: number;
  flags?: number;
  origin?: number[];
  bytes?: number;
}

function page(given: Page = {}): ArrayBuffer {
  const count = given.count ?? 2;
  const body = new ArrayBuffer(given.bytes ?? 48 + 16 * count);
  const view = new DataView(body);
  [...(given.magic ?? "VLPT")].forEach((c, i) => view.setUint8(i, c.charCodeAt(0)));
  const numbers = [given.version ?? 1, given.total ?? 10, given.first ?? 0, count];
  [...numbers, given.flags ?? 1].forEach((v, i) => view.setUint32(4 + 4 * i, v, true));
  (given.origin ?? [1, 2, 3]).forEach((v, i) => view.setFloat64(24 + 8 * i, v, true));
  return body;
}

/** A map of so many landmarks whose row r begins with r. */
function mapOf(total: number, asked: [number, number][] = []): FetchPage {
  return async (first, count) => {
    asked.push([first, count]);
    const sent = Math.max(0, Math.min(count, total - first));
    const body = page({ total, first, count: sent });
    for (let i = 0; i < sent; i++) new DataView(body).setFloat32(48 + 16 * i, first + i, true);
    return parsePoints(body);
  };
}

describe("a page of landmarks", () => {
  test("is read as it was written", () => {
    const body = page({ total: 7, first: 3, count: 2 });
    new DataView(body).setFloat32(48 + 16, 2.5, true);
    const block = parsePoints(body);
    expect(block).toMatchObject({ total: 7, first: 3, count: 2, coloured: true });
    expect(block.origin).toEqual([1, 2, 3]);
    expect(new Float32Array(block.rows)[4]).toBe(2.5);
    expect(block.rows.byteLength).toBe(32);
  });

  test("says when the map keeps no colours", () => {
    expect(parsePoints(page({ flags: 0 })).coloured).toBe(false);
  });

  test("beyond the end of the map is empty", () => {
    expect(parsePoints(page({ total: 5, first: 9, count: 0 })).count).toBe(0);
  });

  test.each<[string, ArrayBuffer, RegExp]>([
    ["of nothing", new ArrayBuffer(0), /0 bytes/],
    ["of another kind", page({ magic: "GIF8" }), /expected VLPT first, got 47 49 46 38/],
    ["of a later format", page({ version: 2 }), /format 2, this client reads 1/],
    ["cut off", page({ count: 2, bytes: 70 }), /2 landmarks take 80 bytes, but 70 came/],
    ["too long", page({ count: 2, bytes: 96 }), /but 96 came/],
    [
      "of more rows than anyone has",
      page({ count: 4294967295, total: 4294967295, bytes: 48 }),
      /take/,
    ],
    ["beyond the map", page({ total: 4, first: 3, count: 2 }), /3 to 5 of 4/],
    ["nowhere", page({ origin: [NaN, 0, 0] }), /relative to NaN/],
  ])("%s is refused", (_name, body, message) => {
    expect(() => parsePoints(body)).toThrow(PointsError);
    expect(() => parsePoints(body)).toThrow(message);
  });
});

describe("landmarks page by page", () => {
  test("come whole and in order, a small page first", async () => {
    const asked: [number, number][] = [];
    const blocks: PointBlock[] = [];
    const read = await streamPoints(mapOf(300_000, asked), (block) => blocks.push(block));
    expect(read).toBe(300_000);
    expect(asked[0]).toEqual([0, 20_000]);
    const rows = blocks.flatMap((block) => [block.first, block.first + block.count]);
    expect(rows).toEqual([0, 20_000, 20_000, 151_072, 151_072, 282_144, 282_144, 300_000]);
    expect(new Float32Array(blocks[1]!.rows)[0]).toBe(20_000);
  });

  test("stop at the limit", async () => {
    const asked: [number, number][] = [];
    expect(await streamPoints(mapOf(1e6, asked), () => undefined, undefined, 25_000)).toBe(25_000);
    expect(asked).toEqual([
      [0, 20_000],
      [20_000, 5_000],
    ]);
  });

  test("the next page is on its way while one is shown", async () => {
    const asked: [number, number][] = [];
    const seen: number[] = [];
    await streamPoints(mapOf(30_000, asked), () => seen.push(asked.length));
    expect(seen).toEqual([2, 2]);
  });

  test("of an empty map are none", async () => {
    expect(await streamPoints(mapOf(0), () => expect.unreachable())).toBe(0);
  });

  test("stop where they are aborted", async () => {
    const stop = new AbortController();
    const blocks: PointBlock[] = [];
    const reading = streamPoints(
      mapOf(300_000),
      (block) => {
        blocks.push(block);
        stop.abort();
      },
      stop.signal,
    );
    await expect(reading).rejects.toThrow(/abort/i);
    expect(blocks).toHaveLength(1);
  });

  test("a page that fails later is told after those before", async () => {
    const good = mapOf(50_000);
    const failing: FetchPage = (first, count) =>
      first === 0 ? good(first, count) : Promise.reject(new Error("gone"));
    const blocks: PointBlock[] = [];
    await expect(streamPoints(failing, (block) => blocks.push(block))).rejects.toThrow("gone");
    expect(blocks).toHaveLength(1);
  });

  test.each<[string, Page, RegExp]>([
    ["of another place", { total: 30_000, first: 5, count: 1 }, /from 20000 on, got those from 5/],
    ["of another map", { total: 40_000, first: 20_000, count: 1 }, /changed while/],
    ["from elsewhere", { total: 30_000, first: 20_000, count: 1, origin: [9, 9, 9] }, /changed/],
    ["without landmarks", { total: 30_000, first: 20_000, count: 0 }, /No landmarks came after/],
  ])("a second page %s is refused", async (_name, second, message) => {
    const good = mapOf(30_000);
    const fetchPage: FetchPage = async (first, count) =>
      first === 0 ? good(first, count) : parsePoints(page(second));
    await expect(streamPoints(fetchPage, () => undefined)).rejects.toThrow(message);
  });
});
