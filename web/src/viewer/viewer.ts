// The 3D view of a map. Draws when something has changed, and only then.
import { Group, Scene, Vector3 as Vector } from "three";
import type { Camera, MapImage, Vector3 } from "visloc-client";
import { element } from "../dom";
import { add, medianSpacing, scale, subtract, viewingDirection } from "../geometry";
import { counted } from "../words";
import { Cloud } from "./cloud";
import { openGraphics } from "./graphics";
import { discard } from "./lines";
import { MappingCameras } from "./mapping";
import { Overlay } from "./overlay";
import { Pace } from "./pace";
import { PoseMarks } from "./pose";
import { Steering } from "./steering";
import {
  coverageArrows,
  extentOf,
  groundGrid,
  sceneFromWorld,
  trailLine,
  wholeView,
  type Extent,
} from "./surroundings";
import { PALETTES } from "./themes";
import type { CoverageArrow, CreateViewer, ShownPose, Theme, Viewer } from "./types";
import "./viewer.css";

// Landmarks that say how large the map is; the first are spread evenly.
const EXTENT_SAMPLE = 5000;
// In a picture while the view rests: where the processor draws, it does so after a moment only, as
// moves come less often than pictures would.
const QUIET_MS = 150;
const RESTING_POINTS = 131_072;
const PICK_PX = 12;
// From the side and above: enough to tell heights, not so much that walls hide rooms.
const OVERVIEW = new Vector(0.55, 0.62, 0.75).normalize();

