// COLMAP's camera models, and a camera as text (docs/conventions.md, "Cameras").
import { ownError, type Camera } from "visloc-client";

/** Names of the parameters, in COLMAP's order. */
export const CAMERA_MODELS: Readonly<Record<string, readonly string[]>> = {
  SIMPLE_PINHOLE: ["f", "cx", "cy"],
  PINHOLE: ["fx", "fy", "cx", "cy"],
  SIMPLE_RADIAL: ["f", "cx", "cy", "k"],
  RADIAL: ["f", "cx", "cy", "k1", "k2"],
  OPENCV: ["fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"],
  FULL_OPENCV: ["fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"],
  SIMPLE_RADIAL_FISHEYE: ["f", "cx", "cy", "k"],
  RADIAL_FISHEYE: ["f", "cx", "cy", "k1", "k2"],
  OPENCV_FISHEYE: ["fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4"],
  FOV: ["fx", "fy", "cx", "cy", "omega"],
  THIN_PRISM_FISHEYE: [
    ...["fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "sx1", "sy1"],
  ],
};

/** A camera as it is typed: texts, by the names of the fields. */
export interface TypedCamera {
  model: string;
  width: string;
  height: string;
  params: string[];
}

/** Which fields are wrong, and how; none when it is a camera. */
export function cameraFaults(typed: TypedCamera): { field: string; fault: string }[] {
  const faults: { field: string; fault: string }[] = [];
  for (const field of ["width", "height"] as const) {
    const size = numberOf(typed[field]);
    if (!Number.isInteger(size) || size < 1) faults.push({ field, fault: "a number of pixels" });
  }
  (CAMERA_MODELS[typed.model] ?? []).forEach((field, i) => {
    const value = numberOf(typed.params[i] ?? "");
    if (!Number.isFinite(value)) faults.push({ field, fault: "a number" });
    else if (field.startsWith("f") && value <= 0) faults.push({ field, fault: "more than 0" });
  });
  return faults;
}

/** Throws ServiceError, as the service would, for what is no camera: nothing is guessed instead. */
export function cameraOf(typed: TypedCamera): Camera {
  const [first] = cameraFaults(typed);
  if (first !== undefined) {
    const detail = `the camera's ${first.field} is missing or wrong`;
    throw ownError("camera.param_value", "The camera is not complete", detail, {
      field: `camera.${first.field}`,
      expected: first.fault,
    });
  }
  const params = (CAMERA_MODELS[typed.model] ?? []).map((_, i) => numberOf(typed.params[i] ?? ""));
  return {
    model: typed.model,
    width: numberOf(typed.width),
    height: numberOf(typed.height),
    params,
  };
}

/** Read `MODEL,width,height,params...`, also with spaces; null when it is not that. */
export function typedCamera(text: string): TypedCamera | null {
  return text.trim() !== "" && textFaultOf(text) === "" ? splitCamera(text) : null;
}

/** Why this text is no camera; empty where it is one, or nothing was typed. */
export function textFaultOf(text: string): string {
  if (text.trim() === "") return "";
  const typed = splitCamera(text);
  const names = Object.hasOwn(CAMERA_MODELS, typed.model) ? CAMERA_MODELS[typed.model] : undefined;
  if (names === undefined) return `No camera model: ${typed.model}.`;
  const numbers = ["width", "height", ...names];
  const got = [typed.width, typed.height, ...typed.params].filter((word) => word !== "").length;
  if (got !== numbers.length) {
    return `${typed.model} takes ${numbers.length} numbers, ${numbers.join(", ")}: here are ${got}.`;
  }
  const [first] = cameraFaults(typed);
  return first === undefined ? "" : `${first.field}: expected ${first.fault}.`;
}

function splitCamera(text: string): TypedCamera {
  const [model = "", width = "", height = "", ...params] = text
    .split(/[\s,]+/)
    .filter((word) => word !== "");
  return { model: model.toUpperCase(), width, height, params };
}

/** Words that are no numbers, the empty one too, are NaN. A comma may mark the decimals. */
function numberOf(text: string): number {
  const word = text.trim().replace(/^([^,]*),([^,]*)$/, "$1.$2");
  return /^[+-]?(\d+\.?\d*|\.\d+)(e[+-]?\d+)?$/i.test(word) ? Number(word) : NaN;
}
