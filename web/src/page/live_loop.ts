// Frame after frame, one at a time: the next is taken when the answer to the last is there.
import { ownError, ServiceError, type LocalizeResponse } from "visloc-client";
import { afterFailure } from "./live_pace";

/** A frame of the camera. */
export interface Frame {
  jpeg: Blob;
  width: number;
  height: number;
  /** When it was taken, by performance.now() and by the clock (s since 1970). */
  atMs: number;
  timestamp: number;
}

export interface LoopParts {
  /** The newest frame; waits for one when the last is still the newest. */
  grab(signal: AbortSignal): Promise<Frame>;
  ask(frame: Frame, signal: AbortSignal): Promise<LocalizeResponse>;
  answered(answer: LocalizeResponse, frame: Frame): void;
  /** A frame was lost; the loop goes on after a while. */
  failed(message: string): void;
  wait(milliseconds: number, signal: AbortSignal): Promise<void>;
}

// A place that one has left is no answer; and a connection that is gone may never say so. A first
// query that opens a large map takes some seconds.
export const LONGEST_REQUEST_MS = 30_000;

/**
 * Localize frames until `signal` is aborted.
 *
 * There is no queue: a frame is taken only after the request before has ended, so that never more
 * than one is in flight and every one that is sent is fresh.
 *
 * @returns why it ended: words for the user, or null when it was stopped.
 */
export async function localizeFrames(
  parts: LoopParts,
  signal: AbortSignal,
): Promise<string | null> {
  let failures = 0;
  while (!signal.aborted) {
    try {
      const frame = await parts.grab(signal);
      const answer = await withinTime(signal, (limited) => parts.ask(frame, limited));
      failures = 0;
      if (!signal.aborted) parts.answered(answer, frame);
    } catch (error) {
      if (signal.aborted) break;
      if (!(error instanceof ServiceError)) throw error;
      failures += 1;
      const next = afterFailure(error, failures);
      if (next.do === "stop") return next.message;
      parts.failed(next.message);
      await parts.wait(next.milliseconds, signal);
    }
  }
  return null;
}

/** Ask with a signal that also ends when the answer takes too long. */
async function withinTime<Answer>(
  signal: AbortSignal,
  ask: (limited: AbortSignal) => Promise<Answer>,
): Promise<Answer> {
  const limited = new AbortController();
  const stop = (): void => limited.abort();
  signal.addEventListener("abort", stop);
  const clock = setTimeout(stop, LONGEST_REQUEST_MS);
  try {
    return await ask(limited.signal);
  } catch (error) {
    throw limited.signal.aborted ? tooLate() : error;
  } finally {
    clearTimeout(clock);
    signal.removeEventListener("abort", stop);
  }
}

function tooLate(): ServiceError {
  const detail = `nothing came within ${LONGEST_REQUEST_MS / 1000} s`;
  return ownError("server.late", "No answer", detail);
}

/** Wait; ends early, without complaint, when the signal is aborted. */
export function pause(milliseconds: number, signal: AbortSignal): Promise<void> {
  return new Promise((resolve) => {
    if (signal.aborted) return resolve();
    const done = (): void => {
      clearTimeout(clock);
      signal.removeEventListener("abort", done);
      resolve();
    };
    const clock = setTimeout(done, milliseconds);
    signal.addEventListener("abort", done);
  });
}
