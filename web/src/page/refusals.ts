// Why there is no pose, and what to try next: the table of docs/api.md, "When there is no pose", in
// the words of the page.
import type { LocalizeResponse } from "visloc-client";

/** The stages of an answer, in their order; each can give up. */
export const STAGES = [
  ["features", "Features", "find keypoints in the photo"],
  ["retrieval", "Retrieval", "find mapping photos that look like it"],
  ["matching", "Matching", "match keypoints with landmarks"],
  ["pose", "Pose", "solve for a pose that explains the matches"],
  ["gate", "Gate", "check that the pose is reliable"],
] as const;

interface Advice {
  meaning: string;
  tries: string[];
}

const ANOTHER_PLACE = "Was the photo taken in the place of this map? If not, choose another map.";
const MORE_PHOTOS = "Under Options, raise “Mapping photos to match against” (top_k).";
const TURNED = "The photo is stored rotated: under Options, set read_as to upright.";
const TURNING_HELPS = ["too_few_matches", "no_pose", "too_few_inliers", "low_inlier_ratio"];
const DEFAULT_PRESET = "Under Options, choose the preset default instead of config1.";
const CHECK_CAMERA = "Check the camera: model, focal length, size.";
const SHARPER = "Try a sharper, brighter or larger photo.";

/** By reason; a test holds them against docs/api.md. */
export const ADVICE: Readonly<Record<string, Advice>> = {
  no_keypoints: {
    meaning: "The photo has no usable keypoints: it is dark, blurred, or shows a bare surface.",
    tries: [SHARPER, "Point the camera at something with texture."],
  },
  no_photo_near: {
    meaning: "The map has no photos near the place that the priors give.",
    tries: ["Check the priors, their frame and their unit.", "Send no priors."],
  },
  too_few_matches: {
    meaning: "Too few keypoints of the photo match landmarks of the map to search for a pose.",
    tries: [ANOTHER_PLACE, "Take in more of the scene.", MORE_PHOTOS],
  },
  no_pose: {
    meaning: "There are matches, but no camera pose explains them.",
    tries: [CHECK_CAMERA, MORE_PHOTOS, ANOTHER_PLACE],
  },
  too_few_inliers: {
    meaning:
      "The best pose explains too few matches. Usually the photo shows another place, or the " +
      "camera parameters are wrong.",
    tries: [ANOTHER_PLACE, CHECK_CAMERA],
  },
  low_inlier_ratio: {
    meaning: "The best pose explains too small a share of the matches.",
    tries: [ANOTHER_PLACE, CHECK_CAMERA, DEFAULT_PRESET],
  },
  uncertain_pose: {
    meaning:
      "The matches do not determine the pose. They lie on a line or in one spot, two halves of " +
      "them contradict each other, or the focal length cannot be estimated.",
    tries: [
      "Type the camera’s parameters.",
      "Step back, or choose a photo that shows both near and far things.",
      SHARPER,
    ],
  },
  camera_contradicted: {
    meaning: "The photo speaks for other camera parameters than those it came with.",
    tries: [
      CHECK_CAMERA,
      "Leave the camera out, if the photo is as it was taken.",
      "Of a photo that was cropped, stretched or turned, choose the original.",
    ],
  },
  contradicts_prior: {
    meaning: "The best pose contradicts the priors.",
    tries: ["Check the priors.", "Send no priors."],
  },
  unlikely_pose: {
    meaning:
      "A pose was found, but the map has other things there than the photo shows: this may be " +
      "a print, a screen, a mirror, or another place that looks alike.",
    tries: [ANOTHER_PLACE, CHECK_CAMERA],
  },
  ambiguous: {
    meaning: "Two places explain the photo about equally well.",
    tries: [
      "Send priors that say where the camera is, or search only the right map.",
      "Choose a photo that shows more of the scene.",
    ],
  },
  contradicts_motion: {
    meaning:
      "The pose of this photo contradicts the photos before and after it and the motion between.",
    tries: ["Check the odometry.", "Localize the photo on its own."],
  },
  no_usable_image: {
    meaning: "None of the photos could be read.",
    tries: ["Look at the error of each photo."],
  },
};

/** What this answer means and what to try; advice that does not apply to it is left out. */
export function advice(answer: LocalizeResponse, options: Record<string, string | number>): Advice {
  const reason = answer.refusal?.reason ?? "";
  const known = (Object.hasOwn(ADVICE, reason) && ADVICE[reason]) || {
    meaning: "This page does not know the reason. The message is the service’s.",
    tries: ["Reload the page: the service may be newer."],
  };
  const guessed = answer.camera.source === "guess" || answer.camera.source === "estimated";
  const { exif, read_as } = answer.orientation;
  const turned = exif !== 1 && read_as === "stored" && TURNING_HELPS.includes(reason);
  const tries = [
    ...(turned ? [TURNED] : []),
    ...known.tries.filter((text) => text !== DEFAULT_PRESET || options["preset"] === "config1"),
  ];
  if (guessed && answer.refusal?.stage === "gate" && reason !== "uncertain_pose") {
    const typed = "Type the camera’s parameters: the photo does not tell its focal length.";
    const others = tries.filter((text) => text !== CHECK_CAMERA);
    others.splice(turned ? 1 : 0, 0, typed);
    return { meaning: known.meaning, tries: others };
  }
  return { meaning: known.meaning, tries };
}

export type Outcome = "passed" | "stopped" | "not_reached";

/** How far the photo came, stage by stage. */
export function outcomes(answer: LocalizeResponse): Outcome[] {
  if (answer.refusal === null) return STAGES.map(() => "passed");
  const stopped = STAGES.findIndex(([stage]) => stage === answer.refusal?.stage);
  return STAGES.map((_, i) => (i < stopped ? "passed" : i === stopped ? "stopped" : "not_reached"));
}
