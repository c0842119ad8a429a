// The part of the service's HTTP API that the page speaks (docs/api.md).

export type Vector3 = [number, number, number];
/** Unit quaternion: w, x, y, z. */
export type Quaternion = [number, number, number, number];

export interface MapInfo {
  id: string;
  version: string;
  created: string;
  metric: boolean;
  method: string;
  local_features: string;
  global_features: string[];
  images: number;
  landmarks: number;
  observations: number;
  extent: { min: number[]; max: number[] };
  size_bytes: number;
  /** Unit vector; empty when not known. */
  down: number[];
}

export interface Camera {
  model: string;
  width: number;
  height: number;
  params: number[];
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

export interface PoseEstimate {
  cam_from_world: { rotation_wxyz: number[]; translation: number[] };
  position: number[];
  orientation: number[];
  /** 6 x 6, row by row: rotation (rad) then translation, of cam_from_world. */
  covariance: number[];
  position_std: number[];
  orientation_std_deg: number[];
}

export interface LocalizeResponse {
  request_id: string;
  status: "localized" | "not_localized";
  pose: PoseEstimate | null;
  refusal: { stage: string; reason: string; message: string } | null;
  keypoints: number;
  correspondences: number;
  inliers: number;
  inlier_ratio: number;
  retrieved: { image: string; score: number; similarities: Record<string, number> }[];
  camera: Camera & { source: "given" | "given_scaled" | "exif" | "estimated" | "guess" };
  orientation: { exif: number; read_as: string };
  map: { id: string; version: string };
  seconds: Record<string, number>;
  debug: { keypoints: number[]; points: number[]; inliers: boolean[]; overlay: string } | null;
}

/** RFC 9457, as every refusal of the service has it. */
export interface Problem {
  title: string;
  status: number;
  detail: string;
  code: string;
  field: string | null;
  expected: string | null;
  got: string | null;
  request_id: string;
}
