// The words of the HTTP API (docs/api.md), under the names that they have there.

export type Vector3 = [number, number, number];
/** Unit quaternion: w, x, y, z. */
export type Quaternion = [number, number, number, number];

export interface MapInfo {
  id: string;
  version: string;
  created: string;
  metric: boolean;
  /** Null for a set. */
  method: string | null;
  local_features: string;
  global_features: string[];
  images: number;
  landmarks: number;
  /** Null for a set. */
  observations: number | null;
  extent: { min: number[]; max: number[] };
  size_bytes: number;
  /** Unit vector; empty when not known. */
  down: number[];
  /** Whether this version is current. */
  current: boolean;
  /** All published ones, oldest first. */
  versions: { version: string; current: boolean }[];
  kind: "map" | "set";
  /** Of a set that was asked for alone. */
  tiles: Tile[];
  /** Where the map lies on Earth: a circle around it, metres. Null when it is not anchored. */
  place: { latitude: number; longitude: number; radius: number } | null;
  /** Photos of the map, each looked for in the map without itself; null where none were. */
  own_test: { tested: number; localized: number; wrong: number } | null;
  /** What speaks against the map; at most 16. */
  doubts: { kind: string; message: string }[];
  /** `id@version` of other maps of the same build, which nothing links to this one; at most 16. */
  pieces: string[];
  /** By id, at most 16 of them: for photos that one of them took. */
  cameras: Record<string, Camera>;
  num_cameras: number;
}

/** One map of a set. */
export interface Tile {
  map: string;
  version: string;
  /** `x_set = scale R x + translation` */
  set_from_tile: { rotation_wxyz: Quaternion; translation: Vector3; scale: number };
}

export interface Camera {
  model: string;
  width: number;
  height: number;
  params: number[];
}

/** Of pose a_from_b: `x_a = R x_b + translation`. */
export interface Transform {
  rotation_wxyz: Quaternion;
  translation: Vector3;
}

/** A mapping photo: where it was taken, and world_from_cam as a rotation. */
export interface MapImage {
  name: string;
  /** Key of MapImages.cameras. */
  camera: string;
  position: Vector3;
  orientation: Quaternion;
}

/** GET /maps/{ref}/images?first=&count= */
export interface MapImages {
  map: { id: string; version: string };
  total: number;
  first: number;
  cameras: Record<string, Camera>;
  images: MapImage[];
}

/** Where a photo, or a rig, was, and how sure that is. */
interface Estimate {
  /** The camera's centre, or the rig's origin, in the map; metres where the map is metric. */
  position: number[];
  /** Rotation of world_from_cam, or of world_from_rig: w, x, y, z. */
  orientation: number[];
  /** 6 x 6, row by row: rotation (rad) then translation, of cam_from_world or rig_from_world. */
  covariance: number[];
  position_std: number[];
  orientation_std_deg: number[];
  /** The part of covariance that the scatter of the matches alone leaves open; null of filled ones. */
  photo_covariance: number[] | null;
  /** What covariance covers. */
  uncertainty: "whole" | "photo only";
  /** That the pose is right, 0 to 1; null when it was not judged. */
  probability: number | null;
  /** Whether the unit of lengths is the metre; false: its length is unknown. */
  metric: boolean | null;
}

export interface PoseEstimate extends Estimate {
  cam_from_world: Transform;
}

export interface RigPose extends Estimate {
  rig_from_world: Transform;
}

/**
 * OGC GeoPose 1.0, Basic-Quaternion. The quaternion turns the body's axes (x forward, y left, z up)
 * to east, north and up at the position.
 */
export interface GeoPose {
  /** Degrees, WGS84, and metres above the ellipsoid. */
  position: { lat: number; lon: number; h: number };
  quaternion: { x: number; y: number; z: number; w: number };
}

/** Where the most similar mapping photos say that a refused photo was taken: `fallback=coarse`. */
export interface CoarsePose {
  cam_from_world: Transform;
  position: number[];
  orientation: number[];
  /** 6 x 6, row by row: rotation, then translation; the ellipsoid of 95 % holds. */
  covariance: number[];
  position_std: number[];
  orientation_std_deg: number[];
  method: "bdi" | "csi" | "ewb";
  metric: boolean | null;
}

