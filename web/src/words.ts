// Numbers as people read them.
import { mapRef, type LocalizeResponse } from "visloc-client";

const WHOLE = new Intl.NumberFormat("en", { maximumFractionDigits: 0 });

/** 199 676: in groups of three, with thin spaces that do not break. */
export function countText(count: number): string {
  return WHOLE.format(count).replaceAll(",", "\u202f");
}

/** "1 photo", "20 photos" */
export function counted(count: number, one: string, many = `${one}s`): string {
  return `${countText(count)} ${count === 1 ? one : many}`;
}

/** Bytes as 33 MiB, the unit of `mapping`. */
export function bytesText(bytes: number): string {
  const units = ["B", "KiB", "MiB", "GiB", "TiB"];
  let unit = 0;
  for (; bytes >= 1024 && unit < units.length - 1; unit++) bytes /= 1024;
  return `${bytes >= 99.5 || unit === 0 ? Math.round(bytes) : bytes.toPrecision(2)} ${units[unit]}`;
}

/** Seconds as 58 ms or 1.24 s. */
export function secondsText(seconds: number): string {
  if (seconds < 0.0005) return "0 ms";
  if (seconds < 1) return `${Number((seconds * 1000).toPrecision(2))} ms`;
  return `${seconds.toFixed(seconds < 10 ? 2 : 1)} s`;
}

/** An instant of ISO 8601 as 2026-11-21 11:14 UTC; what is none, as it is. */
export function instantText(iso: string): string {
  const at = new Date(iso);
  if (Number.isNaN(at.getTime())) return iso;
  return `${at.toISOString().slice(0, 16).replace("T", " ")} UTC`;
}

/** So many significant digits, without an exponent where that is readable. */
export function digits(value: number, significant: number): string {
  return String(Number(value.toPrecision(significant)));
}

/** A standard deviation of a position: centimetres, or units of a world without scale. */
export function positionStd(std: number, metric: boolean): string {
  return metric ? digits(std * 100, 2) : digits(std, 2);
}

/** Where the camera's parameters came from. */
export const CAMERA_SOURCES: Readonly<Record<LocalizeResponse["camera"]["source"], string>> = {
  given: "as given",
  given_scaled: "as given for another size, scaled to this photo",
  map: "that of the map’s own photos",
  exif: "focal length from the photo’s EXIF",
  estimated: "focal length found together with the pose",
  guess: "guessed: the photo does not tell its focal length",
};

/** As people name a map: with the version only where that is not the current one. */
export function shortRef(map: { id: string; version: string; current: boolean }): string {
  return map.current ? map.id : mapRef(map);
}
