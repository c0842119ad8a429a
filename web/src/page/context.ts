// What the parts of the page share.
import type { Camera, MapInfo, Client } from "visloc-client";
import type { Viewer } from "../viewer/types";

export interface PageContext {
  readonly service: Client;
  readonly viewer: Viewer;
  /** The map that is shown; null before one is chosen. */
  map(): MapInfo | null;
  /**
   * As typed; null leaves it to the photo's EXIF.
   *
   * Throws ServiceError when what was typed is no camera: nothing else is sent in its place.
   */
  camera(): Camera | null;
  /** What was changed from the service's defaults: of POST /localize. Throws as `camera` does. */
  options(): Record<string, string | number>;
  /**
   * A walk begins: what is drawn of a photo is taken away, and no photo is drawn until somebody
   * asks about one or looks at one again. That stops Live.
   */
  walkBegins(): void;
  /** Say it to those who do not see the page. */
  announce(text: string): void;
  /** Be told of every map that is chosen from now on. */
  onMapChange(listener: (map: MapInfo | null) => void): void;
}
