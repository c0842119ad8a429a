// The figures of a walk: how many answers a second, how long they take, how many are poses.
import type { LocalizeResponse } from "visloc-client";
import { secondsText } from "../words";
import { RateWindow, Recent, median } from "./live_pace";

const RATE_SPAN_MS = 5000;
const LATENCIES = 50;
const SHARE_OF = 20;

export class LiveFigures {
  answers = 0;
  localized = 0;
  errors = 0;
  #rate = new RateWindow(RATE_SPAN_MS);
  #latencies = new Recent<{ whole: number; server: number }>(LATENCIES);
  #outcomes = new Recent<boolean>(SHARE_OF);

  /** Count from nothing. */
  clear(): void {
    this.answers = this.localized = this.errors = 0;
    this.#latencies.clear();
    this.#outcomes.clear();
  }

  /** The rate counts from here: no answer is to be expected of the time before. */
  resume(nowMs: number): void {
    this.#rate.start(nowMs);
  }

  answered(answer: LocalizeResponse, takenMs: number, nowMs: number): void {
    this.answers += 1;
    if (answer.pose !== null) this.localized += 1;
    const server = Object.values(answer.seconds).reduce((sum, seconds) => sum + seconds, 0);
    this.#rate.add(nowMs);
    this.#latencies.add({ whole: nowMs - takenMs, server: 1000 * server });
    this.#outcomes.add(answer.pose !== null);
  }

  /** Answers per second. */
  rate(nowMs: number): number {
    return this.#rate.perSecond(nowMs);
  }

  /** From taking the last answered frame to its answer; null before. */
  get latencyMs(): number | null {
    return this.#latencies.values.at(-1)?.whole ?? null;
  }

  /** As they are shown; null where there is nothing yet. */
  inWords(nowMs: number): Record<"rate" | "latency" | "server" | "share", string | null> {
    const newest = this.#latencies.values.at(-1);
    const lastAndMedian = (of: "whole" | "server"): string | null => {
      const middle = median(this.#latencies.values.map((latency) => latency[of]));
      if (newest === undefined || middle === null) return null;
      return `${secondsText(newest[of] / 1000)} (${secondsText(middle / 1000)})`;
    };
    const outcomes = this.#outcomes.values;
    const poses = outcomes.filter((outcome) => outcome).length;
    return {
      rate: newest === undefined ? null : `${this.rate(nowMs).toFixed(1)} per second`,
      latency: lastAndMedian("whole"),
      server: lastAndMedian("server"),
      share: outcomes.length === 0 ? null : `${poses} of ${outcomes.length}`,
    };
  }
}