/** One of the two places between which an ambiguous photo leaves the choice. */
export interface Candidate {
  /** In whose frame the pose is: a map, or a set of maps. */
  map: { id: string; version: string };
  /** Of a set: `id@version` of the map in it. */
  tile: string | null;
  position: number[];
  orientation: number[];
  inliers: number;
  /** The mapping photo that speaks most for this place. */
  image: string | null;
  /** How surely the keypoints speak for this place, in standard deviations; null if not compared. */
  preference: number | null;
}

/** Why there is no pose. */
export interface Refusal {
  stage: string;
  /** A stable word. */
  reason: string;
  /** For people. */
  message: string;
  candidates: Candidate[];
}

/** The intrinsics that were used, and where they came from. */
export type CameraUsed = Camera & {
  source: "given" | "given_scaled" | "map" | "exif" | "estimated" | "guess";
};

/** A mapping photo that was matched with. */
export interface Retrieved {
  image: string;
  score: number;
  similarities: Record<string, number>;
}

/** The answer to one photo. */
export interface LocalizeResponse {
  request_id: string;
  /** Only `localized` has a `pose`; `not_localized` and `coarse` have a `refusal`. */
  status: "localized" | "coarse" | "not_localized";
  pose: PoseEstimate | null;
  refusal: Refusal | null;
  /** Where `status` is `coarse`. */
  coarse: CoarsePose | null;
  keypoints: number;
  correspondences: number;
  inliers: number;
  inlier_ratio: number;
  retrieved: Retrieved[];
  camera: CameraUsed;
  orientation: { exif: number; read_as: string; turned: number };
  map: { id: string; version: string };
  /** Of the camera; null when not localized, or when the map is not anchored to the Earth. */
  geopose: GeoPose | null;
  /** Of a set: `id@version` of the map in it that the answer rests on. */
  tile: string | null;
  seconds: Record<string, number>;
  debug: { keypoints: number[]; points: number[]; inliers: boolean[]; overlay: string } | null;
}

/** What became of one photo of a rig. */
export interface RigImageAnswer {
  sensor: string;
  /** Why this photo could not be used; the others count all the same. */
  error: { kind: string; code: string; message: string } | null;
  /** Null where the rig has no pose. */
  cam_from_world: Transform | null;
  keypoints: number;
  correspondences: number;
  inliers: number;
  /** The best 20. */
  retrieved: Retrieved[];
  camera: CameraUsed | null;
  orientation: { exif: number; read_as: string; turned: number };
}

/** The answer to the photos of a rig, or to those of one instant of a sequence. */
export interface RigResponse {
  request_id: string;
  timestamp: number | null;
  status: "localized" | "filled" | "not_localized";
  source: "estimated" | "motion" | "interpolated" | "nearest" | null;
  pose: RigPose | null;
  refusal: Refusal | null;
  /** In the order of the request. */
  images: RigImageAnswer[];
  correspondences: number;
  inliers: number;
  inlier_ratio: number;
  map: { id: string; version: string };
  /** Of the rig, with the axes of its frame read like a camera's. */
  geopose: GeoPose | null;
  tile: string | null;
  seconds: Record<string, number>;
}

/** An option of a query, as /openapi.json describes it. */
export interface OptionSchema {
  title: string;
  /** Null, which stands for the default, is among them. */
  enum?: (string | null)[];
  minimum?: number;
  maximum?: number;
  /** Null where the map or the preset has one of its own. */
  default: string | number | null;
}

/** `MODEL,width,height,params...`, as the service, the command line and curl take a camera. */
export function cameraText(camera: Camera): string {
  return [camera.model, camera.width, camera.height, ...camera.params].join(",");
}

/** `id@version`: this version, also after the service has switched to a newer one. */
export function mapRef(map: { id: string; version: string }): string {
  return `${map.id}@${map.version}`;
}
