// The mapping cameras: all in one set of lines, those that stand out drawn again in another colour.
import { BufferAttribute, Group, Mesh, MeshBasicMaterial, DoubleSide, BufferGeometry } from "three";
import type { Camera, MapImage, Quaternion, Vector3 } from "visloc-client";
import { cornerRays, frustumCorners, subtract } from "../geometry";
import { boldLines, discard, pyramidEdges, thinLines } from "./lines";
import type { Palette } from "./themes";

interface Standing {
  name: string;
  /** In the scene. */
  position: Vector3;
  orientation: Quaternion;
  rays: Vector3[];
}

const HIGHLIGHT_SIZE = 1.25;

export class MappingCameras {
  readonly object = new Group();
  /** How deep frusta are painted, in units of the world. */
  depth = 1;
  /** The place of each in the scene, by row of `names`. */
  positions: Vector3[] = [];
  names: string[] = [];
  private standing: Standing[] = [];
  private chosen: ReadonlySet<string> = new Set();
  private all: Group | null = null;
  private outstanding: Group | null = null;

  /** Say where they stand; to be painted then, as their places say how deep they can be. */
  set(images: MapImage[], cameras: Record<string, Camera>, origin: Vector3): void {
    const raysOf = new Map(Object.entries(cameras).map(([key, one]) => [key, cornerRays(one)]));
    this.standing = images.flatMap(({ name, camera, position, orientation }) => {
      const rays = raysOf.get(camera);
      return rays === undefined
        ? []
        : [{ name, position: subtract(position, origin), orientation, rays }];
    });
    this.positions = this.standing.map((one) => one.position);
    this.names = this.standing.map((one) => one.name);
  }

  highlight(names: ReadonlySet<string>, palette: Palette): void {
    this.chosen = names;
    this.paintChosen(palette);
  }

  paint(palette: Palette): void {
    discard(this.all);
    this.all = new Group();
    if (this.standing.length > 0) {
      const ends = this.standing.flatMap((one) => pyramidEdges(one.position, this.corners(one)));
      // Many lines on top of each other need less of each.
      const opacity = this.standing.length > 300 ? 0.45 : 0.8;
      const lines = thinLines(new Float32Array(ends), palette.camera, opacity);
      lines.frustumCulled = false;
      this.all.add(lines);
    }
    this.object.add(this.all);
    this.paintChosen(palette);
  }

  private paintChosen(palette: Palette): void {
    discard(this.outstanding);
    this.outstanding = new Group();
    const chosen = this.standing
      .filter((one) => this.chosen.has(one.name))
      .map((one) => ({ position: one.position, corners: this.corners(one, HIGHLIGHT_SIZE) }));
    if (chosen.length > 0) {
      const ends = chosen.flatMap((one) => pyramidEdges(one.position, one.corners));
      const faces = chosen.flatMap(({ corners: [a, b, c, d] }) =>
        [a!, b!, c!, a!, c!, d!].flatMap((v) => v),
      );
      this.outstanding.add(
        imagePlanes(new Float32Array(faces), palette.highlight, 0.22),
        boldLines(new Float32Array(ends), palette.highlight, 1.8),
      );
    }
    this.object.add(this.outstanding);
  }

  private corners({ position, orientation, rays }: Standing, size = 1): Vector3[] {
    return frustumCorners(position, orientation, rays, size * this.depth);
  }

  clear(): void {
    discard(this.all);
    discard(this.outstanding);
    this.all = this.outstanding = null;
    this.standing = [];
    this.positions = [];
    this.names = [];
    this.chosen = new Set();
  }
}

/** Translucent triangles. */
export function imagePlanes(corners: Float32Array, colour: string, opacity: number): Mesh {
  const geometry = new BufferGeometry();
  geometry.setAttribute("position", new BufferAttribute(corners, 3));
  const material = new MeshBasicMaterial({
    color: colour,
    opacity,
    transparent: true,
    depthWrite: false,
    side: DoubleSide,
  });
  return new Mesh(geometry, material);
}
