import { afterEach, beforeEach, describe, expect, test, vi } from "vitest";
import {
  ownError,
  ServiceError,
  type LocalizeCall,
  type LocalizeResponse,
  type MapInfo,
  type Client,
} from "visloc-client";
import { createPhotoQueue, type Entry, type Wish } from "../src/page/photo_queue";

const MAP = { id: "kitchen", version: "7", current: true } as MapInfo;
const ANSWER = { status: "not_localized", debug: null } as LocalizeResponse;
const wish = (): Wish => ({ map: MAP, others: [], camera: null, options: {}, debug: true });
const photo = (...bytes: number[]): Blob => new Blob([new Uint8Array(bytes)]);

function refusal(status: number, wait: number | null): ServiceError {
  const { problem } = ownError("some.code", "Refused", "the detail");
  return new ServiceError({ ...problem, status }, wait);
}

/** A queue at a service that answers the calls one after the other with what `answers` do. */
function queueAt(
  answers: ((call: LocalizeCall, signal: AbortSignal) => Promise<unknown>)[],
  onChange: (entry: Entry) => void = () => undefined,
) {
  const calls: LocalizeCall[] = [];
  let inFlight = 0;
  const seen = { most: 0 };
  const localize = async (call: LocalizeCall, signal: AbortSignal): Promise<unknown> => {
    calls.push(call);
    seen.most = Math.max(seen.most, (inFlight += 1));
    try {
      return await (answers.shift() ?? (async () => ANSWER))(call, signal);
    } finally {
      inFlight -= 1;
    }
  };
  const service = { localize } as unknown as Client;
  return { queue: createPhotoQueue(service, () => false, onChange), calls, seen };
}

const soon = (): Promise<void> => vi.advanceTimersByTimeAsync(50).then(() => undefined);
const states = (entries: readonly Entry[]): string[] => entries.map(({ state }) => state);
const names = (calls: LocalizeCall[]): (string | undefined)[] => calls.map(({ name }) => name);

beforeEach(() => {
  vi.useFakeTimers();
  vi.stubGlobal("reportError", vi.fn());
});
afterEach(() => {
  vi.useRealTimers();
  vi.unstubAllGlobals();
});

/** Files are read outside of the time that is played. */
const until = (yes: () => boolean): Promise<void> => vi.waitFor(() => expect(yes()).toBe(true));

