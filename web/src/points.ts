// Landmarks as GET /maps/{ref}/points sends them (docs/api.md), in pages.
import type { Vector3 } from "./api";
import type { PointBlock } from "./viewer/types";

export const ROW_BYTES = 16;
/** More would not make a better picture, and a phone has no room for them. */
export const MAX_POINTS = 3_000_000;
const HEADER_BYTES = 48;
const MAGIC = "VLPT";
const VERSION = 1;
const KEEPS_COLOURS = 1;
// The first page is small, so that there is a picture soon.
const FIRST_PAGE = 20_000;
const PAGE = 131_072;

/** What came instead of landmarks. */
export class PointsError extends Error {
  override name = "PointsError";
}

/** Read one page. Throws PointsError for what is not one. */
export function parsePoints(body: ArrayBuffer): PointBlock {
  if (body.byteLength < HEADER_BYTES) {
    throw new PointsError(
      `The landmarks came as ${body.byteLength} bytes: less than their header of ${HEADER_BYTES}.`,
    );
  }
  const view = new DataView(body);
  const magic = String.fromCharCode(...new Uint8Array(body, 0, 4));
  if (magic !== MAGIC) {
    const got = [...new Uint8Array(body, 0, 4)].map((b) => b.toString(16).padStart(2, "0"));
    throw new PointsError(`These are no landmarks: expected ${MAGIC} first, got ${got.join(" ")}.`);
  }
  const [version, total, first, count, flags] = [4, 8, 12, 16, 20].map((at) =>
    view.getUint32(at, true),
  ) as [number, number, number, number, number];
  if (version !== VERSION) {
    throw new PointsError(
      `The landmarks are of format ${version}, this page reads ${VERSION}: reload the page.`,
    );
  }
  if (count > 0 && first + count > total) {
    throw new PointsError(`Landmarks ${first} to ${first + count} of ${total} came.`);
  }
  const expected = HEADER_BYTES + count * ROW_BYTES;
  if (body.byteLength !== expected) {
    throw new PointsError(
      `${count} landmarks take ${expected} bytes, but ${body.byteLength} came: cut off on the way?`,
    );
  }
  const origin = [24, 32, 40].map((at) => view.getFloat64(at, true)) as Vector3;
  if (!origin.every(Number.isFinite)) {
    throw new PointsError(`The landmarks are relative to ${origin.join(", ")}.`);
  }
  const coloured = (flags & KEEPS_COLOURS) !== 0;
  return { total, first, count, coloured, origin, rows: body.slice(HEADER_BYTES) };
}

export type FetchPage = (
  first: number,
  count: number,
  signal?: AbortSignal,
) => Promise<ArrayBuffer>;

/**
 * Read landmarks page by page, coarse to fine, the next page on its way while one is shown.
 *
 * Returns how many came, once `limit` or all of the map have. Throws what `fetchPage` throws, an
 * AbortError after `signal`, and PointsError for pages that are none or do not fit together.
 */
export async function streamPoints(
  fetchPage: FetchPage,
  onBlock: (block: PointBlock) => void,
  signal?: AbortSignal,
  limit = MAX_POINTS,
): Promise<number> {
  let next = fetchPage(0, Math.min(FIRST_PAGE, limit), signal);
  let head: PointBlock | null = null;
  for (let first = 0; ;) {
    const block = parsePoints(await next);
    signal?.throwIfAborted();
    head ??= block;
    checkFollows(block, head, first);
    first += block.count;
    const left = Math.min(block.total, limit) - first;
    if (left > 0) {
      if (block.count === 0) throw new PointsError(`No landmarks came after ${first}.`);
      next = fetchPage(first, Math.min(PAGE, left), signal);
      // Its failure is told when it is awaited, also where onBlock throws before.
      next.catch(() => undefined);
    }
    if (block.count > 0) onBlock(block);
    if (left <= 0) return first;
  }
}

function checkFollows(block: PointBlock, head: PointBlock, first: number): void {
  if (block.first !== first) {
    throw new PointsError(`Asked for landmarks from ${first} on, got those from ${block.first}.`);
  }
  const same = block.total === head.total && block.origin.every((v, i) => v === head.origin[i]);
  if (!same) {
    throw new PointsError("The map changed while its landmarks were being read: choose it again.");
  }
}
