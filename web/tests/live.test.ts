// The logic of live mode, without a camera and without a page.
import { describe, expect, it, vi } from "vitest";
import { ownError, ServiceError, type LocalizeResponse, type Problem } from "visloc-client";
import {
  FocalEstimates,
  cameraOfFieldOfView,
  chooseCamera,
  fieldOfView,
  frameSize,
  sameAspect,
} from "../src/page/live_camera";
import { LiveFigures } from "../src/page/live_figures";
import {
  LONGEST_REQUEST_MS,
  localizeFrames,
  pause,
  type Frame,
  type LoopParts,
} from "../src/page/live_loop";
import { cameraProblem, whyNoCamera } from "../src/page/live_media";
import { RateWindow, afterFailure, median } from "../src/page/live_pace";
import { WalkingPrior } from "../src/page/live_prior";
import { Trail } from "../src/page/live_trail";

const WIDE = { width: 1280, height: 720 };

function serviceError(status: number, wait: number | null = null): ServiceError {
  const code = status === 0 ? "server.unreachable" : "some.code";
  const problem: Problem = {
    ...{ title: "", status, detail: "the detail", code, request_id: "" },
    ...{ field: "camera", expected: "three numbers", got: "two" },
  };
  return new ServiceError(problem, wait);
}

function answered(position: number[] | null, changes: Partial<LocalizeResponse> = {}) {
  const pose = position && {
    cam_from_world: { rotation_wxyz: [1, 0, 0, 0], translation: [0, 0, 0] },
    position,
    orientation: [0.5, -0.5, 0.5, -0.5],
    covariance: [],
    position_std: [],
    orientation_std_deg: [],
    photo_covariance: [],
    uncertainty: "whole",
    probability: null,
  };
  const refusal = { stage: "gate", reason: "too_few_inliers", message: "too few" };
  return {
    status: pose ? "localized" : "not_localized",
    pose,
    refusal: pose ? null : refusal,
    inliers: pose ? 100 : 3,
    camera: { model: "SIMPLE_PINHOLE", ...WIDE, params: [1000, 640, 360], source: "given" },
    seconds: { decode: 0.01, matching: 0.04 },
    ...changes,
  } as LocalizeResponse;
}

describe("the camera of a frame", () => {
  it("is made smaller to the longer side, never larger", () => {
    expect(frameSize(WIDE, 640)).toEqual({ width: 640, height: 360 });
    expect(frameSize({ width: 720, height: 1280 }, 640)).toEqual({ width: 360, height: 640 });
    expect(frameSize({ width: 320, height: 240 }, 640)).toEqual({ width: 320, height: 240 });
  });

  it("has the focal length of a field of view along the longer side, however it is held", () => {
    const lying = cameraOfFieldOfView(90, { width: 640, height: 480 });
    expect(lying.params[0]).toBeCloseTo(320, 9);
    expect(lying.params.slice(1)).toEqual([320, 240]);
    expect(cameraOfFieldOfView(90, { width: 480, height: 640 }).params[0]).toBeCloseTo(320, 9);
  });

  it.each([10, 45, 67.3, 150])("keeps %s degrees there and back", (degrees) => {
    const camera = cameraOfFieldOfView(degrees, WIDE);
    expect(fieldOfView(camera.params[0]!, camera)).toBeCloseTo(degrees, 9);
  });

  it("tells shapes apart as the service does", () => {
    expect(sameAspect({ width: 640, height: 480 }, { width: 4032, height: 3024 })).toBe(true);
    expect(sameAspect({ width: 640, height: 480 }, { width: 480, height: 640 })).toBe(false);
    expect(sameAspect({ width: 640, height: 480 }, WIDE)).toBe(false);
  });

  it("is the typed one where that has the shape of the frame, else unknown, and says so", () => {
    const typed = cameraOfFieldOfView(60, { width: 4032, height: 3024 });
    expect(chooseCamera({ width: 640, height: 480 }, () => typed, null).camera).toBe(typed);
    const other = chooseCamera({ width: 640, height: 360 }, () => typed, null);
    expect(other.camera).toBeNull();
    expect(other.message).toContain("4032 × 3024, frames have 640 × 360");
    expect(chooseCamera(WIDE, () => null, null).camera).toBeNull();
  });

  it("says of a typed one that is not complete what is wrong, where it would count", () => {
    const incomplete = () => {
      throw ownError("camera.text", "", "the camera's width is missing");
    };
    const { camera, message } = chooseCamera(WIDE, incomplete, null);
    expect(camera).toBeNull();
    expect(message).toContain("the camera's width is missing");
    expect(chooseCamera(WIDE, incomplete, 60).message).toContain("60.0°");
    const mistake = () => {
      throw new TypeError("a mistake");
    };
    expect(() => chooseCamera(WIDE, mistake, null)).toThrow("a mistake");
  });

  it("is that of the field of view when both are given", () => {
    const typed = cameraOfFieldOfView(60, WIDE);
    expect(chooseCamera(WIDE, () => typed, 90).camera?.params[0]).toBeCloseTo(640, 9);
  });

  it("is proposed from the median of what the service estimated, in any frame size", () => {
    const estimates = new FocalEstimates();
    const estimated = (focal: number, scale: number) => {
      const camera = {
        ...cameraOfFieldOfView(60, { width: 640 * scale, height: 480 * scale }),
        source: "estimated" as const,
      };
      camera.params[0] = focal * scale;
      return answered([0, 0, 0], { camera });
    };
    for (const focal of [500, 510, 490, 900]) estimates.add(estimated(focal, 1));
    estimates.add(answered([0, 0, 0])); // of a camera that was given
    estimates.add(answered(null));
    expect(estimates.proposal()).toBeNull();
    estimates.add(estimated(505, 2));
    expect(estimates.proposal()?.answers).toBe(5);
    expect(estimates.proposal()?.degrees).toBeCloseTo(
      fieldOfView(505, { width: 640, height: 480 }),
      9,
    );
  });
});

