// What `mapping report` writes into its file, as JSON in <script type="application/json" id="report">.
import type { Camera, MapImage, Vector3 } from "visloc-client";

/** Counts of values that fall between `edges[i]` and `edges[i + 1]`. */
export interface Histogram {
  edges: number[];
  counts: number[];
}

/** A mapping photo localized without itself and, to make it harder, without its nearest ones. */
export interface HeldOutRun {
  /** Row of `images`. */
  image: number;
  /** Photos that were left out: itself, and so many less one of those nearest to it. */
  left_out: number;
  localized: boolean;
  /** Of the refusal; null when localized. */
  reason: string | null;
  /** Units of the world, degrees; null when not localized. */
  position_error: number | null;
  orientation_error_deg: number | null;
  inliers: number;
  /** What the coverage model expects of a photo there, with those photos left out. */
  expected_inliers: number;
  /** Predicted from the other runs: not from those of this photo. */
  probability: number;
}

/** One place of the grid; lists go by `directions_deg`. */
export interface CoverageCell {
  position: Vector3;
  /** Chance that a photo taken here, looking that way, is localized within `within`. */
  probability: number[];
  expected_inliers: number[];
  /** Predicted standard deviation of the position, units of the world; null where none is. */
  position_std: (number | null)[];
}

/** A place and a direction to take more photos. */
export interface WeakSpot {
  position: Vector3;
  direction_deg: number;
  probability: number;
  /** In words: too few landmarks, all far away, seen from the other side only, ... */
  why: string;
}

/** A photo, and where the map would find it if its own place were not mapped. */
export interface LookAlike {
  /** Rows of `images`: the photo, and the one nearest to where it was found. */
  image: number;
  twin: number;
  /** Where it was found. */
  position: Vector3;
  inliers: number;
  own_inliers: number;
  /** In words. */
  told: string;
}

export interface ReportData {
  map: {
    id: string;
    version: string;
    created: string;
    method: string;
    local_features: string;
    global_features: string[];
    metric: boolean;
    images: number;
    landmarks: number;
    observations: number;
    size_bytes: number;
    extent: { min: Vector3; max: Vector3 };
    /** Each camera in words, or of many a summary. */
    cameras: string[];
    notes: string[];
  };
  /** The command that made this, and the version of visloc. */
  made_by: { command: string; version: string };
  up: { direction: Vector3; source: "gravity" | "cameras" };
  /** The body of GET /maps/{ref}/points, base64: the first so many points. */
  points: string;
  cameras: Record<string, Camera>;
  images: MapImage[];
  statistics: {
    track_length: Histogram;
    error_px: Histogram | null;
    angle_deg: Histogram | null;
    landmarks_per_image: Histogram;
  };
  held_out: HeldOutRun[];
  look_alikes: LookAlike[];
  /** Photos that were asked; one that shares its place with all others cannot be. */
  look_alikes_asked: number;
  coverage: {
    /** What counts as localized: within so far and so many degrees of where it was taken. */
    within: { position: number; orientation_deg: number };
    /** Size of a cell, units of the world. */
    cell: number;
    /** Axes of the plan: `right` and `ahead` lie level, and with `up` make a right-handed frame. */
    right: Vector3;
    ahead: Vector3;
    /** Angles from `right` towards `ahead` into which the camera looks, degrees. */
    directions_deg: number[];
    /** How far the camera looks below the level, degrees: the median of the mapping photos. */
    pitch_deg: number;
    camera: Camera;
    cells: CoverageCell[];
    weak_spots: WeakSpot[];
    /** How far the predictions may be trusted, measured on runs that they were not made from. */
    calibration: { predicted: number; measured: number; runs: number }[];
    rank_correlation: number | null;
  };
}
