// What a JPEG's own header says of its pixels as stored. Browsers tell the size after turning a photo
// by its EXIF orientation, which is another one for half of what phones take.

// Beginnings of frames; among them are three other segments.
const isFrame = (marker: number): boolean =>
  marker >= 0xc0 && marker <= 0xcf && ![0xc4, 0xc8, 0xcc].includes(marker);
// Previews inside the header may be large.
const HEAD_BYTES = 1 << 20;

export interface JpegHeader {
  width: number;
  height: number;
}

/**
 * Null of anything but a JPEG, and of a header that is damaged.
 *
 * Throws DOMException for a file that can no longer be read.
 */
export async function jpegHeader(photo: Blob): Promise<JpegHeader | null> {
  const head = new DataView(await photo.slice(0, HEAD_BYTES).arrayBuffer());
  if (head.byteLength < 4 || head.getUint16(0) !== 0xffd8) return null;
  for (let at = 2; at + 9 <= head.byteLength && head.getUint8(at) === 0xff;) {
    const marker = head.getUint8(at + 1);
    if (isFrame(marker)) {
      return { width: head.getUint16(at + 7), height: head.getUint16(at + 5) };
    }
    at += 2 + head.getUint16(at + 2);
  }
  return null;
}
