// A pose on Earth, as people say it.
import type { GeoPose } from "visloc-client";

// Looking up or down more steeply than this, it is the photo's upper edge that has a heading.
const STEEP_DEG = 75;
const WINDS = ["N", "NE", "E", "SE", "S", "SW", "W", "NW"];
const DEGREES = 180 / Math.PI;

/** Where a camera looks. */
export interface Heading {
  /** Degrees clockwise from true north, 0 up to 360; of the photo's upper edge where `steep`. */
  heading: number;
  /** Degrees above the horizon, -90 to 90. */
  elevation: number;
  steep: boolean;
}

/** The heading of a camera, from the axes of its body: x forward, z up. */
export function headingOf({ quaternion: { x, y, z, w } }: GeoPose): Heading {
  // East, north and up of the body's x axis and of its z axis.
  const forward = [1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)] as const;
  const above = [2 * (x * z + w * y), 2 * (y * z - w * x)] as const;
  const elevation = Math.asin(Math.min(Math.max(forward[2], -1), 1)) * DEGREES;
  const steep = Math.abs(elevation) > STEEP_DEG;
  const [east, north] = steep ? above : forward;
  return { heading: (Math.atan2(east, north) * DEGREES + 360) % 360, elevation, steep };
}

/** "43° (NE), 12° down" */
export function headingText(geopose: GeoPose): string {
  const { heading, elevation, steep } = headingOf(geopose);
  const wind = WINDS[Math.round(heading / 45) % 8]!;
  const where = `${Math.round(heading) % 360}° (${wind})`;
  const tilt = Math.round(Math.abs(elevation));
  if (steep) {
    const way = elevation < 0 ? "Down" : "Up";
    return `${way}, ${tilt}° from level; the photo’s upper edge is at ${where}`;
  }
  if (tilt === 0) return `${where}, level`;
  return `${where}, ${tilt}° ${elevation < 0 ? "down" : "up"}`;
}

/** Latitude and longitude, to a centimetre: "46.8425482, -91.9937032". */
export function positionText({ position: { lat, lon } }: GeoPose): string {
  return `${lat.toFixed(7)}, ${lon.toFixed(7)}`;
}
