// What to try when the map does not know, in plain words: the table of docs/api.md, "When there is
// no pose", for someone who looks at a page.
import type { LocalizeResponse } from "../api";

/** The stages of an answer, in their order; each can give up. */
export const STAGES = [
  ["features", "Features", "what the photo shows is found"],
  ["retrieval", "Retrieval", "photos of the map that look alike"],
  ["matching", "Matching", "points of the photo with landmarks"],
  ["pose", "Pose", "a camera that explains the matches"],
  ["gate", "Gate", "whether the pose can be relied on"],
] as const;

interface Advice {
  meaning: string;
  tries: string[];
}

const ANOTHER_PLACE = "Was the photo taken in the place of this map? If not, choose another map.";
const MORE_PHOTOS = "Under Options, raise “mapping photos to match” (top_k).";
const TURNED = "The photo is stored rotated: under Options, set “Read photo as” to upright.";
const TURNING_HELPS = ["too_few_matches", "no_pose", "too_few_inliers", "low_inlier_ratio"];
const DEFAULT_PRESET = "Under Options, choose the preset default instead of config1.";
const CHECK_CAMERA = "Check the camera: model, focal length, size.";
const SHARPER = "Try a sharper, brighter or larger photo.";

/** By reason; a test holds them against docs/api.md. */
export const ADVICE: Readonly<Record<string, Advice>> = {
  no_keypoints: {
    meaning: "The photo shows nothing to hold on to: it is dark, blurred, or of a bare surface.",
    tries: [SHARPER, "Point the camera at something with structure."],
  },
  no_photo_near: {
    meaning: "The map has no photo where this one is said to have been taken.",
    tries: ["Check what is known before (the priors), its frame and its unit.", "Leave it out."],
  },
  too_few_matches: {
    meaning: "Too little of the photo was found among the map’s landmarks to look for a pose.",
    tries: [ANOTHER_PLACE, "Take in more of the scene.", MORE_PHOTOS],
  },
  no_pose: {
    meaning: "There are matches, but no camera sees them where they lie in the photo.",
    tries: [CHECK_CAMERA, MORE_PHOTOS, ANOTHER_PLACE],
  },
  too_few_inliers: {
    meaning:
      "The best pose explains too few matches: as a rule of another place, or with wrong " +
      "camera parameters.",
    tries: [ANOTHER_PLACE, CHECK_CAMERA],
  },
  low_inlier_ratio: {
    meaning: "The best pose explains too small a share of the matches.",
    tries: [ANOTHER_PLACE, CHECK_CAMERA, DEFAULT_PRESET],
  },
  uncertain_pose: {
    meaning:
      "What was matched leaves the pose open: it lies in a line or a spot, halves of it " +
      "contradict each other, or the camera’s focal length cannot be told.",
    tries: [
      "Type the camera’s parameters.",
      "Step back, or choose a photo in which near and far things are seen.",
      SHARPER,
    ],
  },
  contradicts_prior: {
    meaning: "The best pose is not where the camera is said to be.",
    tries: ["Check what is known before (the priors).", "Leave it out."],
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
      "Say where the camera is (the priors), or ask the right map alone.",
      "Choose a photo that shows more of the scene.",
    ],
  },
  contradicts_motion: {
    meaning: "The photo says one thing, its neighbours in time and the motion another.",
    tries: ["Check the odometry.", "Ask about the photo alone."],
  },
  no_usable_image: {
    meaning: "None of the photos could be read.",
    tries: ["Look at the error of each photo."],
  },
};

/** What to try for this answer to what was asked: what may not apply to it is left out. */
export function advice(answer: LocalizeResponse, options: Record<string, string | number>): Advice {
  const reason = answer.refusal?.reason ?? "";
  const known = (Object.hasOwn(ADVICE, reason) && ADVICE[reason]) || {
    meaning: "This page does not know the reason; the message is the service's.",
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
