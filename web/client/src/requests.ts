// What is asked of the service, and how it is written as a form.
import type { Camera, Transform } from "./words.js";
import { cameraText } from "./words.js";

/** A photo, as a file or its bytes: JPEG, PNG, WebP, HEIC and others. */
export type Photo = Blob | Uint8Array<ArrayBuffer>;
/** Numbers, row by row. */
export type FeatureArray =
  Float32Array<ArrayBuffer> | Uint8Array<ArrayBuffer> | Int8Array<ArrayBuffer>;

/** What was found in a photo, instead of the photo: docs/api.md, "Send features". */
export interface Features {
  /** The map's `local_features`. */
  kind: string;
  /** N x 2: x, y in pixels of the camera; the centre of the top-left pixel is (0.5, 0.5). */
  keypoints: FeatureArray;
  /** N x D; the service normalizes them. */
  descriptors: FeatureArray;
  /** D numbers for each of the map's `global_features`. */
  global_descriptors: Record<string, FeatureArray>;
  /**
   * By the name of a mapping photo, k x 3: the row of a keypoint, and x, y of the photo's keypoint
   * that another program matched it with. When there are any, the service matches nothing itself.
   */
  matches?: Record<string, FeatureArray>;
}

/** A photo, or what was found in it, with its intrinsics where they are known. */
interface Asked {
  image?: Photo;
  features?: Features;
  /** Black pixels of it hide keypoints of the photo. */
  mask?: Photo;
  /** Without one, the service reads the photo's EXIF or estimates the focal length. */
  camera?: Camera | null;
}

/** Where a satellite receiver has the device, such as `coords` of the browser's geolocation. */
export interface GnssPrior {
  /** Degrees, WGS84. */
  latitude: number;
  longitude: number;
  /** Metres: the horizontal radius that holds 68 % of fixes. */
  accuracy: number;
  /** Metres above the ellipsoid, with its accuracy. */
  altitude?: number | null;
  vertical_accuracy?: number | null;
}

/** What is known of the place beforehand (docs/api.md, "Priors"). */
export interface Priors {
  /** x, y, z in the world, and a radius in its unit. */
  position?: { position: number[]; radius: number };
  height?: { min: number; max: number };
  pose?: { device_from_world: Transform; covariance: number[] };
  gravity?: { direction: number[]; std_deg?: number; world?: number[] };
  gnss?: GnssPrior;
  /** Tiles of a set that the device may be in. */
  maps?: string[];
}

/** Where to look, and how: the fields of docs/api.md. */
interface Where {
  /**
   * An id or `id@version`; or at most 16 that are all searched: one of them answers, and `map` of
   * the answer says which. A photo that fits two of them is refused.
   */
  map: string | string[];
  options?: Record<string, string | number>;
  priors?: Priors;
}

export interface LocalizeCall extends Where, Asked {
  /** The photo's file, for people who read the service's log. */
  name?: string;
  /** Whether the answer shall contain the matches and a picture of them. */
  debug?: boolean;
}

export interface RigImage extends Asked {
  /** A camera of the rig. */
  sensor: string;
  timestamp?: number;
}

export interface RigCall extends Where {
  /** The id of a rig that the map knows, or where each camera sits. */
  rig: string | { sensors: Record<string, { cam_from_rig: Transform; camera?: Camera }> };
  images: RigImage[];
}

/** One instant of a sequence. */
export interface SequenceInstant {
  /** A whole number, greater than that of the instant before. */
  timestamp: number;
  /** None where there is only odometry. `sensor` may be left out where the call has no `rig`. */
  images: (Omit<RigImage, "sensor"> & { sensor?: string })[];
  /** The rig by a tracker, in the tracker's own world, metres: only its motion counts. */
  odometry?: { rig_from_odometry: Transform; covariance?: number[] };
  /** Of this instant, instead of those of the sequence. */
  priors?: Priors;
}

export interface SequenceCall extends Where {
  /** As of a rig; left out, the sequence is of one camera. */
  rig?: RigCall["rig"];
  /** In the order of time. */
  instants: SequenceInstant[];
  /** Of the timestamps; left out, their size tells it. */
  time_unit?: "s" | "ms" | "us" | "ns";
  /** Longest gap between measured instants that is filled: 0 (none) to 60 seconds, by default 1. */
  max_gap_s?: number;
}

