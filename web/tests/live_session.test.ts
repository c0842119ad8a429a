// A walk while cameras, maps and the page come and go: live mode without a camera and a page.
import { afterEach, beforeEach, describe, expect, it, vi } from "vitest";
import { connect, ownError, type LocalizeResponse, type MapInfo } from "visloc-client";
import { chooseCamera } from "../src/page/live_camera";
import { pause, type Frame } from "../src/page/live_loop";
import { LiveSession, type SessionParts } from "../src/page/live_session";

const FRAME = { jpeg: new Blob(["frame"]), width: 640, height: 480 } as Frame;
const REFUSED = { pose: null } as LocalizeResponse;
const ANSWER_MS = 100;

const mapOf = (id: string) => ({ id, version: "1" }) as MapInfo;

function streamOf() {
  const track = Object.assign(new EventTarget(), { stop: vi.fn() });
  const stream = { getTracks: () => [track] } as unknown as MediaStream;
  return { stream, track };
}

/** A session whose service answers after ANSWER_MS, and what came of it. */
function walk(changes: Partial<SessionParts> = {}) {
  const around = { map: mapOf("kitchen") as MapInfo | null, hidden: false };
  const seen = { asked: [] as string[], answers: 0, failures: [] as string[] };
  const { stream, track } = streamOf();
  const ended = vi.fn();
  const play = vi.fn(() => Promise.resolve());
  const session = new LiveSession({
    ...{ play, ended, resumed: vi.fn(), changed: vi.fn() },
    map: () => around.map,
    hidden: () => around.hidden,
    openCamera: () => Promise.resolve(stream),
    grab: () => Promise.resolve(FRAME),
    async localize({ id }, _, signal) {
      seen.asked.push(id);
      await pause(ANSWER_MS, signal);
      signal.throwIfAborted();
      return REFUSED;
    },
    answered: () => void (seen.answers += 1),
    failed: (why) => void seen.failures.push(why),
    ...changes,
  });
  return { session, around, seen, track, ended, play };
}

const pass = (milliseconds: number) => vi.advanceTimersByTimeAsync(milliseconds);

beforeEach(() => void vi.useFakeTimers());
afterEach(() => {
  vi.useRealTimers();
  vi.unstubAllGlobals();
});

describe("a walk", () => {
  it("asks from the camera's opening until it is stopped, and leaves nothing on", async () => {
    const { session, seen, track, ended, play } = walk();
    await session.start();
    expect([session.on, session.filming, session.running]).toEqual([true, true, true]);
    await pass(3.5 * ANSWER_MS);
    session.stop("enough");
    await pass(10 * ANSWER_MS);
    expect(seen).toMatchObject({ answers: 3, failures: [] });
    expect(seen.asked.length).toBe(4);
    expect([session.on, session.filming, session.running]).toEqual([false, false, false]);
    expect(session).toMatchObject({ inFlight: 0, maxInFlight: 1, message: "enough" });
    expect(track.stop).toHaveBeenCalledOnce();
    expect(play).toHaveBeenLastCalledWith(null);
    expect(ended).toHaveBeenCalledExactlyOnceWith("enough");
    session.stop("again");
    expect(ended).toHaveBeenCalledOnce();
  });

  it("goes on with another map, never with two requests at once", async () => {
    const { session, around, seen } = walk();
    await session.start();
    for (const id of ["castle", "street"]) {
      around.map = mapOf(id);
      session.resume();
    }
    await pass(2.5 * ANSWER_MS);
    expect(seen.asked).toEqual(["kitchen", "street", "street", "street"]);
    expect(seen.answers).toBe(2); // the kitchen's is nobody's any more
    expect(session.maxInFlight).toBe(1);
  });

  it("waits without a map, and while nobody sees the page", async () => {
    const { session, around, seen } = walk();
    around.map = null;
    await session.start();
    expect([session.message, session.running]).toEqual(["Choose a map to go on.", false]);
    around.map = mapOf("kitchen");
    around.hidden = true;
    session.resume();
    await pass(ANSWER_MS);
    expect(seen.asked).toEqual([]);
    around.hidden = false;
    session.resume();
    await pass(1.5 * ANSWER_MS);
    session.pause("hidden");
    await pass(10 * ANSWER_MS);
    expect(seen.answers).toBe(1);
    expect([session.message, session.filming]).toEqual(["hidden", true]);
  });

  it("closes a camera that comes after it was stopped, or after another was chosen", async () => {
    const [late, chosen] = [streamOf(), streamOf()];
    const opened: ((stream: MediaStream) => void)[] = [];
    const openCamera = () => new Promise<MediaStream>((resolve) => opened.push(resolve));
    const { session, play } = walk({ openCamera });
    void session.start();
    void session.reopen();
    opened[1]!(chosen.stream);
    opened[0]!(late.stream);
    await pass(0);
    expect(late.track.stop).toHaveBeenCalledOnce();
    expect(chosen.track.stop).not.toHaveBeenCalled();
    expect(play).toHaveBeenCalledExactlyOnceWith(chosen.stream);
    void session.reopen();
    session.stop("enough");
    const never = streamOf();
    opened[2]!(never.stream);
    await pass(0);
    expect(chosen.track.stop).toHaveBeenCalledOnce();
    expect(never.track.stop).toHaveBeenCalledOnce();
    expect(session.filming).toBe(false);
  });

  it("ends in words where the camera is not allowed, or is taken away", async () => {
    const refused = walk({ openCamera: () => Promise.reject({ name: "NotAllowedError" }) });
    await refused.session.start();
    expect(refused.session.on).toBe(false);
    expect(refused.session.message).toContain("not allowed");
    const { session, track } = walk();
    await session.start();
    track.dispatchEvent(new Event("ended"));
    expect([session.on, session.message]).toEqual([false, "The camera was taken away."]);
  });

  it("is not held up by a camera that was typed for photos and is not complete", async () => {
    const cameras: unknown[] = [];
    const incomplete = () => {
      throw ownError("camera.text", "", "the camera's width is missing");
    };
    const { session, seen } = walk({
      localize(_, frame) {
        cameras.push(chooseCamera(frame, incomplete, null).camera);
        if (cameras.length === 3) session.stop("enough");
        return Promise.resolve(REFUSED);
      },
    });
    await session.start();
    await pass(0);
    expect(cameras).toEqual([null, null, null]);
    expect(seen).toMatchObject({ answers: 2, failures: [] });
  });

  it("ends where the page itself finds a mistake in what was chosen", async () => {
    const { session, seen } = walk({
      localize() {
        throw ownError("options.top_k", "", "top_k is no number");
      },
    });
    await session.start();
    await pass(60_000);
    expect(seen.failures).toEqual([]);
    expect(session.on).toBe(false);
    expect(session.message).toContain("top_k is no number");
  });

  it.each(["0", "-5"])("does not flood a service that says Retry-After: %s", async (after) => {
    const answer = () => new Response("{}", { status: 429, headers: { "Retry-After": after } });
    const fetched = vi.fn(() => Promise.resolve(answer()));
    vi.stubGlobal("fetch", fetched);
    const service = connect("https://maps.example.org/");
    const call = { map: "kitchen", image: FRAME.jpeg, name: "", camera: null, options: {} };
    const { session, seen } = walk({ localize: (_, __, signal) => service.localize(call, signal) });
    await session.start();
    await pass(10_000);
    session.stop("enough");
    expect(fetched.mock.calls.length).toBeLessThanOrEqual(21);
    expect(seen.failures.length).toBeGreaterThan(5);
  });
});
