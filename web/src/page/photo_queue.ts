// The photos that were asked about: one on its way at a time, the others wait.
import {
  mapRef,
  ServiceError,
  shortRef,
  type Camera,
  type LocalizeResponse,
  type MapInfo,
  type Service,
} from "../api";
import type { Question } from "./snippets";

/** What is asked about a photo, as it was chosen when the photo came. */
export interface Wish {
  map: MapInfo;
  camera: Camera | null;
  options: Record<string, string | number>;
}

export interface Entry {
  readonly id: number;
  readonly photo: Blob;
  readonly name: string;
  /** Null when it could not even be asked: then `error` says why. */
  wish: Wish | null;
  state: "waiting" | "running" | "answered" | "failed";
  /** Without its picture, which is `overlay`. */
  answer: LocalizeResponse | null;
  /** JPEG; null when the photo came to nothing that could be drawn. */
  overlay: Blob | null;
  error: ServiceError | null;
  /** Whether an API key was sent. */
  withKey: boolean;
  /** From sending to the answer, with the way there and back. */
  seconds: number | null;
}

export interface PhotoQueue {
  readonly entries: readonly Entry[];
  /** `wish` may throw ServiceError: then the photo is not sent. */
  add(photo: Blob, name: string, wish: () => Wish): Entry;
  /** Ask about the same photo again. */
  again(entry: Entry, wish: () => Wish): void;
  /** Forget all of them, also the one on its way. */
  clear(): void;
}

/** `onChange` is told of every change of an entry. */
export function createPhotoQueue(
  service: Service,
  hasKey: () => boolean,
  onChange: (entry: Entry) => void,
): PhotoQueue {
  let entries: Entry[] = [];
  let next = 1;
  let running = new AbortController();
  let busy = false;

  async function work(): Promise<void> {
    if (busy) return;
    busy = true;
    for (;;) {
      const entry = entries.find(({ state }) => state === "waiting");
      if (entry === undefined) break;
      await ask(entry, (running = new AbortController()).signal);
    }
    busy = false;
  }

  async function ask(entry: Entry, signal: AbortSignal): Promise<void> {
    const { photo, name, wish } = entry;
    if (wish === null) return;
    entry.state = "running";
    entry.withKey = hasKey();
    onChange(entry);
    const began = performance.now();
    const { camera, options } = wish;
    const call = { map: mapRef(wish.map), image: photo, name, camera, options, debug: true };
    try {
      keep(entry, await service.localize(call, signal));
    } catch (error) {
      if (signal.aborted) return;
      fail(entry, error);
    }
    entry.seconds = (performance.now() - began) / 1000;
    onChange(entry);
  }

  function start(entry: Entry, wish: () => Wish): void {
    entry.answer = entry.overlay = entry.error = entry.seconds = null;
    try {
      entry.wish = wish();
      entry.state = "waiting";
    } catch (error) {
      fail(entry, error);
    }
    onChange(entry);
    void work();
  }

  return {
    get entries() {
      return entries;
    },
    add(photo, name, wish) {
      const entry: Entry = {
        ...{ id: next++, photo, name, wish: null, state: "waiting", answer: null, overlay: null },
        ...{ error: null, withKey: false, seconds: null },
      };
      entries.push(entry);
      start(entry, wish);
      return entry;
    },
    again(entry, wish) {
      if (entry.state !== "running") start(entry, wish);
    },
    clear() {
      entries = [];
      running.abort();
    },
  };
}

function keep(entry: Entry, answer: LocalizeResponse): void {
  entry.state = "answered";
  const overlay = answer.debug?.overlay ?? "";
  entry.answer =
    answer.debug === null ? answer : { ...answer, debug: { ...answer.debug, overlay: "" } };
  if (overlay !== "") entry.overlay = jpegOf(overlay);
}

function fail(entry: Entry, error: unknown): void {
  if (!(error instanceof ServiceError)) throw error;
  entry.state = "failed";
  entry.error = error;
}

function jpegOf(base64: string): Blob {
  const bytes = Uint8Array.from(atob(base64), (character) => character.charCodeAt(0));
  return new Blob([bytes], { type: "image/jpeg" });
}

/** What was asked, for those who want to ask it themselves. */
export function questionOf(entry: Entry, wish: Wish, server: URL): Question {
  const { camera, options, map } = wish;
  const photo = entry.name;
  return { server, map: shortRef(map), photo, camera, options, withKey: entry.withKey };
}
