// A pose as an address: opening it shows the pose in the map. The photo is not in it.
import {
  mapRef,
  type Camera,
  type GeoPose,
  type LocalizeResponse,
  type Quaternion,
  type Vector3,
} from "visloc-client";
import { cornerRays, type Matrix3 } from "../geometry";
import type { ShownPose } from "../viewer/types";
import { covarianceOfPosition } from "./shown_pose";

// No map reaches further from its origin. Beyond, the view's numbers of 32 bits would overflow.
const LARGEST = 1e9;

/** A pose that an address holds: numbers that anybody may have written. */
export interface SharedPose {
  /** `id@version`: the pose is in the frame of this version. */
  map: string;
  shown: ShownPose & { positionCovariance: Matrix3 };
  /** 0 to 1; null when it was not judged. */
  probability: number | null;
  /** Null where the map is not anchored to the Earth. */
  geopose: GeoPose | null;
  /** The number that the service's log knows the query by. */
  request: string;
}

/** The link to the pose of an answer; null of an answer without one. */
export function poseLink(page: URL, answer: LocalizeResponse): string | null {
  const { pose, camera, geopose } = answer;
  if (pose === null) return null;
  const [xx, xy, xz, , yy, yz, , , zz] = covarianceOfPosition(pose);
  const earth = geopose && [
    ...[geopose.position.lat.toFixed(8), geopose.position.lon.toFixed(8)],
    geopose.position.h.toFixed(3),
    ...numbers("xyzw".split("").map((axis) => geopose.quaternion[axis as "x"])),
  ];
  const parts = [
    ["map", mapRef(answer.map)],
    ["pose", [...numbers(pose.position, 9), ...numbers(pose.orientation)].join()],
    // Rounding may leave a variance of almost zero below it.
    ["spread", numbers([Math.max(xx, 0), xy, xz, Math.max(yy, 0), yz, Math.max(zz, 0)], 4).join()],
    ["camera", [camera.model, camera.width, camera.height, ...numbers(camera.params)].join()],
    ...(pose.probability === null ? [] : [["probability", pose.probability.toFixed(3)]]),
    ...(earth ? [["earth", earth.join()]] : []),
    ["query", answer.request_id],
  ];
  const link = new URL(page);
  link.search = "";
  const escaped = ([name, value]: string[]): string =>
    `${name}=${encodeURIComponent(value!).replace(/%(40|2C)/g, decodeURIComponent)}`;
  link.hash = parts.map(escaped).join("&");
  return link.href;
}

/** Read what `poseLink` wrote; null where there is no pose, "damaged" where it is not whole. */
export function sharedPose(hash: string): SharedPose | "damaged" | null {
  const given = new URLSearchParams(hash.replace(/^#/, ""));
  if (!given.has("pose")) return null;
  const map = given.get("map") ?? "";
  const pose = read(given.get("pose"), 7);
  const spread = read(given.get("spread"), 6);
  const camera = readCamera(given.get("camera"));
  const earth = given.has("earth") ? read(given.get("earth"), 7) : null;
  const probability = given.has("probability") ? read(given.get("probability"), 1) : null;
  const whole = map !== "" && pose !== null && spread !== null && camera !== null;
  if (!whole || (given.has("earth") && earth === null)) return "damaged";
  if (given.has("probability") && !(probability !== null && within(probability[0]!, 0, 1))) {
    return "damaged";
  }
  const orientation = pose.slice(3) as Quaternion;
  if (!isRotation(orientation)) return "damaged";
  const [xx, xy, xz, yy, yz, zz] = spread as [number, number, number, number, number, number];
  if (Math.min(xx, yy, zz) < 0) return "damaged";
  const [lat, lon, h, x, y, z, w] = (earth ?? []) as number[];
  const onEarth = (): boolean =>
    within(lat!, -90, 90) && within(lon!, -180, 180) && isRotation([w!, x!, y!, z!]);
  if (earth !== null && !onEarth()) return "damaged";
  return {
    map,
    shown: {
      ...{ position: pose.slice(0, 3) as Vector3, orientation, camera },
      positionCovariance: [xx, xy, xz, xy, yy, yz, xz, yz, zz],
    },
    probability: probability?.[0] ?? null,
    geopose:
      earth === null
        ? null
        : {
            position: { lat: lat!, lon: lon!, h: h! },
            quaternion: { x: x!, y: y!, z: z!, w: w! },
          },
    request: given.get("query") ?? "",
  };
}

/** Numbers in few characters: more digits than a pose is good for. */
function numbers(values: readonly number[], significant = 7): string[] {
  return values.map((value) => String(Number(value.toPrecision(significant))));
}

function read(text: string | null, count: number): number[] | null {
  const values = (text ?? "").split(",").map((word) => (word.trim() === "" ? NaN : Number(word)));
  const known = values.every((value) => within(value, -LARGEST, LARGEST));
  return values.length === count && known ? values : null;
}

/** False of NaN. */
const within = (value: number, least: number, most: number): boolean =>
  value >= least && value <= most;

const isRotation = (quaternion: Quaternion): boolean =>
  Math.abs(Math.hypot(...quaternion) - 1) <= 1e-3;

function readCamera(text: string | null): Camera | null {
  const [model, ...words] = (text ?? "").split(",");
  const values = read(words.join(), words.length);
  if (!/^[A-Z_0-9]{3,30}$/.test(model ?? "") || values === null || values.length < 3) return null;
  const [width, height, ...params] = values as [number, number, ...number[]];
  if (!(width > 0 && height > 0 && params[0]! > 0)) return null;
  const camera = { model: model!, width, height, params };
  return cornerRays(camera).flat().every(Number.isFinite) ? camera : null;
}
