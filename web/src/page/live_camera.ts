// The intrinsics of live frames: given for photos of the same shape, from a field of view, or left
// to the service.
import { ServiceError, type Camera, type LocalizeResponse } from "visloc-client";
import { median } from "./live_pace";

export interface Size {
  width: number;
  height: number;
}

/** Degrees that a field of view may have; beyond it is no pinhole camera. */
export const FIELD_OF_VIEW_DEG = { min: 10, max: 150 };

// As the service has it: a camera for another size of the same aspect is scaled.
const ASPECT_TOLERANCE = 0.005;
// Answers that a proposal of a focal length rests on.
const FEWEST_ESTIMATES = 5;

/** The size of a frame whose longer side is `longest`; a video is never enlarged. */
export function frameSize(video: Size, longest: number): Size {
  const scale = Math.min(1, longest / Math.max(video.width, video.height));
  const scaled = (length: number): number => Math.max(1, Math.round(length * scale));
  return { width: scaled(video.width), height: scaled(video.height) };
}

export function sameAspect(a: Size, b: Size): boolean {
  const ratio = (a.width * b.height) / (a.height * b.width);
  return Math.abs(ratio - 1) <= ASPECT_TOLERANCE;
}

/**
 * A pinhole camera that sees `degrees` along the longer side of a frame, so that the number stays
 * the same when a phone is turned: f = longer / (2 tan(degrees / 2)), principal point in the middle.
 */
export function cameraOfFieldOfView(degrees: number, { width, height }: Size): Camera {
  const focal = Math.max(width, height) / (2 * Math.tan((degrees * Math.PI) / 360));
  return { model: "SIMPLE_PINHOLE", width, height, params: [focal, width / 2, height / 2] };
}

/** The field of view in degrees along the longer side, of a focal length in pixels. */
export function fieldOfView(focal: number, { width, height }: Size): number {
  return (360 / Math.PI) * Math.atan(Math.max(width, height) / (2 * focal));
}

/** What goes with a frame, and how to say so. */
export interface ChosenCamera {
  camera: Camera | null;
  message: string;
}

/**
 * Choose the camera of a frame.
 *
 * @param typedCamera intrinsics of photos; count when a frame has their aspect. Throws ServiceError
 *   when they are not complete: that is said, and no reason to end a walk.
 * @param degrees field of view, which counts more because it was given here; null when not given.
 */
export function chooseCamera(
  frame: Size,
  typedCamera: () => Camera | null,
  degrees: number | null,
): ChosenCamera {
  if (degrees !== null) {
    const camera = cameraOfFieldOfView(degrees, frame);
    const focal = camera.params[0]!.toFixed(0);
    return { camera, message: `Camera: focal length ${focal} px, of ${degrees.toFixed(1)}°.` };
  }
  const unknown =
    "Camera unknown: the service looks for the focal length with each pose, which takes longer " +
    "and is refused more often.";
  let typed: Camera | null;
  try {
    typed = typedCamera();
  } catch (error) {
    if (!(error instanceof ServiceError)) throw error;
    const why = `The camera typed for photos cannot be used: ${error.problem.detail}.`;
    return { camera: null, message: `${unknown} ${why}` };
  }
  if (typed === null) return { camera: null, message: unknown };
  if (sameAspect(frame, typed)) {
    return { camera: typed, message: `Camera: as typed for photos, ${typed.model}.` };
  }
  const sizes = `${typed.width} × ${typed.height}, frames have ${frame.width} × ${frame.height}`;
  return {
    camera: null,
    message: `${unknown} The camera typed for photos is of another shape (${sizes}).`,
  };
}

/** Collects focal lengths that the service found, as fields of view, which fit every frame size. */
export class FocalEstimates {
  #degrees: number[] = [];

  add(answer: LocalizeResponse): void {
    const focal = answer.camera.params[0];
    if (answer.status !== "localized" || answer.camera.source !== "estimated") return;
    if (focal !== undefined) this.#degrees.push(fieldOfView(focal, answer.camera));
  }

  clear(): void {
    this.#degrees = [];
  }

  /** The median in degrees and what it rests on; null before there are enough. */
  proposal(): { degrees: number; answers: number } | null {
    const degrees = median(this.#degrees);
    if (degrees === null || this.#degrees.length < FEWEST_ESTIMATES) return null;
    return { degrees, answers: this.#degrees.length };
  }
}
