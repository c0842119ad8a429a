// The photos that were asked about: one on its way at a time, the others wait.
import {
  mapRef,
  ownError,
  ServiceError,
  type Camera,
  type LocalizeResponse,
  type MapInfo,
  type Client,
} from "visloc-client";
import { pause } from "./live_loop";
import { busySeconds } from "./patience";
import type { Question } from "./snippets";
import { shortRef } from "../words";

/** What is asked about a photo, as it was chosen when the photo came. */
export interface Wish {
  map: MapInfo;
  /** Ids of maps that are searched beside it. */
  others: string[];
  /** Whether the answer brings the matches and a picture of them: about a megabyte. */
  debug: boolean;
  camera: Camera | null;
  options: Record<string, string | number>;
}

export interface Entry {
  readonly id: number;
  /** The file; once it was read, what was in it, as files change. */
  photo: Blob;
  readonly name: string;
  /** Null when it could not even be asked: then `error` says why. */
  wish: Wish | null;
  state: "waiting" | "running" | "answered" | "failed";
  /** How long the service, which is busy, asked to wait; null when it did not. */
  waitSeconds: number | null;
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
  service: Client,
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
      const { signal } = (running = new AbortController());
      await ask(entry, signal);
      if (entry.waitSeconds !== null) await pause(1000 * entry.waitSeconds, signal);
    }
    busy = false;
  }

  /** Ask about a photo; afterwards it waits only where the service asked to. Throws nothing. */
  async function ask(entry: Entry, signal: AbortSignal): Promise<void> {
    entry.state = "running";
    entry.waitSeconds = null;
    entry.withKey = hasKey();
    tell(entry);
    try {
      const call = await read(entry);
      signal.throwIfAborted();
      const began = performance.now();
      const answer = await service.localize(call, signal);
      entry.seconds = (performance.now() - began) / 1000;
      keep(entry, answer);
    } catch (error) {
      if (signal.aborted) return;
      fail(entry, error);
    }
    tell(entry);
  }

  /** What shows the photos may have a mistake: the next one is asked about all the same. */
  function tell(entry: Entry): void {
    try {
      onChange(entry);
    } catch (error) {
      reportError(error);
    }
  }

  function start(entry: Entry, wish: () => Wish): void {
    entry.answer = entry.overlay = entry.error = entry.seconds = entry.waitSeconds = null;
    try {
      entry.wish = wish();
      entry.state = "waiting";
    } catch (error) {
      fail(entry, error);
    }
    tell(entry);
    void work();
  }

  return {
    get entries() {
      return entries;
    },
    add(photo, name, wish) {
      const entry: Entry = {
        ...{ id: next++, photo, name, wish: null, state: "waiting", waitSeconds: null },
        ...{ answer: null, overlay: null, error: null, withKey: false, seconds: null },
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

/** Read the file, and with it what is to be asked. */
async function read(entry: Entry) {
  const { name, wish } = entry;
  if (wish === null) throw new Error("a photo waits that was never asked about");
  let bytes: ArrayBuffer;
  try {
    bytes = await entry.photo.arrayBuffer();
  } catch (error) {
    if (!(error instanceof DOMException)) throw error;
    throw ownError("page.file", "This file cannot be read", "it is gone, or a folder", {
      expected: "a photo",
      got: error.message,
    });
  }
  entry.photo = new Blob([bytes], { type: entry.photo.type });
  const { map, others, camera, options, debug } = wish;
  return { map: [mapRef(map), ...others], image: entry.photo, name, camera, options, debug };
}

function keep(entry: Entry, answer: LocalizeResponse): void {
  const overlay = answer.debug?.overlay ?? "";
  if (overlay !== "") entry.overlay = jpegOf(overlay);
  entry.answer =
    answer.debug === null ? answer : { ...answer, debug: { ...answer.debug, overlay: "" } };
  entry.state = "answered";
}

function fail(entry: Entry, error: unknown): void {
  if (error instanceof ServiceError) {
    entry.waitSeconds = busySeconds(error);
    entry.state = entry.waitSeconds === null ? "failed" : "waiting";
    entry.error = entry.waitSeconds === null ? error : null;
    return;
  }
  entry.state = "failed";
  entry.error = ownError("page.mistake", "This page made a mistake", String(error));
  reportError(error);
}

function jpegOf(base64: string): Blob {
  const bytes = Uint8Array.from(atob(base64), (character) => character.charCodeAt(0));
  return new Blob([bytes], { type: "image/jpeg" });
}

/** What was asked, for those who want to ask it themselves. */
export function questionOf(entry: Entry, wish: Wish, server: URL): Question {
  const { camera, options, map, others } = wish;
  const maps = [shortRef(map), ...others];
  return { server, maps, photo: entry.name, camera, options, withKey: entry.withKey };
}