describe("the prior of a walk", () => {
  it("is a sphere that grows with the time since the last pose", () => {
    const prior = new WalkingPrior();
    expect(prior.at(0)).toBeUndefined();
    prior.localized([1, 2, 3], 1000);
    expect(prior.at(1000)).toEqual({ position: { position: [1, 2, 3], radius: 1 } });
    expect(prior.at(3500)?.position.radius).toBeCloseTo(6, 9);
  });

  it("is dropped after three refusals in a row, and comes back with a pose", () => {
    const prior = new WalkingPrior();
    prior.localized([0, 0, 0], 0);
    for (const refusals of [2, 2]) {
      for (let i = 0; i < refusals; i++) prior.refused();
      expect(prior.at(0)).toBeDefined();
      prior.localized([0, 0, 0], 0);
    }
    for (let i = 0; i < 3; i++) prior.refused();
    expect(prior.at(0)).toBeUndefined();
    prior.localized([5, 0, 0], 0);
    expect(prior.at(0)).toBeDefined();
  });
});

describe("pace", () => {
  it("is answers per second over the window, and falls while nothing comes", () => {
    const rate = new RateWindow(5000);
    expect(rate.perSecond(0)).toBe(0);
    rate.start(0);
    for (let time = 500; time <= 10_000; time += 500) rate.add(time);
    expect(rate.perSecond(10_000)).toBe(2);
    expect(rate.perSecond(12_500)).toBe(1);
    expect(rate.perSecond(99_000)).toBe(0);
  });

  it("counts a short run over the time that it lasted, a second at least", () => {
    const rate = new RateWindow(5000);
    rate.start(0);
    rate.add(100);
    expect(rate.perSecond(100)).toBe(1);
    for (const time of [500, 1000, 2000]) rate.add(time);
    expect(rate.perSecond(2000)).toBe(2);
  });

  it("has the usual median", () => {
    expect(median([])).toBeNull();
    expect(median([3, 1, 2])).toBe(2);
    expect(median([4, 1, 2, 3])).toBe(2.5);
  });

  it("says last and median latency, the service's part, and the share of poses", () => {
    const figures = new LiveFigures();
    expect(figures.inWords(0)).toEqual({ rate: null, latency: null, server: null, share: null });
    figures.resume(0);
    figures.answered(answered([0, 0, 0]), 0, 100);
    figures.answered(answered(null), 1000, 1200);
    figures.answered(answered([0, 0, 0]), 1700, 2000);
    expect(figures.inWords(2000)).toEqual({
      rate: "1.5 per second",
      latency: "300 ms (200 ms)",
      server: "50 ms (50 ms)",
      share: "2 of 3",
    });
    expect([figures.answers, figures.localized, figures.latencyMs]).toEqual([3, 2, 300]);
  });

  it("waits as a busy service says, one second when it does not", () => {
    expect(afterFailure(serviceError(429, 7), 9)).toMatchObject({ milliseconds: 7000 });
    expect(afterFailure(serviceError(503), 1)).toMatchObject({ milliseconds: 1000 });
  });

  it.each([0, 500, 504])("grows with failures to 5 s (status %s)", (status) => {
    const waits = [1, 2, 3, 4, 5, 99].map((inARow) => afterFailure(serviceError(status), inARow));
    const milliseconds = waits.map((next) => (next.do === "wait" ? next.milliseconds : null));
    expect(milliseconds).toEqual([500, 1000, 2000, 4000, 5000, 5000]);
  });

  it.each([401, 403, 404, 413, 422])("stops for what the next frame cannot mend (%s)", (status) => {
    expect(afterFailure(serviceError(status), 1).do).toBe("stop");
  });

  it("says all that the service said of a request that it refuses", () => {
    const { message } = afterFailure(serviceError(422), 1);
    for (const part of ["the detail", "camera", "three numbers", "two"]) {
      expect(message).toContain(part);
    }
  });
});

