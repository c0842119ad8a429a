// How fast answers come, how long they take, and how long to wait after one that failed.
import { ServiceError } from "visloc-client";

/** Counts what happened within the last `spanMs`, as a rate. */
export class RateWindow {
  #times: number[] = [];
  #since: number | null = null;

  constructor(readonly spanMs: number) {}

  /** Begin anew: nothing has happened yet. */
  start(nowMs: number): void {
    this.#times = [];
    this.#since = nowMs;
  }

  add(nowMs: number): void {
    this.#times.push(nowMs);
  }

  /** Per second, over the span or over the time since the start where that is shorter. */
  perSecond(nowMs: number): number {
    if (this.#since === null) return 0;
    this.#times = this.#times.filter((time) => time > nowMs - this.spanMs);
    const lastedMs = Math.min(this.spanMs, nowMs - this.#since);
    // The first second says little: one answer after 100 ms is not ten per second for long.
    return this.#times.length / (Math.max(lastedMs, 1000) / 1000);
  }
}

/** The last `most` of something, oldest first. */
export class Recent<Value> {
  #values: Value[] = [];

  constructor(readonly most: number) {}

  add(value: Value): void {
    this.#values.push(value);
    if (this.#values.length > this.most) this.#values.shift();
  }

  clear(): void {
    this.#values = [];
  }

  get values(): readonly Value[] {
    return this.#values;
  }
}

/** The middle one, or the mean of the two in the middle; null of nothing. */
export function median(values: readonly number[]): number | null {
  const sorted = [...values].sort((a, b) => a - b);
  const middle = sorted.length / 2;
  const above = sorted[Math.floor(middle)];
  const below = sorted[Math.ceil(middle) - 1];
  return above === undefined || below === undefined ? null : (above + below) / 2;
}

/** What to do after a frame that was not answered. */
export type AfterFailure =
  { do: "wait"; milliseconds: number; message: string } | { do: "stop"; message: string };

const LONGEST_WAIT_MS = 5000;

/**
 * Decide what a failure means for the next frame.
 *
 * What the page itself found wrong, such as an option, stays wrong until somebody changes it.
 * A service that is busy says how long to wait; one that cannot be reached, or that made a mistake,
 * is asked again after 0.5 s, 1 s, 2 s and then every 5 s; whatever else it refuses it would refuse
 * of the next frame too.
 *
 * @param inARow failures without an answer in between, this one included.
 */
export function afterFailure(error: ServiceError, inARow: number): AfterFailure {
  const { problem, retryAfterSeconds } = error;
  if (problem.status === 429 || problem.status === 503) {
    const seconds = retryAfterSeconds ?? 1;
    const message = `The service is busy (${problem.detail}); waiting ${seconds} s as it asks.`;
    return { do: "wait", milliseconds: seconds * 1000, message };
  }
  const unanswered = problem.status === 0 && problem.code.startsWith("server.");
  if (unanswered || problem.status >= 500) {
    const milliseconds = Math.min(500 * 2 ** (inARow - 1), LONGEST_WAIT_MS);
    const what = unanswered ? "No answer" : "The service failed";
    const message = `${what} (${problem.detail}); trying again in ${milliseconds / 1000} s.`;
    return { do: "wait", milliseconds, message };
  }
  if (problem.status === 401) {
    return { do: "stop", message: `The service wants an API key: ${problem.detail}.` };
  }
  const who = problem.status === 0 ? "Nothing is sent" : "The service refuses these frames";
  return { do: "stop", message: `${who}: ${inWords(error)}.` };
}

function inWords({ problem }: ServiceError): string {
  const parts = [problem.detail];
  if (problem.field !== null) parts.push(`field ${problem.field}`);
  if (problem.expected !== null) parts.push(`expected ${problem.expected}`);
  if (problem.got !== null) parts.push(`got ${problem.got}`);
  return parts.join("; ");
}
