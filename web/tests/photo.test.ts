import { describe, expect, test } from "vitest";
import { jpegHeader } from "../src/page/jpeg_header";
import { uprightFromStored } from "../src/page/photo_picture";

const jpeg = (...bytes: number[]): Blob => new Blob([new Uint8Array([0xff, 0xd8, ...bytes])]);
const SOME_SEGMENT = [0xff, 0xe1, 0x00, 0x04, 0x01, 0x02];
const FRAME = [0xff, 0xc2, 0x00, 0x11, 0x08, 0x01, 0xe0, 0x02, 0x80, 0x03];

/** An APP1 segment with these bytes of EXIF data. */
const exif = (...tiff: number[]): number[] => [
  ...[0xff, 0xe1, 0x00, 8 + tiff.length, ...[..."Exif\0\0"].map((c) => c.charCodeAt(0)), ...tiff],
];
// One entry in the directory, the orientation 6, in either order of bytes.
const BIG = [0x4d, 0x4d, 0, 42, 0, 0, 0, 8, 0, 1, 0x01, 0x12, 0, 3, 0, 0, 0, 1, 0, 6, 0, 0];
const LITTLE = [0x49, 0x49, 42, 0, 8, 0, 0, 0, 1, 0, 0x12, 0x01, 3, 0, 1, 0, 0, 0, 6, 0, 0, 0];

describe("what a JPEG says of a photo as stored", () => {
  const size = { width: 640, height: 480 };

  test("is the size of the frame, behind what comes before", async () => {
    const header = await jpegHeader(jpeg(...SOME_SEGMENT, ...FRAME));
    expect(header).toEqual({ ...size, orientation: 1 });
  });

  test.each([
    ["most significant bytes first", BIG, 6],
    ["least significant bytes first", LITTLE, 6],
    [
      "another tag before it",
      [...BIG.slice(0, 9), 2, 1, 0, ...Array(10).fill(0), ...BIG.slice(10)],
      6,
    ],
    ["a value that is none", [...BIG.slice(0, 19), 9, 0, 0], 1],
    ["a directory that is elsewhere", [...BIG.slice(0, 4), 255, 255, 255, 255, ...BIG.slice(8)], 1],
    ["a directory that is cut off", BIG.slice(0, 15), 1],
    ["nothing", [], 1],
  ])("is the orientation of EXIF data with %s", async (_, tiff, orientation) => {
    expect(await jpegHeader(jpeg(...exif(...tiff), ...FRAME))).toEqual({ ...size, orientation });
  });

  test.each([
    ["nothing", new Blob([])],
    ["another kind of photo", new Blob(["\x89PNG\r\n\x1a\n and more of it"])],
    ["a JPEG that ends too soon", jpeg(...SOME_SEGMENT, 0xff, 0xc2, 0x00)],
    ["a damaged JPEG", jpeg(...SOME_SEGMENT, 0x00, ...FRAME)],
  ])("is not told by %s", async (_, photo) => {
    expect(await jpegHeader(photo)).toBeNull();
  });
});

describe("upright from stored", () => {
  // Corners of a photo of 4 x 3 as stored: top left, top right, bottom left; where each is seen,
  // by the table of the EXIF standard: what the first row and the first column of it are.
  test.each([
    [1, [0, 0], [4, 0], [0, 3]],
    [2, [4, 0], [0, 0], [4, 3]],
    [3, [4, 3], [0, 3], [4, 0]],
    [4, [0, 3], [4, 3], [0, 0]],
    [5, [0, 0], [0, 4], [3, 0]],
    [6, [3, 0], [3, 4], [0, 0]],
    [7, [3, 4], [3, 0], [0, 4]],
    [8, [0, 4], [0, 0], [3, 4]],
  ])("of orientation %i puts every corner where it belongs", (exif, ...seen) => {
    const [a, b, c, d, e, f] = uprightFromStored(exif, 4, 3);
    const stored = [
      [0, 0],
      [4, 0],
      [0, 3],
    ] as const;
    expect(stored.map(([x, y]) => [a * x + c * y + e, b * x + d * y + f])).toEqual(seen);
  });
});
