// A service that is busy says how long to wait: that is done, rather than asking by hand.
import { ServiceError, type Client } from "visloc-client";
import { pause } from "./live_loop";

const MOST_WAITS = 6;
// Nobody looks at an empty view for longer without being told why.
const LONGEST_WAIT_S = 10;

/** How long the service asks to wait; null when this is not what it says. */
export function busySeconds({ problem, retryAfterSeconds }: ServiceError): number | null {
  return problem.status === 429 || problem.status === 503 ? retryAfterSeconds : null;
}

/** The same service; what it sends of maps is asked for again, a few times, when it is busy. */
export function patiently(service: Client): Client {
  async function patient<Answer>(ask: () => Promise<Answer>, signal?: AbortSignal) {
    for (let waits = 0; ; waits++) {
      try {
        return await ask();
      } catch (error) {
        const seconds = error instanceof ServiceError ? busySeconds(error) : null;
        if (seconds === null || seconds > LONGEST_WAIT_S || waits === MOST_WAITS) throw error;
        await pause(1000 * seconds, signal ?? new AbortController().signal);
        signal?.throwIfAborted();
      }
    }
  }
  return {
    ...service,
    points: (ref, first, count, signal) =>
      patient(() => service.points(ref, first, count, signal), signal),
    images: (ref, first, count, signal) =>
      patient(() => service.images(ref, first, count, signal), signal),
  };
}
