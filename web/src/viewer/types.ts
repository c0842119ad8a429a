// What can be shown of a map, and what the page and the report ask of the viewer.
import type { Camera, MapImage, PointBlock, Quaternion, Vector3 } from "visloc-client";

/** A camera to draw: world_from_cam, and how it sees. */
export interface Frustum {
  position: Vector3;
  orientation: Quaternion;
  camera: Camera;
}

/** An answer to draw: the frustum, its uncertainty, and what it rests on. */
export interface ShownPose extends Frustum {
  /** 3 x 3, row by row, of the position in the world; the ellipsoid is drawn at 95 %. */
  positionCovariance?: number[];
  /** x, y, z of each inlier in the world, one after the other; a ray goes to each. */
  inliers?: ArrayLike<number>;
  /** It came with a link, and is no answer. */
  fromLink?: boolean;
}

/** One cell of the coverage: how likely a photo taken here, looking that way, is localized. */
export interface CoverageArrow {
  position: Vector3;
  direction: Vector3;
  /** 0 to 1. */
  probability: number;
}

export type PointColours = "photo" | "seen_by";
export type Theme = "light" | "dark";

export interface ViewerStatistics {
  pointsLoaded: number;
  /** In the last picture; fewer than loaded while the view moves on a slow machine. */
  pointsDrawn: number;
  /** Of the last second in which something moved; null before. */
  framesPerSecond: number | null;
  /** Milliseconds from construction to the first picture with points; null before. */
  firstPictureMs: number | null;
}

export interface Viewer {
  /** Forget everything that is shown. `up` is the world's; coordinates are relative to `origin`. */
  reset(scene: { origin: Vector3; up: Vector3; metric: boolean }): void;
  addPoints(block: PointBlock): void;
  setPointColours(by: PointColours): void;
  setPointSize(pixels: number): void;
  setMappingCameras(images: MapImage[], cameras: Record<string, Camera>): void;
  showMappingCameras(shown: boolean): void;
  /** Mapping cameras to stand out, such as those retrieved. */
  highlight(names: ReadonlySet<string>): void;
  /** Draw poses and what belongs to them, instead of those before; [] draws none. */
  showPoses(poses: ShownPose[]): void;
  /** Positions of a walk, joined by a line. */
  setTrail(positions: Vector3[]): void;
  setCoverage(arrows: CoverageArrow[]): void;
  /** Look at the whole map. */
  overview(): void;
  /** Move the view behind a camera, so that one sees what it saw. */
  flyTo(frustum: Frustum): void;
  setTheme(theme: Theme): void;
  readonly statistics: ViewerStatistics;
  /** Width, depth and height of the map without its few outermost landmarks; null before any. */
  readonly extent: Vector3 | null;
  /** Where the view looks from, in the world: for tests and links. */
  readonly viewpoint: { position: Vector3; target: Vector3 };
  dispose(): void;
}

/**
 * Make a viewer that fills `host`, which says what it shows in words for those who cannot see.
 * Throws NoGraphics, and leaves `host` as it is, where the browser has no WebGL 2.
 */
export type CreateViewer = (host: HTMLElement, theme: Theme) => Viewer;
