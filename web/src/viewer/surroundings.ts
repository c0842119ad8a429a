// What is not the map itself: the ground grid, the trail of a walk, and the coverage.
import {
  BufferAttribute,
  BufferGeometry,
  Color,
  DoubleSide,
  Group,
  InstancedMesh,
  Matrix4,
  MeshBasicMaterial,
  PerspectiveCamera,
  Quaternion,
  Vector3 as Vector,
} from "three";
import type { Vector3 } from "visloc-client";
import { medianSpacing, niceLength, percentile, subtract } from "../geometry";
import { boldLines, thinLines } from "./lines";
import { probabilityColour, type Palette } from "./themes";
import type { CoverageArrow } from "./types";

// Room around the map where it fills the picture.
const MARGIN = 1.1;
// The share of the landmarks at either end that does not say how large a map is: the rest is
// stretched as if they went on evenly, so that a few landmarks far away do not make the map small.
const OUTSIDE = 0.07;

/** What the map takes up in the scene, up being +y, without its few outermost landmarks. */
export interface Extent {
  min: Vector;
  max: Vector;
  centre: Vector;
  /** Half the diagonal. */
  radius: number;
}

/** What landmarks take up without the outermost, and all cameras. One of both may be empty. */
export function extentOf(landmarks: Vector[], cameras: Vector[]): Extent {
  const [min, max] = [new Vector(), new Vector()];
  for (const axis of ["x", "y", "z"] as const) {
    let [start, end] = [Infinity, -Infinity];
    if (landmarks.length > 0) {
      const along = landmarks.map((place) => place[axis]);
      const [low, high] = [percentile(along, OUTSIDE), percentile(along, 1 - OUTSIDE)];
      const rest = ((high - low) * OUTSIDE) / (1 - 2 * OUTSIDE);
      [start, end] = [low - rest, high + rest];
    }
    for (const place of cameras) {
      start = Math.min(start, place[axis]);
      end = Math.max(end, place[axis]);
    }
    [min[axis], max[axis]] = [start, end];
  }
  const radius = min.distanceTo(max) / 2 || 1; // of a single place, one unit around it
  return { min, max, radius, centre: min.clone().add(max).multiplyScalar(0.5) };
}

/** From where the whole map fills the picture of a camera that looks against `direction`. */
export function wholeView(
  { min, max, centre }: Extent,
  direction: Vector,
  camera: PerspectiveCamera,
): { position: Vector; target: Vector } {
  const right = new Vector(0, 1, 0).cross(direction).normalize();
  const above = new Vector().crossVectors(direction, right);
  const corners = [min.x, max.x].flatMap((x) =>
    [min.y, max.y].flatMap((y) => [min.z, max.z].map((z) => new Vector(x, y, z).sub(centre))),
  );
  const half = Math.tan((camera.fov / 360) * Math.PI);
  const target = centre.clone();
  let away = 0;
  for (const [axis, slope] of [
    [right, (half * camera.aspect) / MARGIN],
    [above, half / MARGIN],
  ] as const) {
    // A corner is seen where its offset along the axis, less the shift of the view, is at most
    // slope times its distance from the eye: `away` less what it is nearer.
    const highest = Math.max(...corners.map((c) => c.dot(axis) + slope * c.dot(direction)));
    const lowest = Math.min(...corners.map((c) => c.dot(axis) - slope * c.dot(direction)));
    away = Math.max(away, (highest - lowest) / (2 * slope));
    target.addScaledVector(axis, (highest + lowest) / 2);
  }
  return { position: target.clone().addScaledVector(direction, away), target };
}

/** A grid below the map, its squares 1, 2 or 5 times a power of ten wide. */
export function groundGrid({ min, max, radius }: Extent, palette: Palette): Group {
  const step = niceLength(radius / 4);
  const lines: number[] = [];
  const [x0, x1] = [Math.floor(min.x / step) - 1, Math.ceil(max.x / step) + 1];
  const [z0, z1] = [Math.floor(min.z / step) - 1, Math.ceil(max.z / step) + 1];
  for (let x = x0; x <= x1; x++) lines.push(x * step, min.y, z0 * step, x * step, min.y, z1 * step);
  for (let z = z0; z <= z1; z++) lines.push(x0 * step, min.y, z * step, x1 * step, min.y, z * step);
  return new Group().add(thinLines(new Float32Array(lines), palette.grid, 0.8));
}

/** A line through positions of the world, one after the other. */
export function trailLine(positions: Vector3[], origin: Vector3, palette: Palette): Group {
  const made = new Group();
  const local = positions.map((position) => subtract(position, origin));
  const ends = local.slice(1).flatMap((position, i) => [...local[i]!, ...position]);
  if (ends.length > 0) made.add(boldLines(new Float32Array(ends), palette.trail, 3));
  return made;
}

/** Wedges that lie level, each at its place and pointing its way, coloured by probability. */
export function coverageArrows(arrows: CoverageArrow[], origin: Vector3, up: Vector3): Group {
  const made = new Group();
  if (arrows.length === 0) return made;
  const places = new Map(arrows.map(({ position }) => [position.join(), position]));
  const reach = 0.46 * (medianSpacing([...places.values()]) ?? 1);
  const material = new MeshBasicMaterial({ side: DoubleSide });
  const mesh = new InstancedMesh(wedge(), material, arrows.length);
  const level = new Vector(...up);
  const placed = new Matrix4();
  arrows.forEach(({ position, direction, probability }, i) => {
    const ahead = new Vector(...direction).projectOnPlane(level).normalize();
    const aside = new Vector().crossVectors(level, ahead);
    placed.makeBasis(aside.multiplyScalar(reach), level, ahead.multiplyScalar(reach));
    placed.setPosition(...subtract(position, origin));
    mesh.setMatrixAt(i, placed);
    mesh.setColorAt(i, new Color().fromArray(probabilityColour(probability)));
  });
  mesh.frustumCulled = false;
  return made.add(mesh);
}

/** A petal of an eighth of a circle from the middle along +z. */
function wedge(): BufferGeometry {
  const geometry = new BufferGeometry();
  const half = 0.3;
  const corners = [
    ...[0, 0, 0.14],
    ...[half, 0, 0.74],
    ...[0, 0, 1],
    ...[0, 0, 0.14],
    ...[0, 0, 1],
    ...[-half, 0, 0.74],
  ];
  geometry.setAttribute("position", new BufferAttribute(new Float32Array(corners), 3));
  return geometry;
}

/** The turn from the world to the scene, where up is +y. */
export function sceneFromWorld(up: Vector3): Quaternion {
  return new Quaternion().setFromUnitVectors(new Vector(...up).normalize(), new Vector(0, 1, 0));
}
