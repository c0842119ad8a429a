// What a JPEG's own header says of its pixels as stored. Browsers tell the size after turning a photo
// by its EXIF orientation, which is another one for half of what phones take.

// Beginnings of frames; among them are three other segments.
const isFrame = (marker: number): boolean =>
  marker >= 0xc0 && marker <= 0xcf && ![0xc4, 0xc8, 0xcc].includes(marker);
const APP1 = 0xe1;
const EXIF = 0x45786966; // "Exif", of the six bytes before the EXIF data
const ORIENTATION = 0x0112;
const DIRECTORY_ENTRY_BYTES = 12;
// Previews inside the header may be large.
const HEAD_BYTES = 1 << 20;

export interface JpegHeader {
  width: number;
  height: number;
  /** EXIF's, 1 to 8; 1 where it says nothing. */
  orientation: number;
}

/**
 * Null of anything but a JPEG, and of a header that is damaged.
 *
 * Throws DOMException for a file that can no longer be read.
 */
export async function jpegHeader(photo: Blob): Promise<JpegHeader | null> {
  const head = new DataView(await photo.slice(0, HEAD_BYTES).arrayBuffer());
  if (head.byteLength < 4 || head.getUint16(0) !== 0xffd8) return null;
  let orientation = 1;
  for (let at = 2; at + 9 <= head.byteLength && head.getUint8(at) === 0xff;) {
    const marker = head.getUint8(at + 1);
    if (isFrame(marker)) {
      return { width: head.getUint16(at + 7), height: head.getUint16(at + 5), orientation };
    }
    const length = head.getUint16(at + 2);
    const end = Math.min(at + 2 + length, head.byteLength);
    if (marker === APP1 && end - at > 10 && head.getUint32(at + 4) === EXIF) {
      orientation = exifOrientation(new DataView(head.buffer, at + 10, end - at - 10)) ?? 1;
    }
    at += 2 + length;
  }
  return null;
}

/** Of EXIF data, which is laid out as a TIFF file: the tag in the first directory (CIPA DC-008). */
function exifOrientation(tiff: DataView): number | null {
  if (tiff.byteLength < 8) return null;
  const littleEndian = tiff.getUint16(0) === 0x4949;
  const directory = tiff.getUint32(4, littleEndian);
  if (directory + 2 > tiff.byteLength) return null;
  const entries = tiff.getUint16(directory, littleEndian);
  for (let i = 0; i < entries; i++) {
    const at = directory + 2 + i * DIRECTORY_ENTRY_BYTES;
    if (at + DIRECTORY_ENTRY_BYTES > tiff.byteLength) return null;
    if (tiff.getUint16(at, littleEndian) !== ORIENTATION) continue;
    const value = tiff.getUint16(at + 8, littleEndian);
    return value >= 1 && value <= 8 ? value : null;
  }
  return null;
}
