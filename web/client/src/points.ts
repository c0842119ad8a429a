// Landmarks as GET /maps/{ref}/points sends them (docs/api.md).
import type { Vector3 } from "./words.js";

export const ROW_BYTES = 16;
const HEADER_BYTES = 48;
const MAGIC = "VLPT";
const VERSION = 1;
const KEEPS_COLOURS = 1;

/**
 * Landmarks in the order of their level of detail: every beginning is an even sample of the map.
 * Rows of 16 bytes, as the service sends them: x, y, z float32 relative to `origin`, then red,
 * green, blue and the number of photos that see the landmark, each a byte.
 */
export interface PointBlock {
  /** Landmarks of the whole map. */
  total: number;
  /** Rank of the first one of this block. */
  first: number;
  count: number;
  coloured: boolean;
  origin: Vector3;
  rows: ArrayBuffer;
}

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
      `The landmarks are of format ${version}, this client reads ${VERSION}: update it, or reload the page.`,
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
