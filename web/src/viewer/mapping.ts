// The mapping cameras: all in one set of lines, those that stand out drawn again in another colour.
import { BufferAttribute, Group, Mesh, MeshBasicMaterial, DoubleSide, BufferGeometry } from "three";
import type { Camera, MapImage, Vector3 } from "../api";
import { cornerRays, frustumCorners, subtract } from "../geometry";
import { boldLines, discard, pyramidEdges, thinLines } from "./lines";
import type { Palette } from "./themes";

interface Standing {
  name: string;
  /** In the scene. */
  position: Vector3;
  corners: Vector3[];
}

const HIGHLIGHT_SIZE = 1.25;

export class MappingCameras {
  readonly object = new Group();
  /** The place of each in the scene, by row of `names`. */
  positions: Vector3[] = [];
  names: string[] = [];
  private standing: Standing[] = [];
  private chosen: ReadonlySet<string> = new Set();
  private all: Group | null = null;
  private outstanding: Group | null = null;

  /** How deep a frustum is, in units of the world, is the viewer's to say: `depth`. */
  set(
    images: MapImage[],
    cameras: Record<string, Camera>,
    origin: Vector3,
    depth: number,
    palette: Palette,
  ): void {
    const rays = new Map(Object.entries(cameras).map(([key, one]) => [key, cornerRays(one)]));
    this.standing = images.flatMap((image) => {
      const seen = rays.get(image.camera);
      if (seen === undefined) return [];
      const position = subtract(image.position, origin);
      const corners = frustumCorners(position, image.orientation, seen, depth);
      return [{ name: image.name, position, corners }];
    });
    this.positions = this.standing.map((one) => one.position);
    this.names = this.standing.map((one) => one.name);
    this.paint(palette);
  }

  highlight(names: ReadonlySet<string>, palette: Palette): void {
    this.chosen = names;
    this.paintChosen(palette);
  }

  paint(palette: Palette): void {
    discard(this.all);
    this.all = new Group();
    if (this.standing.length > 0) {
      const ends = this.standing.flatMap((one) => pyramidEdges(one.position, one.corners));
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
    const chosen = this.standing.filter((one) => this.chosen.has(one.name)).map(enlarged);
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

function enlarged(one: Standing): Standing {
  const corners = one.corners.map((corner) => {
    const reach = subtract(corner, one.position);
    return reach.map((v, i) => one.position[i]! + HIGHLIGHT_SIZE * v) as Vector3;
  });
  return { ...one, corners };
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