/** The API has one field for a map and another for several. */
function whereOf({ map }: Where): { map: string | undefined; maps?: string[] } {
  if (typeof map === "string") return { map };
  return map.length === 1 ? { map: map[0] } : { map: undefined, maps: map };
}

/** The form of POST /localize. What was not chosen is not sent: the service has defaults. */
export function localizeForm(call: LocalizeCall): FormData {
  const form = new FormData();
  const { map, maps } = whereOf(call);
  if (map !== undefined) form.set("map", map);
  if (maps !== undefined) form.set("maps", JSON.stringify(maps));
  if (call.image !== undefined) form.set("image", blobOf(call.image), call.name || "photo");
  if (call.mask !== undefined) form.set("mask", blobOf(call.mask), "mask");
  if (call.features !== undefined) {
    const file = new Blob([JSON.stringify(featuresJson(call.features))]);
    form.set("features", file, "features.json");
  }
  if (call.camera != null) form.set("camera", cameraText(call.camera));
  if (call.options !== undefined && Object.keys(call.options).length > 0) {
    form.set("options", JSON.stringify(call.options));
  }
  if (call.priors !== undefined) form.set("priors", JSON.stringify(call.priors));
  if (call.debug === true) form.set("debug", "true");
  return form;
}

/** The form of POST /localize/rig: a text `request`, and a file for each photo and mask. */
export function rigForm(call: RigCall): FormData {
  const form = new FormData();
  const images = withParts(call.images, form);
  form.set("request", JSON.stringify({ ...call, ...whereOf(call), images }));
  return form;
}

/** The form of POST /localize/sequence, likewise. */
export function sequenceForm(call: SequenceCall): FormData {
  const form = new FormData();
  const instants = call.instants.map((instant) => ({
    ...instant,
    images: withParts(instant.images, form),
  }));
  form.set("request", JSON.stringify({ ...call, ...whereOf(call), instants }));
  return form;
}

/** Put photos and masks into a form, and name their parts instead. */
function withParts(images: Omit<RigImage, "sensor">[], form: FormData): unknown[] {
  let files = [...form.keys()].length;
  const part = (photo: Photo): string => {
    const name = `image${files++}`;
    form.set(name, blobOf(photo), "photo");
    return name;
  };
  return images.map(({ image, mask, features, camera, ...rest }) => ({
    ...rest,
    ...(image === undefined ? {} : { part: part(image) }),
    ...(mask === undefined ? {} : { mask_part: part(mask) }),
    ...(features === undefined ? {} : { features: featuresJson(features) }),
    ...(camera == null ? {} : { camera }),
  }));
}

const blobOf = (photo: Photo): Blob => (photo instanceof Blob ? photo : new Blob([photo]));

function featuresJson(features: Features): unknown {
  const { kind, keypoints, descriptors, global_descriptors, matches } = features;
  const count = keypoints.length / 2;
  const described = Object.entries(global_descriptors).map(([name, numbers]): [string, unknown] => [
    name,
    arrayJson(numbers, [numbers.length]),
  ]);
  return {
    kind,
    keypoints: arrayJson(keypoints, [count, 2]),
    descriptors: arrayJson(descriptors, [count, count > 0 ? descriptors.length / count : 0]),
    global_descriptors: Object.fromEntries(described),
    ...(matches === undefined ? {} : { matches: matchesJson(matches) }),
  };
}

function matchesJson(matches: Record<string, FeatureArray>): unknown {
  const arrays = Object.entries(matches).map(([name, rows]): [string, unknown] => [
    name,
    arrayJson(rows, [rows.length / 3, 3]),
  ]);
  return Object.fromEntries(arrays);
}

/** Little-endian, as every machine that runs JavaScript is. */
function arrayJson(numbers: FeatureArray, shape: number[]): unknown {
  const dtype =
    numbers instanceof Float32Array ? "float32" : numbers instanceof Int8Array ? "int8" : "uint8";
  const bytes = new Uint8Array(numbers.buffer, numbers.byteOffset, numbers.byteLength);
  let text = "";
  // A function takes some ten thousand arguments at most.
  for (let at = 0; at < bytes.length; at += 8192) {
    text += String.fromCharCode(...bytes.subarray(at, at + 8192));
  }
  return { dtype, shape, data: btoa(text) };
}