describe("photos", () => {
  test("are asked about one at a time, in their order", async () => {
    const later = (): Promise<LocalizeResponse> =>
      new Promise((done) => setTimeout(done, 20, ANSWER));
    const { queue, calls, seen } = queueAt([later, later, later]);
    for (const name of ["a", "b", "c"]) queue.add(photo(1), name, wish);
    await until(() => queue.entries.every(({ state }) => state === "answered"));
    expect(names(calls)).toEqual(["a", "b", "c"]);
    expect(seen.most).toBe(1);
    expect(calls[0]).toMatchObject({ map: ["kitchen@7"], camera: null, options: {}, debug: true });
  });

  test("are looked for in several maps, and bring their matches only where that is wished", async () => {
    const { queue, calls } = queueAt([]);
    queue.add(photo(1), "a", () => ({ ...wish(), others: ["hall", "shed"], debug: false }));
    await until(() => queue.entries[0]!.state === "answered");
    expect(calls[0]).toMatchObject({ map: ["kitchen@7", "hall", "shed"], debug: false });
    const first = queue.entries[0]!;
    queue.again(first, () => ({ ...first.wish!, debug: true }));
    await until(() => calls.length === 2 && first.state === "answered");
    expect(calls[1]).toMatchObject({ map: ["kitchen@7", "hall", "shed"], debug: true });
  });

  test("wait as long as a busy service asks, and the ones behind them too", async () => {
    const { queue, calls } = queueAt([
      () => Promise.reject(refusal(429, 7)),
      () => Promise.reject(refusal(503, 3)),
    ]);
    queue.add(photo(1), "a", wish);
    queue.add(photo(2), "b", wish);
    await until(() => queue.entries[0]!.waitSeconds === 7);
    const before = calls.length;
    expect(states(queue.entries)).toEqual(["waiting", "waiting"]);
    await vi.advanceTimersByTimeAsync(6_000);
    expect(calls).toHaveLength(before);
    await vi.advanceTimersByTimeAsync(1_000);
    await until(() => queue.entries[0]!.waitSeconds === 3);
    await vi.advanceTimersByTimeAsync(3_000);
    await until(() => queue.entries.every(({ state }) => state === "answered"));
    expect(names(calls)).toEqual(["a", "a", "a", "b"]);
    expect(queue.entries[0]!.waitSeconds).toBeNull();
  });

  test("fail where the service does not say how long to wait, and the next is asked", async () => {
    const { queue } = queueAt([() => Promise.reject(refusal(503, null))]);
    queue.add(photo(1), "a", wish);
    queue.add(photo(2), "b", wish);
    await until(() => queue.entries[1]!.state === "answered");
    expect(queue.entries[0]!.error?.problem.status).toBe(503);
  });

  test.each([
    ["a mistake in asking", () => Promise.reject(new TypeError("mistake"))],
    ["null", () => Promise.resolve(null)],
    ["a picture that is none", async () => ({ ...ANSWER, debug: { overlay: "%%%" } })],
  ])("go on after %s", async (_, answer) => {
    const { queue } = queueAt([answer]);
    queue.add(photo(1), "a", wish);
    queue.add(photo(2), "b", wish);
    await until(() => queue.entries[1]!.state === "answered");
    expect(queue.entries[0]!.error?.problem.code).toBe("page.mistake");
    expect(reportError).toHaveBeenCalledOnce();
  });

  test("go on when they cannot be shown", async () => {
    const { queue } = queueAt([], ({ name, state }) => {
      if (name === "a" && state === "answered") throw new TypeError("mistake");
    });
    queue.add(photo(1), "a", wish);
    queue.add(photo(2), "b", wish);
    await until(() => queue.entries[1]!.state === "answered");
    expect(reportError).toHaveBeenCalledOnce();
  });

  test("that are gone from the disk are not said to be the network's fault", async () => {
    const { queue, calls } = queueAt([]);
    const gone = photo(1);
    gone.arrayBuffer = () => Promise.reject(new DOMException("gone", "NotFoundError"));
    queue.add(gone, "a", wish);
    queue.add(photo(2), "b", wish);
    await until(() => queue.entries[1]!.state === "answered");
    expect(queue.entries[0]!.error?.problem.code).toBe("page.file");
    expect(names(calls)).toEqual(["b"]);
  });

  test("that were asked for wrongly are not sent", async () => {
    const { queue, calls } = queueAt([]);
    queue.add(photo(1), "a", () => {
      throw ownError("page.map", "No map", "choose one");
    });
    await soon();
    expect(states(queue.entries)).toEqual(["failed"]);
    expect(calls).toEqual([]);
  });

  test("can be asked about again", async () => {
    const { queue, calls } = queueAt([() => Promise.reject(refusal(500, null))]);
    const entry = queue.add(photo(1), "a", wish);
    await until(() => entry.state === "failed");
    queue.again(entry, wish);
    await until(() => entry.state === "answered");
    expect(entry.error).toBeNull();
    expect(names(calls)).toEqual(["a", "a"]);
  });

  test("that were cleared come to nothing, and new ones are asked about", async () => {
    const changes: string[] = [];
    const aborted = (_: LocalizeCall, signal: AbortSignal): Promise<never> =>
      new Promise((_, reject) => signal.addEventListener("abort", () => reject(signal.reason)));
    const { queue, calls, seen } = queueAt([aborted], ({ name, state }) => {
      changes.push(`${name} ${state}`);
    });
    queue.add(photo(1), "a", wish);
    queue.add(photo(2), "b", wish);
    await until(() => calls.length === 1);
    queue.clear();
    queue.add(photo(3), "c", wish);
    await until(() => changes.includes("c answered"));
    expect(names(calls)).toEqual(["a", "c"]);
    expect(seen.most).toBe(1);
    expect(changes.filter((change) => /[ab] (answered|failed)/.test(change))).toEqual([]);
  });

  test("that wait for a busy service are not asked about once they were cleared", async () => {
    const { queue, calls } = queueAt([() => Promise.reject(refusal(429, 60))]);
    const entry = queue.add(photo(1), "a", wish);
    await until(() => entry.waitSeconds === 60);
    queue.clear();
    queue.add(photo(2), "b", wish); // at once
    await until(() => calls.length === 2);
    expect(names(calls)).toEqual(["a", "b"]);
  });
});
