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
