// A walk from its start to its stop: while the camera is open, the page is seen and there is a map,
// frames are localized. Everything around may change meanwhile.
import type { LocalizeResponse, MapInfo } from "visloc-client";
import { localizeFrames, pause, type Frame, type LoopParts } from "./live_loop";
import { cameraProblem } from "./live_media";

export interface SessionParts extends Pick<LoopParts, "grab" | "answered" | "failed"> {
  map(): MapInfo | null;
  /** Whether nobody sees the page. */
  hidden(): boolean;
  openCamera(): Promise<MediaStream>;
  /** Play what the camera sees, so that frames can be read of it; null when it was closed. */
  play(stream: MediaStream | null): Promise<void>;
  localize(map: MapInfo, frame: Frame, signal: AbortSignal): Promise<LocalizeResponse>;
  /** Frames are read from now on. */
  resumed(): void;
  ended(why: string): void;
  /** To be drawn: the message, and with it perhaps the state. */
  changed(): void;
}

export class LiveSession {
  message = "";
  inFlight = 0;
  maxInFlight = 0;
  /** Started by the user; its signal ends with it. Null when off. */
  #started: AbortController | null = null;
  #stream: MediaStream | null = null;
  /** One run of the loop; none while something is missing. */
  #run: AbortController | null = null;
  #ended = Promise.resolve();
  /** Counts, so that a camera that comes after another was chosen is closed again. */
  #opening = 0;

  constructor(readonly parts: SessionParts) {}

  /** From start to stop. */
  get on(): boolean {
    return this.#started !== null;
  }

  /** The camera is open. */
  get filming(): boolean {
    return this.#stream !== null;
  }

  /** Frames are read and sent. */
  get running(): boolean {
    return this.#run !== null;
  }

  async start(): Promise<void> {
    this.#started = new AbortController();
    this.maxInFlight = 0;
    this.say("Waiting for the camera…");
    await this.reopen();
  }

  /** Open the chosen camera in place of the one before. */
  async reopen(): Promise<void> {
    if (this.#started === null) return;
    const { signal } = this.#started;
    this.#interrupt();
    this.#close();
    const mine = (this.#opening += 1);
    const unwanted = (): boolean => signal.aborted || mine !== this.#opening;
    let opened: MediaStream;
    try {
      opened = await this.parts.openCamera();
    } catch (error) {
      // Only getUserMedia was asked; not all browsers derive its OverconstrainedError from Error.
      if (!unwanted()) this.stop(cameraProblem(error as Error));
      return;
    }
    if (unwanted()) return stopTracks(opened);
    this.#stream = opened;
    for (const track of opened.getTracks()) {
      track.addEventListener("ended", () => this.stop("The camera was taken away."));
    }
    await this.parts.play(opened);
    if (!unwanted()) this.resume();
  }

  /** Begin a run, unless something is missing; the one before has ended by then. */
  resume(): void {
    this.#interrupt();
    if (this.#started === null || this.#stream === null || this.parts.hidden()) return;
    const map = this.parts.map();
    if (map === null) return this.say("Choose a map to go on.");
    const { signal } = (this.#run = new AbortController());
    this.#ended = this.#ended.then(() => this.#walk(map, signal));
    this.parts.resumed();
    this.say(`Looking for this place in ${map.id}…`);
  }

  /** End the run, and with it the request that is under way; the camera stays open. */
  pause(why: string): void {
    if (this.#started === null) return;
    this.#interrupt();
    this.say(why);
  }

  stop(why: string): void {
    if (this.#started === null) return;
    this.#started.abort();
    this.#started = null;
    this.#interrupt();
    this.#close();
    this.parts.ended(why);
    this.say(why);
  }

  say(message: string): void {
    this.message = message;
    this.parts.changed();
  }

  #interrupt(): void {
    this.#run?.abort();
    this.#run = null;
  }

  #close(): void {
    if (this.#stream === null) return;
    stopTracks(this.#stream);
    this.#stream = null;
    void this.parts.play(null);
  }

  async #walk(map: MapInfo, signal: AbortSignal): Promise<void> {
    const { grab, answered, failed } = this.parts;
    const ask = (frame: Frame, limited: AbortSignal): Promise<LocalizeResponse> =>
      this.#counted(() => this.parts.localize(map, frame, limited));
    try {
      const why = await localizeFrames({ grab, ask, answered, failed, wait: pause }, signal);
      if (why !== null) this.stop(why);
    } catch (error) {
      this.stop(`Stopped by a mistake of this page: ${String(error)}`);
      reportError(error);
    }
  }

  async #counted<Answer>(ask: () => Promise<Answer>): Promise<Answer> {
    this.inFlight += 1;
    this.maxInFlight = Math.max(this.maxInFlight, this.inFlight);
    try {
      return await ask();
    } finally {
      this.inFlight -= 1;
    }
  }
}

function stopTracks(stream: MediaStream): void {
  for (const track of stream.getTracks()) track.stop();
}
