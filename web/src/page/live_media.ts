// The camera of this device: why there is none, opening one, and reading its newest frame.
import { frameSize } from "./live_camera";
import { pause, type Frame } from "./live_loop";

const JPEG_QUALITY = 0.85;
// The camera gives a frame every 33 ms or so.
const LOOK_AGAIN_MS = 10;

/** Why this page gets no camera at all; null when it may ask for one. */
export function whyNoCamera(page: {
  isSecureContext: boolean;
  navigator: { mediaDevices?: MediaDevices };
  location: { host: string };
}): string | null {
  if (!page.isSecureContext) {
    return (
      `Browsers give a camera only to pages that came over https or from this very device. ` +
      `This one came over http from ${page.location.host}. Whoever runs the service gives it a ` +
      `certificate, with its settings tls_cert and tls_key: docs/operations.md says how, ` +
      `under “Phone cameras”.`
    );
  }
  if (!page.navigator.mediaDevices) return "This browser gives no camera to pages.";
  return null;
}

/** Say in plain words why no camera could be opened, and what to do. */
export function cameraProblem(error: { name: string; message: string }): string {
  switch (error.name) {
    case "NotAllowedError":
    case "SecurityError":
      return (
        "The camera was not allowed. Allow it for this page, by the symbol beside its address " +
        "or in the browser's settings, and start again."
      );
    case "NotFoundError":
      return "This device has no camera, or none is connected.";
    case "NotReadableError":
    case "AbortError":
      return "The camera cannot be read: another program may use it. Close that and start again.";
    case "OverconstrainedError":
      return "The chosen camera is no longer there. Choose another one.";
    default:
      return `The camera cannot be opened (${error.name}: ${error.message}).`;
  }
}

/** @param choice "environment", "user", or the id of a device. */
export function openCamera(choice: string): Promise<MediaStream> {
  const which: MediaTrackConstraints =
    choice === "environment" || choice === "user"
      ? { facingMode: { ideal: choice } }
      : { deviceId: { exact: choice } };
  // 4:3, as the sensors of phones are: 16:9 is cut out of it and shows less of the place.
  const video = { ...which, width: { ideal: 1280 }, height: { ideal: 960 } };
  return navigator.mediaDevices.getUserMedia({ video, audio: false });
}

/** The cameras by name; named only once the user has allowed one. */
export async function namedCameras(): Promise<{ id: string; label: string }[]> {
  const devices = await navigator.mediaDevices.enumerateDevices();
  return devices
    .filter((device) => device.kind === "videoinput" && device.label !== "")
    .map((device) => ({ id: device.deviceId, label: device.label }));
}

/** Reads frames of a video that plays, each one once. */
export class FrameReader {
  #canvas = document.createElement("canvas");
  #lastTime = -1;

  /** @param longest pixels of the longer side. */
  constructor(
    readonly video: HTMLVideoElement,
    readonly longest: () => number,
  ) {}

  /** The frame that shows now; when it was read before, the next one. */
  async grab(signal: AbortSignal): Promise<Frame> {
    const { video } = this;
    while (video.videoWidth === 0 || video.currentTime === this.#lastTime) {
      await pause(LOOK_AGAIN_MS, signal);
      signal.throwIfAborted();
    }
    this.#lastTime = video.currentTime;
    // Of each frame anew: a phone that is turned swaps the sides.
    const size = frameSize({ width: video.videoWidth, height: video.videoHeight }, this.longest());
    Object.assign(this.#canvas, size);
    this.#canvas.getContext("2d")!.drawImage(video, 0, 0, size.width, size.height);
    const [atMs, timestamp] = [performance.now(), Date.now() / 1000];
    const jpeg = await new Promise<Blob | null>((resolve) =>
      this.#canvas.toBlob(resolve, "image/jpeg", JPEG_QUALITY),
    );
    if (jpeg === null) throw new Error("this browser cannot write a frame as JPEG");
    return { jpeg, ...size, atMs, timestamp };
  }
}

/** Keeps the screen of a phone on, where the browser can; it may refuse, which costs little. */
export class ScreenLock {
  #lock: WakeLockSentinel | null = null;

  async hold(): Promise<void> {
    try {
      this.#lock = (await navigator.wakeLock?.request("screen")) ?? null;
    } catch (error) {
      // A low battery, or a page that was hidden meanwhile.
      if (!(error instanceof DOMException)) throw error;
    }
  }

  release(): void {
    void this.#lock?.release();
    this.#lock = null;
  }
}
