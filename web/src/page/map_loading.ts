// A map into the viewer: its cameras, and its landmarks from coarse to fine.
import {
  mapRef,
  ROW_BYTES,
  type MapImage,
  type MapImages,
  type MapInfo,
  type PointBlock,
  type Client,
  type Tile,
  type Vector3,
} from "visloc-client";
import { add, apply, product, rotationMatrix, scale, worldUp } from "../geometry";
import { MAX_POINTS, streamPoints } from "../points";
import type { Viewer } from "../viewer/types";
import { counted, countText } from "../words";

const IMAGES_PAGE = 5000;
/** More frusta would hide the landmarks. */
export const MAX_IMAGES = 20_000;
/** Of a set: each tile takes two requests. */
const MAX_TILES = 200;
/** Landmarks that one request gives at most. */
const MAX_PAGE = 262_144;

export interface Loading {
  signal: AbortSignal;
  /** The viewer has forgotten what it showed. */
  onReset(): void;
  onBlock(block: PointBlock, loaded: number): void;
  /** Of a set: all landmarks that are shown are here, of those that it has. */
  onEnd(loaded: number, total: number): void;
  onImages(images: MapImages): void;
}

/** Show a map, or the tiles of a set. Throws what the service refuses, and PointsError for landmarks that are none. */
export async function loadMap(
  map: MapInfo,
  service: Client,
  viewer: Viewer,
  loading: Loading,
): Promise<void> {
  if (map.kind === "set") return loadTiles(map, service, viewer, loading);
  const { signal } = loading;
  const ref = mapRef(map);
  const reset = (known: MapImage[]): void => {
    viewer.reset({ origin: middle(map), up: worldUp(map.down, known), metric: map.metric });
    loading.onReset();
  };
  // At once: what is shown and what is answered are of one map, also when this one never comes.
  reset([]);
  const images = allImages(service, ref, signal);
  // Which way is up must be known before the first picture; many maps do not say.
  if (map.down.length !== 3) {
    const known = await images;
    signal.throwIfAborted();
    reset(known.images);
  }

  const cameras = images.then((all) => {
    signal.throwIfAborted();
    viewer.setMappingCameras(all.images, all.cameras);
    loading.onImages(all);
  });
  const points = streamPoints(
    (first, count) => service.points(ref, first, count, signal),
    (block) => {
      viewer.addPoints(block);
      loading.onBlock(block, block.first + block.count);
    },
    signal,
    MAX_POINTS,
  );
  await Promise.all([cameras, points]);
}

async function allImages(service: Client, ref: string, signal: AbortSignal): Promise<MapImages> {
  const all = await service.images(ref, 0, IMAGES_PAGE, signal);
  const wanted = Math.min(all.total, MAX_IMAGES);
  while (all.images.length < wanted) {
    const next = await service.images(ref, all.images.length, IMAGES_PAGE, signal);
    if (next.images.length === 0) break;
    all.images.push(...next.images);
    Object.assign(all.cameras, next.cameras);
  }
  return all;
}

/** Says of a set with more maps than are shown how many are; of others, nothing. */
export function shownTiles(map: MapInfo): string {
  const count = map.kind === "set" ? map.tiles.length : 0;
  if (count <= MAX_TILES) return "";
  return `The first ${countText(MAX_TILES)} of ${counted(count, "map")} are shown.`;
}

/** Show the tiles of a set in its frame: the first ones of a large set, and an even sample of each. */
async function loadTiles(
  map: MapInfo,
  service: Client,
  viewer: Viewer,
  loading: Loading,
): Promise<void> {
  const { signal } = loading;
  const tiles = map.tiles.slice(0, MAX_TILES);
  const share = Math.min(MAX_PAGE, Math.floor(MAX_POINTS / Math.max(1, tiles.length)));
  const all: MapImages = { map, total: map.images, first: 0, cameras: {}, images: [] };
  let loaded = 0;
  viewer.reset({ origin: middle(map), up: worldUp(map.down, []), metric: map.metric });
  loading.onReset();
  for (const tile of tiles) {
    const ref = mapRef({ id: tile.map, version: tile.version });
    const [images, points] = await Promise.all([
      service.images(ref, 0, IMAGES_PAGE, signal),
      service.points(ref, 0, share, signal),
    ]);
    signal.throwIfAborted();
    for (const image of images.images.slice(0, MAX_IMAGES - all.images.length)) {
      all.images.push({ ...movedImage(image, tile), camera: `${ref}/${image.camera}` });
    }
    for (const [id, camera] of Object.entries(images.cameras)) all.cameras[`${ref}/${id}`] = camera;
    const block = movedBlock(points, tile);
    viewer.addPoints(block);
    loaded += block.count;
    loading.onBlock({ ...block, total: Math.max(map.landmarks, loaded) }, loaded);
  }
  if (map.landmarks > 0) loading.onEnd(loaded, Math.max(map.landmarks, loaded));
  viewer.setMappingCameras(all.images, all.cameras);
  loading.onImages(all);
}

/** A mapping photo of a tile in the frame of the set. */
function movedImage(image: MapImage, { set_from_tile: to }: Tile): MapImage {
  const rotation = rotationMatrix(to.rotation_wxyz);
  const position = add(scale(apply(rotation, image.position), to.scale), to.translation);
  return { ...image, position, orientation: product(to.rotation_wxyz, image.orientation) };
}

/** Landmarks of a tile in the frame of the set. */
export function movedBlock(block: PointBlock, { set_from_tile: to }: Tile): PointBlock {
  const rotation = rotationMatrix(to.rotation_wxyz);
  const view = new DataView(block.rows);
  for (let row = 0; row < block.count; row++) {
    const at = [0, 4, 8].map((offset) => row * ROW_BYTES + offset) as Vector3;
    const point = at.map((offset) => view.getFloat32(offset, true)) as Vector3;
    const moved = scale(apply(rotation, point), to.scale);
    at.forEach((offset, axis) => view.setFloat32(offset, moved[axis] ?? 0, true));
  }
  const origin = add(scale(apply(rotation, block.origin), to.scale), to.translation);
  return { ...block, origin };
}

/** Coordinates are kept relative to it, as what is drawn has few digits. */
function middle({ extent }: MapInfo): Vector3 {
  return [0, 1, 2].map((axis) => {
    const value = ((extent.min[axis] ?? 0) + (extent.max[axis] ?? 0)) / 2;
    return Number.isFinite(value) ? value : 0;
  }) as Vector3;
}
