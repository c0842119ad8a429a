import { describe, expect, test } from "vitest";
import { jpegHeader } from "../src/page/jpeg_header";
import { uprightFromStored } from "../src/page/photo_picture";

const jpeg = (...bytes: number[]): Blob => new Blob([new Uint8Array([0xff, 0xd8, ...bytes])]);
const SOME_SEGMENT = [0xff, 0xe1, 0x00, 0x04, 0x01, 0x02];
const FRAME = [0xff, 0xc2, 0x00, 0x11, 0x08, 0x01, 0xe0, 0x02, 0x80, 0x03];

describe("what a JPEG says of a photo as stored", () => {
  test("is the size of the frame, behind what comes before", async () => {
    const header = await jpegHeader(jpeg(...SOME_SEGMENT, ...FRAME));
    expect(header).toEqual({ width: 640, height: 480 });
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
