// The landmarks of a map, page by page.
import { PointsError, type PointBlock } from "visloc-client";

/** More would not make a better picture, and a phone has no room for them. */
export const MAX_POINTS = 3_000_000;
// The first page is small, so that there is a picture soon.
const FIRST_PAGE = 20_000;
const PAGE = 131_072;

export type FetchPage = (first: number, count: number, signal?: AbortSignal) => Promise<PointBlock>;

/**
 * Read landmarks page by page, coarse to fine, the next page on its way while one is shown.
 *
 * Returns how many came, once `limit` or all of the map have. Throws what `fetchPage` throws, an
 * AbortError after `signal`, and PointsError for pages that do not fit together.
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
    const block = await next;
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
