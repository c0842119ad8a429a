// A map into the viewer: its cameras, and its landmarks from coarse to fine.
import {
  mapRef,
  type MapImage,
  type MapImages,
  type MapInfo,
  type Service,
  type Vector3,
} from "../api";
import { worldUp } from "../geometry";
import { MAX_POINTS, streamPoints } from "../points";
import type { PointBlock, Viewer } from "../viewer/types";

const IMAGES_PAGE = 5000;
/** More frusta would hide the landmarks. */
export const MAX_IMAGES = 20_000;

export interface Loading {
  signal: AbortSignal;
  /** The viewer has forgotten what it showed. */
  onReset(): void;
  onBlock(block: PointBlock, loaded: number): void;
  onImages(images: MapImages): void;
}

/** Show a map. Throws what the service refuses, and PointsError for landmarks that are none. */
export async function loadMap(
  map: MapInfo,
  service: Service,
  viewer: Viewer,
  loading: Loading,
): Promise<void> {
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

async function allImages(service: Service, ref: string, signal: AbortSignal): Promise<MapImages> {
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

/** Coordinates are kept relative to it, as what is drawn has few digits. */
function middle({ extent }: MapInfo): Vector3 {
  return [0, 1, 2].map((axis) => {
    const value = ((extent.min[axis] ?? 0) + (extent.max[axis] ?? 0)) / 2;
    return Number.isFinite(value) ? value : 0;
  }) as Vector3;
}
