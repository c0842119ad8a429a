// Colours of the scene. Orange-to-blue and purple-to-yellow scales: told apart with any colour
// vision, and by lightness alone.
import type { Theme } from "./types";

export interface Palette {
  ground: string;
  grid: string;
  camera: string;
  /** Mapping cameras that stand out. */
  highlight: string;
  /** An answer: its frustum, its ellipsoid, its inliers. */
  pose: string;
  trail: string;
  /** How much darker pixels are behind the edge of something nearer. */
  shade: number;
  /** Landmarks that few photos see, to those that many do: always further from the ground. */
  seenBy: readonly [string, string, string, string];
}

export const PALETTES: Record<Theme, Palette> = {
  dark: {
    ground: "#10151b",
    grid: "#36424e",
    camera: "#8fa6ba",
    highlight: "#ffb52e",
    pose: "#ff4fa0",
    trail: "#45c4f5",
    shade: 0.6,
    seenBy: ["#7d8fe0", "#2fb5b0", "#8ad95c", "#fde725"],
  },
  light: {
    ground: "#f3f5f7",
    grid: "#c3ccd4",
    camera: "#5d7387",
    highlight: "#b45f00",
    pose: "#cf0063",
    trail: "#0072b2",
    shade: 1.1,
    seenBy: ["#8fb85a", "#2a9a8c", "#32648e", "#43065c"],
  },
};

/** So many photos see a landmark of the last colour of `seenBy`, or more; of the first, one. */
export const SEEN_BY_MOST = 16;

/** Of the chance that a photo is localized: 0, a half, 1. */
const PROBABILITY_COLOURS = ["#c23b0e", "#f0c04a", "#2078b8"] as const;

/** Red, green and blue, 0 to 1, of `#rrggbb`. */
export function rgb(hex: string): [number, number, number] {
  const value = parseInt(hex.slice(1), 16);
  return [(value >> 16) / 255, ((value >> 8) & 255) / 255, (value & 255) / 255];
}

/** The colour of a probability between those of PROBABILITY_COLOURS. */
export function probabilityColour(probability: number): [number, number, number] {
  const at = 2 * Math.min(Math.max(probability, 0), 1);
  const [low, high] = at < 1 ? [0, 1] : [1, 2];
  const from = rgb(PROBABILITY_COLOURS[low as 0 | 1]);
  const to = rgb(PROBABILITY_COLOURS[high as 1 | 2]);
  return from.map((v, i) => v + (to[i]! - v) * (at - low)) as [number, number, number];
}