describe("the loop", () => {
  const frame = {} as Frame;

  /** Parts that count; `ask` is the n-th request, from 1. */
  function parts(ask: (count: number, signal: AbortSignal) => Promise<LocalizeResponse>) {
    const seen = { asked: 0, inFlight: 0, maxInFlight: 0, answers: 0, failures: 0 };
    const waits: number[] = [];
    const made: LoopParts = {
      grab: () => Promise.resolve(frame),
      async ask(_, signal) {
        seen.inFlight += 1;
        seen.maxInFlight = Math.max(seen.maxInFlight, seen.inFlight);
        try {
          return await ask((seen.asked += 1), signal);
        } finally {
          seen.inFlight -= 1;
        }
      },
      answered: () => void (seen.answers += 1),
      failed: () => void (seen.failures += 1),
      wait: (milliseconds) => Promise.resolve(void waits.push(milliseconds)),
    };
    return { made, seen, waits };
  }

  it("never has more than one request in flight", async () => {
    const stop = new AbortController();
    const { made, seen } = parts(async (count) => {
      await new Promise((resolve) => setTimeout(resolve, count % 3));
      if (count === 20) stop.abort();
      return answered([0, 0, 0]);
    });
    expect(await localizeFrames(made, stop.signal)).toBeNull();
    expect(seen).toMatchObject({ asked: 20, maxInFlight: 1, answers: 19 });
  });

  it("takes a frame only after the answer to the last", async () => {
    const stop = new AbortController();
    const order: string[] = [];
    const { made } = parts((count) => {
      order.push("ask");
      if (count === 3) stop.abort();
      return Promise.resolve(answered(null));
    });
    made.grab = () => (order.push("grab"), Promise.resolve(frame));
    made.answered = () => void order.push("answer");
    await localizeFrames(made, stop.signal);
    const one = ["grab", "ask", "answer"];
    expect(order).toEqual([...one, ...one, "grab", "ask"]);
  });

  it("goes on after failures, and begins to count anew with an answer", async () => {
    const stop = new AbortController();
    const { made, seen, waits } = parts((count) => {
      if (count === 6) stop.abort();
      if (count === 3) return Promise.resolve(answered(null));
      return Promise.reject(serviceError(0));
    });
    expect(await localizeFrames(made, stop.signal)).toBeNull();
    expect(waits).toEqual([500, 1000, 500, 1000]);
    expect(seen).toMatchObject({ answers: 1, failures: 4 });
  });

  it("ends with the problem when the request itself is refused", async () => {
    const { made, seen } = parts(() => Promise.reject(serviceError(401)));
    expect(await localizeFrames(made, new AbortController().signal)).toContain("API key");
    expect(seen.asked).toBe(1);
  });

  it("does not hide mistakes of its own", async () => {
    const { made } = parts(() => Promise.reject(new RangeError("a mistake")));
    await expect(localizeFrames(made, new AbortController().signal)).rejects.toThrow("a mistake");
  });

  it("aborts the request under way when it is stopped", async () => {
    const stop = new AbortController();
    const { made, seen } = parts((_, signal) => never(signal));
    const loop = localizeFrames(made, stop.signal);
    await vi.waitFor(() => expect(seen.inFlight).toBe(1));
    stop.abort();
    expect(await loop).toBeNull();
    expect(seen).toMatchObject({ inFlight: 0, answers: 0, failures: 0 });
  });

  it("gives a request up that takes too long, and asks again", async () => {
    vi.useFakeTimers();
    const stop = new AbortController();
    const { made, seen } = parts((count, signal) => {
      if (count === 2) stop.abort();
      return never(signal);
    });
    const loop = localizeFrames(made, stop.signal);
    await vi.advanceTimersByTimeAsync(LONGEST_REQUEST_MS);
    expect(await loop).toBeNull();
    expect(seen).toMatchObject({ asked: 2, failures: 1 });
    vi.useRealTimers();
  });

  it("does not wait on when it is stopped", async () => {
    const stop = new AbortController();
    const waited = pause(60_000, stop.signal);
    stop.abort();
    await waited;
    await pause(60_000, stop.signal);
  });

  function never(signal: AbortSignal): Promise<LocalizeResponse> {
    const gone = () => new DOMException("aborted", "AbortError");
    return new Promise((_, reject) => {
      if (signal.aborted) reject(gone());
      signal.addEventListener("abort", () => reject(gone()));
    });
  }
});

