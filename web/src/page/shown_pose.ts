// An answer as the 3D view draws it.
import {
  mapRef,
  type CoarsePose,
  type LocalizeResponse,
  type PoseEstimate,
  type Quaternion,
  type Vector3,
} from "visloc-client";
import { positionCovariance, type Matrix3 } from "../geometry";
import type { ShownPose } from "../viewer/types";

/** A pose of less probability is in doubt (docs/trust.md). */
const SURE = 0.9;

/** Whether the service takes the pose for right; it may also not have judged it. */
export function isSure({ probability }: PoseEstimate): boolean {
  return probability !== null && probability >= SURE;
}

/** What a pose is called, and why it is in doubt where it is. */
export function verdictOf(pose: PoseEstimate): { name: string; doubt: string } {
  if (isSure(pose)) return { name: "Localized", doubt: "" };
  if (pose.probability === null) {
    return { name: "Localized", doubt: "The service did not judge whether this place is right." };
  }
  const chance = pose.probability.toFixed(2);
  return {
    name: "Perhaps here",
    doubt:
      `The place is in doubt: the probability that it is right is ${chance}. A place that looks ` +
      "alike, or another camera than was assumed, answers like this.",
  };
}

/** The pose with its ellipsoid, and the inliers where they were asked for; null of a refusal. */
export function shownPose({ pose, camera, debug }: LocalizeResponse): ShownPose | null {
  if (pose === null) return null;
  return {
    position: pose.position as Vector3,
    orientation: pose.orientation as Quaternion,
    camera,
    positionCovariance: covarianceOfPosition(pose),
    inliers:
      debug?.inliers.flatMap((yes, i) => (yes ? debug.points.slice(3 * i, 3 * i + 3) : [])) ?? [],
  };
}

/**
 * The places to draw: that of the pose, the coarse one with its spread, or the two of an ambiguous
 * photo, as far as they are in the frame of the answer's map.
 */
export function shownPlaces(answer: LocalizeResponse): ShownPose[] {
  const pose = shownPose(answer);
  if (pose !== null) return [pose];
  if (answer.coarse) {
    const { position, orientation } = answer.coarse;
    return [
      {
        position: position as Vector3,
        orientation: orientation as Quaternion,
        camera: answer.camera,
        positionCovariance: covarianceOfPosition(answer.coarse),
      },
    ];
  }
  return (answer.refusal?.candidates ?? [])
    .filter(({ map }) => mapRef(map) === mapRef(answer.map))
    .map(({ position, orientation }) => ({
      position: position as Vector3,
      orientation: orientation as Quaternion,
      camera: answer.camera,
    }));
}

/** 3 x 3, row by row, of the camera's centre in the world. */
export function covarianceOfPosition({
  cam_from_world,
  covariance,
}: PoseEstimate | CoarsePose): Matrix3 {
  const { rotation_wxyz: rotation, translation } = cam_from_world;
  return positionCovariance(rotation as Quaternion, translation as Vector3, covariance);
}