export const createViewer: CreateViewer = (host: HTMLElement, theme: Theme): Viewer => {
  const created = performance.now();
  const canvas = element("canvas", { tabindex: 0, role: "application" });
  const root = element("div", { class: "viewer" }, canvas);
  const { renderer, software } = openGraphics(canvas);
  host.append(root);
  const overlay = new Overlay(root);
  const cloud = new Cloud();
  const pace = new Pace(software ? 40_000 : 1_000_000);
  const scene = new Scene();
  const world = new Group();
  scene.add(world);
  const mapping = new MappingCameras();
  const marks = new PoseMarks();
  world.add(mapping.object, marks.object);

  let palette = PALETTES[theme];
  let origin: Vector3 = [0, 0, 0];
  let up: Vector3 = [0, 1, 0];
  let metric = false;
  let images: MapImage[] = [];
  let cameras: Record<string, Camera> = {};
  let poses: ShownPose[] = [];
  let trail: Vector3[] = [];
  let coverage: CoverageArrow[] = [];
  let grid: Group | null = null;
  let trailObject: Group | null = null;
  let coverageObject: Group | null = null;
  let extent: Extent | null = null;
  /** Whether the view is that of the whole map, as far as the program moved it. */
  let framing = true;
  let size = { width: 1, height: 1 };
  let pixelRatio = 1;
  let firstPictureMs: number | null = null;

  let requested: number | null = null;
  let viewMoved = true;
  let lost = false;
  let drawnBefore = false;
  let lastMoved = -Infinity;

  const request = (): void => {
    if (!lost) requested ??= requestAnimationFrame(draw);
  };
  const move = (): void => {
    viewMoved = true;
    request();
  };
  const steering = new Steering(canvas, !software, move, () => viewer.overview());

  function draw(now: number): void {
    requested = null;
    if (firstPictureMs === null && drawnBefore) {
      firstPictureMs = performance.now() - created;
    }
    const flying = steering.update(now);
    if (extent !== null) steering.enclose(extent.centre, extent.radius);
    const moved = viewMoved;
    viewMoved = false;
    if (moved) lastMoved = now;
    else if (software && now - lastMoved < QUIET_MS) {
      request();
      return;
    }
    if (moved && cloud.loaded > 0) pace.moved(now, cloud.drawn);
    const { camera } = steering;
    world.updateMatrixWorld();
    const middle = Math.max(steering.distance, 0.4 * (extent?.radius ?? 0));
    const view = { pixelRatio, middle };
    renderer.clear();
    if (moved && software) {
      cloud.drawPlain(renderer, camera, view, pace.points);
    } else {
      // At rest a picture may take longer, though not so long that a movement starts late.
      const count = moved ? pace.points : Math.max(pace.points, RESTING_POINTS);
      cloud.draw(renderer, camera, view, count, moved);
      cloud.present(renderer, camera, !software || cloud.drawn === cloud.loaded);
    }
    marks.update(camera, size.height);
    renderer.render(scene, camera);
    const halfHeight = steering.distance * Math.tan((camera.fov / 360) * Math.PI);
    overlay.setScale((2 * halfHeight) / size.height, metric);
    overlay.setAxes(world.quaternion, camera);
    drawnBefore = cloud.drawn > 0;
    if (flying) viewMoved = true;
    // After a movement once more: damping may carry it on, and what was left out is to come.
    if (moved || flying || cloud.drawn < cloud.loaded) request();
    else if (drawnBefore && firstPictureMs === null) request();
  }

  /**
   * How large the map is: what the first landmarks take up without the outermost, and all cameras.
   * The view shows all of it until it is moved.
   */
  function measure(): void {
    const sample = cloud.sample(EXTENT_SAMPLE);
    if (sample.length + mapping.positions.length === 0) return;
    const inScene = (place: Vector3): Vector =>
      new Vector(...place).applyQuaternion(world.quaternion);
    extent = extentOf(sample.map(inScene), mapping.positions.map(inScene));
    const { radius } = extent;
    steering.bound(radius);
    discard(grid);
    grid = groundGrid(extent, palette);
    scene.add(grid);
    if (framing && !steering.touched) viewer.overview();
  }

  /** How deep frusta are drawn: less than what is between cameras, and to be seen in the map. */
  function depth(): number {
    const radius = extent?.radius ?? 1;
    const spacing = medianSpacing(mapping.positions) ?? 0.05 * radius;
    return Math.min(Math.max(0.8 * spacing, 0.012 * radius), 0.05 * radius);
  }

  function showCameras(): void {
    mapping.set(images, cameras, origin);
    measure();
    paintCameras();
    describe();
  }

  function paintCameras(): void {
    mapping.depth = depth();
    mapping.paint(palette);
    request();
  }

  function showPoses(): void {
    marks.set(poses, origin, 1.6 * depth(), palette, pixelRatio);
    describe();
    request();
  }

  function showSurroundings(): void {
    discard(trailObject);
    discard(coverageObject);
    trailObject = trailLine(trail, origin, palette);
    coverageObject = coverageArrows(coverage, origin, up);
    world.add(trailObject, coverageObject);
    request();
  }

  /** Say in words what the picture shows. */
  function describe(): void {
    const parts = [
      counted(cloud.loaded, "landmark"),
      ...(images.length > 0 ? [counted(images.length, "mapping photo")] : []),
      ...(poses.length === 1
        ? [`the camera of the ${poses[0]?.fromLink ? "link" : "last answer"}`]
        : []),
      ...(poses.length > 1 ? [`${poses.length} places that the last photo may be of`] : []),
      ...(coverage.length > 0 ? ["where a photo would be localized"] : []),
    ];
    canvas.setAttribute(
      "aria-label",
      `The map in 3D: ${parts.join(", ")}. ` +
        "Arrow keys turn the view, plus and minus zoom, Home shows the whole map.",
    );
  }

  function resize(): void {
    size = { width: Math.max(root.clientWidth, 1), height: Math.max(root.clientHeight, 1) };
    pixelRatio = Math.min(window.devicePixelRatio, 2);
    renderer.setPixelRatio(pixelRatio);
    renderer.setSize(size.width, size.height);
    cloud.resize(canvas.width, canvas.height, pixelRatio);
    steering.camera.aspect = size.width / size.height;
    steering.camera.updateProjectionMatrix();
    move();
    // The canvas is empty now: fill it before it is shown.
    if (requested !== null) cancelAnimationFrame(requested);
    draw(performance.now());
  }

  /** The name of the camera under the pointer. */
  function point(event: PointerEvent): void {
    if (event.buttons !== 0 && event.type === "pointermove") {
      overlay.showName(null);
      return;
    }
    const [x, y] = [event.offsetX, event.offsetY];
    const place = new Vector();
    let best = PICK_PX;
    let name: string | null = null;
    if (mapping.object.visible) {
      mapping.positions.forEach((position, i) => {
        place
          .set(...position)
          .applyMatrix4(world.matrixWorld)
          .project(steering.camera);
        if (place.z > 1) return;
        const off = Math.hypot(
          ((place.x + 1) / 2) * size.width - x,
          ((1 - place.y) / 2) * size.height - y,
        );
        if (off < best) [best, name] = [off, mapping.names[i]!];
      });
    }
    overlay.showName(name, x, y, size.width);
  }

  const toScene = (position: Vector3): Vector =>
    world.localToWorld(new Vector(...subtract(position, origin)));
  const toWorld = (position: Vector): Vector3 =>
    add(world.worldToLocal(position.clone()).toArray(), origin);

  const viewer: Viewer = {
    reset(given) {
      ({ origin, up, metric } = given);
      cloud.clear();
      mapping.clear();
      marks.set([], origin, 1, palette, pixelRatio);
      discard(grid);
      [images, cameras, poses, trail, coverage] = [[], {}, [], [], []];
      [extent, grid] = [null, null];
      framing = true;
      steering.touched = false;
      world.quaternion.copy(sceneFromWorld(up));
      world.updateMatrixWorld();
      cloud.object.quaternion.copy(world.quaternion);
      showSurroundings();
      describe();
      move();
    },
    addPoints(block) {
      cloud.add(block, origin);
      if (block.first === 0) {
        measure();
        if (images.length > 0) paintCameras();
        if (poses.length > 0) showPoses();
      }
      describe();
      request();
    },
    setPointColours(by) {
      cloud.by = by;
      move();
    },
    setPointSize(pixels) {
      cloud.pixels = pixels;
      move();
    },
    setMappingCameras(given, byId) {
      [images, cameras] = [given, byId];
      showCameras();
    },
    showMappingCameras(shown) {
      mapping.object.visible = shown;
      request();
    },
    highlight(names) {
      mapping.highlight(names, palette);
      request();
    },
    showPoses(given) {
      poses = given;
      showPoses();
    },
    setTrail(positions) {
      trail = positions;
      showSurroundings();
    },
    setCoverage(arrows) {
      coverage = arrows;
      describe();
      showSurroundings();
    },
    overview() {
      if (extent === null) return;
      const { position, target } = wholeView(extent, OVERVIEW, steering.camera);
      framing = true;
      steering.go(position, target, cloud.drawn === 0);
    },
    flyTo(frustum) {
      const ahead = viewingDirection(frustum.orientation);
      // So far that what lies around can be made out, not only the few points just ahead.
      const back = Math.max(4 * depth(), 0.2 * (extent?.radius ?? 0));
      const behind = add(add(frustum.position, scale(ahead, -1.6 * back)), scale(up, 0.55 * back));
      const target = add(frustum.position, scale(ahead, 1.5 * back));
      framing = false;
      steering.go(toScene(behind), toScene(target));
    },
    setTheme(given) {
      palette = PALETTES[given];
      root.dataset.viewerTheme = given;
      renderer.setClearColor(palette.ground);
      cloud.setPalette(palette);
      mapping.paint(palette);
      discard(grid);
      grid = null;
      if (extent !== null) scene.add((grid = groundGrid(extent, palette)));
      showPoses();
      showSurroundings();
      move();
    },
    get statistics() {
      return {
        pointsLoaded: cloud.loaded,
        pointsDrawn: cloud.drawn,
        framesPerSecond: pace.framesPerSecond,
        firstPictureMs,
      };
    },
    get extent(): Vector3 | null {
      if (extent === null) return null;
      const { x, y, z } = extent.max.clone().sub(extent.min);
      return [x, z, y];
    },
    get viewpoint() {
      return { position: toWorld(steering.camera.position), target: toWorld(steering.target) };
    },
    dispose() {
      if (requested !== null) cancelAnimationFrame(requested);
      lost = true; // so that nothing is drawn any more
      observer.disconnect();
      steering.dispose();
      for (const one of [world, grid]) discard(one);
      cloud.dispose();
      renderer.dispose();
      root.remove();
    },
  };

  canvas.addEventListener("pointermove", point);
  canvas.addEventListener("pointerup", point);
  canvas.addEventListener("pointerleave", () => overlay.showName(null));
  canvas.addEventListener("webglcontextlost", (event) => {
    event.preventDefault();
    lost = true;
    overlay.tell("The graphics memory was lost. The map comes back as soon as the browser can.");
  });
  canvas.addEventListener("webglcontextrestored", () => {
    lost = false;
    renderer.setClearColor(palette.ground); // forgotten with the memory
    overlay.tell(null);
    move();
  });
  viewer.setTheme(theme);
  describe();
  const observer = new ResizeObserver(resize);
  observer.observe(root);
  return viewer;
};