describe("the trail", () => {
  const step = () => 0.1;

  it("draws positions that are a step apart, and keeps every frame for the files", () => {
    const trail = new Trail(step);
    const drawn = [0, 0.05, 0.11, 0.19, 0.22].map((x, i) =>
      trail.add({ timestamp: i, answer: answered([x, 0, 0]) }),
    );
    expect(drawn).toEqual([true, false, true, false, true]);
    expect(trail.drawn.map(([x]) => x)).toEqual([0, 0.11, 0.22]);
    expect(trail.frames).toBe(5);
  });

  it("draws the last 2000", () => {
    const trail = new Trail(step);
    for (let x = 0; x < 2005; x++) trail.add({ timestamp: x, answer: answered([x, 0, 0]) });
    expect(trail.drawn.length).toBe(2000);
    expect(trail.drawn[0]).toEqual([5, 0, 0]);
  });

  it("is saved with refusals as CSV, without as TUM, which has w last", () => {
    const trail = new Trail(step);
    trail.add({ timestamp: 1700000000.1234, answer: answered([1, 2, 3]) });
    trail.add({ timestamp: 1700000001, answer: answered(null) });
    expect(trail.csv()).toBe(
      "timestamp_s,status,reason,inliers,x,y,z,qw,qx,qy,qz\n" +
        "1700000000.123,localized,,100,1,2,3,0.5,-0.5,0.5,-0.5\n" +
        "1700000001.000,not_localized,too_few_inliers,3,,,,,,,\n",
    );
    expect(trail.tum()).toBe(
      "# timestamp tx ty tz qx qy qz qw\n1700000000.123 1 2 3 -0.5 0.5 -0.5 0.5\n",
    );
    trail.clear();
    expect([trail.frames, trail.drawn.length]).toEqual([0, 0]);
  });
});

describe("the camera of the device", () => {
  const mediaDevices = {} as MediaDevices;
  const location = { host: "192.168.1.20:8000" };

  it("needs https, and says what the operator does", () => {
    const why = whyNoCamera({ isSecureContext: false, navigator: {}, location });
    for (const part of ["https", "192.168.1.20:8000", "tls_cert", "tls_key"]) {
      expect(why).toContain(part);
    }
    const without = whyNoCamera({ isSecureContext: true, navigator: {}, location });
    expect(without).toContain("This browser");
    expect(
      whyNoCamera({ isSecureContext: true, navigator: { mediaDevices }, location }),
    ).toBeNull();
  });

  it.each([
    ["NotAllowedError", "Allow it"],
    ["NotFoundError", "no camera"],
    ["NotReadableError", "another program"],
    ["OverconstrainedError", "no longer there"],
    ["TypeError", "TypeError: the message"],
  ])("says %s in plain words", (name, words) => {
    expect(cameraProblem({ name, message: "the message" })).toContain(words);
  });
});
