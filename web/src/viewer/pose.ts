// An answer: its frustum, where it may be at 95 %, and the landmarks that it rests on.
import {
  Group,
  Matrix4,
  Mesh,
  MeshBasicMaterial,
  SphereGeometry,
  Vector3 as Vector,
  type Object3D,
  type PerspectiveCamera,
} from "three";
import type { Vector3 } from "visloc-client";
import { cornerRays, ellipsoid95, frustumCorners, subtract, type Matrix3 } from "../geometry";
import { boldLines, discard, dots, pyramidEdges, thinLines } from "./lines";
import { imagePlanes } from "./mapping";
import type { Palette } from "./themes";
import type { ShownPose } from "./types";

// Half axes of an ellipsoid that are not seen: a dot marks its place then.
const UNSEEN_PX = 5;
const DOT_PX = 9;

export class PoseMarks {
  readonly object = new Group();
  private marks: PoseMark[] = [];

  set(
    poses: ShownPose[],
    origin: Vector3,
    depth: number,
    palette: Palette,
    pixelRatio: number,
  ): void {
    for (const mark of this.marks) discard(mark.parts);
    this.marks = poses.map((pose) => new PoseMark(pose, origin, depth, palette, pixelRatio));
    for (const mark of this.marks) this.object.add(mark.parts);
  }

  /** Mark each place by a dot where the ellipsoid is too small to be seen. */
  update(camera: PerspectiveCamera, height: number): void {
    for (const mark of this.marks) mark.update(this.object, camera, height);
  }
}

class PoseMark {
  readonly parts = new Group();
  private readonly dot: Object3D;
  private readonly reach: number;
  private readonly centre = new Vector();

  constructor(
    pose: ShownPose,
    origin: Vector3,
    depth: number,
    palette: Palette,
    pixelRatio: number,
  ) {
    const centre = subtract(pose.position, origin);
    this.centre.set(...centre);
    const rays = cornerRays(pose.camera);
    const corners = frustumCorners(centre, pose.orientation, rays, depth);
    const [a, b, c, d] = corners as [Vector3, Vector3, Vector3, Vector3];
    const plane = imagePlanes(new Float32Array([a, b, c, a, c, d].flat()), palette.pose, 0.2);
    const frame = boldLines(
      new Float32Array([...pyramidEdges(centre, corners), ...upperEdge(a, b, d)]),
      palette.pose,
      2.6,
    );
    this.parts.add(plane, frame);
    this.addInliers(pose.inliers ?? [], centre, origin, palette, pixelRatio);
    let reach = 0;
    if (pose.positionCovariance !== undefined) {
      const { halfAxes, directions } = ellipsoid95(pose.positionCovariance as Matrix3);
      reach = halfAxes[0];
      if (reach > 0) this.parts.add(ellipsoid(centre, halfAxes, directions, palette));
    }
    this.reach = reach;
    this.dot = dots(new Float32Array(centre), palette.pose, palette.ground, DOT_PX * pixelRatio);
    this.parts.add(this.dot);
    // An answer is seen through everything that stands before it.
    for (const part of [plane, frame, this.dot]) onTop(part);
  }

  private addInliers(
    inliers: ArrayLike<number>,
    centre: Vector3,
    origin: Vector3,
    palette: Palette,
    pixelRatio: number,
  ): void {
    const count = Math.floor(inliers.length / 3);
    if (count === 0) return;
    const ends = new Float32Array(6 * count);
    const points = new Float32Array(3 * count);
    for (let i = 0; i < count; i++) {
      for (let axis = 0; axis < 3; axis++) {
        const at = inliers[3 * i + axis]! - origin[axis]!;
        points[3 * i + axis] = ends[6 * i + 3 + axis] = at;
        ends[6 * i + axis] = centre[axis]!;
      }
    }
    const opacity = Math.min(Math.max(12 / count, 0.08), 0.35);
    const marks = dots(points, palette.pose, palette.ground, 5.5 * pixelRatio);
    onTop(marks);
    this.parts.add(thinLines(ends, palette.pose, opacity), marks);
  }

  update(world: Object3D, camera: PerspectiveCamera, height: number): void {
    const distance = world.localToWorld(this.centre.clone()).distanceTo(camera.position);
    const perPixel = (2 * distance * Math.tan((camera.fov / 360) * Math.PI)) / height;
    this.dot.visible = this.reach < UNSEEN_PX * perPixel;
  }
}

/** A small roof on the upper edge of the image, so that one sees which way up it is. */
function upperEdge(left: Vector3, right: Vector3, lowerLeft: Vector3): number[] {
  const down = subtract(lowerLeft, left);
  const top = left.map((v, i) => (v + right[i]!) / 2 - 0.2 * down[i]!);
  const [from, to] = [0.35, 0.65].map((share) =>
    left.map((v, i) => v + share * (right[i]! - v)),
  ) as [number[], number[]];
  return [...from, ...top, ...top, ...to];
}

function ellipsoid(
  centre: Vector3,
  halfAxes: Vector3,
  directions: Matrix3,
  palette: Palette,
): Group {
  const [a, b, c] = halfAxes;
  const r = directions;
  const placed = new Matrix4().set(
    ...[r[0] * a, r[1] * b, r[2] * c, centre[0]],
    ...[r[3] * a, r[4] * b, r[5] * c, centre[1]],
    ...[r[6] * a, r[7] * b, r[8] * c, centre[2]],
    ...([0, 0, 0, 1] as const),
  );
  const body = new Mesh(
    new SphereGeometry(1, 32, 16),
    new MeshBasicMaterial({
      color: palette.pose,
      opacity: 0.18,
      transparent: true,
      depthWrite: false,
    }),
  );
  const rings = thinLines(greatCircles(), palette.pose, 0.9);
  const made = new Group().add(body, rings);
  made.matrix.copy(placed);
  made.matrixAutoUpdate = false;
  for (const part of made.children) onTop(part);
  return made;
}

/** Ends of the edges of three circles of radius 1, around x, y and z. */
function greatCircles(): Float32Array {
  const steps = 64;
  const ends: number[] = [];
  for (let axis = 0; axis < 3; axis++) {
    for (let i = 0; i < 2 * steps; i++) {
      const angle = (Math.ceil(i / 2) / steps) * 2 * Math.PI;
      const at = [0, 0, 0];
      at[(axis + 1) % 3] = Math.cos(angle);
      at[(axis + 2) % 3] = Math.sin(angle);
      ends.push(...at);
    }
  }
  return new Float32Array(ends);
}

function onTop(part: Object3D): void {
  (part as Mesh<never, MeshBasicMaterial>).material.depthTest = false;
  part.renderOrder = 10;
}
