// The answer to a photo: a pose, or how far the photo came and what to try.
import {
  mapRef,
  type CoarsePose,
  type GeoPose,
  type LocalizeResponse,
  type PoseEstimate,
} from "visloc-client";
import { button, element, facts } from "../dom";
import { ellipsoid95, lengthText, REACH_95 } from "../geometry";
import { copyText, textsToCopy } from "./copying";
import type { Entry } from "./photo_queue";
import { photoPicture } from "./photo_picture";
import { advice, outcomes, STAGES } from "./refusals";
import { covarianceOfPosition, isSure, shownPlaces, verdictOf } from "./shown_pose";
import { poseLink } from "./share";
import { answerJson, curlLine, pythonLines, type Question } from "./snippets";
import { headingText, positionText } from "../earth";
import { CAMERA_SOURCES, countText, digits, positionStd, secondsText } from "../words";

const IN_FOLDER = "To be run in the folder of the photo.";
const LINK = "Opens this page at the pose. The photo is not in it.";

export interface AnswerActions {
  options: Record<string, string | number>;
  question: Question;
  /** Choose the map that the answer is of; null when it is the one that is shown. */
  chooseMap: (() => void) | null;
  announce(text: string): void;
  /** Let these mapping photos stand out; null is those of the answer. */
  highlight(image: string | null): void;
  /** Look at a candidate in the 3D view, by its row; null when another map is shown. */
  lookAt: ((place: number) => void) | null;
  takeCamera(): void;
  /** Ask again for the matches; null where the answer has them. */
  fetchMatches: (() => void) | null;
  again(): void;
}

export function answerView(
  entry: Entry,
  answer: LocalizeResponse,
  actions: AnswerActions,
): HTMLElement {
  const { pose, refusal } = answer;
  const link = poseLink(actions.question.server, answer);
  return element(
    "div",
    { class: "stack answer" },
    ...(actions.chooseMap === null ? [] : [ofAnotherMap(answer, actions.chooseMap)]),
    pose === null ? refused(answer, actions) : localized(answer, pose),
    ...candidateList(answer, actions),
    photoPicture(entry.photo, answer),
    ...(actions.fetchMatches === null
      ? []
      : [
          element(
            "div",
            { class: "row" },
            button("Show the matches (about 1 MB)", actions.fetchMatches),
          ),
        ]),
    ...(pose === null ? [] : [poseTable(pose)]),
    ...earthSection(answer.geopose),
    section(
      refusal === null ? "What it rests on" : "What was found",
      facts([
        ["Keypoints", `${countText(answer.keypoints)} in the photo`],
        ["Matches", `${countText(answer.correspondences)} with landmarks`],
        ["Inliers", `${countText(answer.inliers)}, ${percent(answer)} of the matches`],
        ["Camera", cameraWords(answer, actions)],
        ...orientationWords(answer),
        ["Map", answer.map.id],
        ...(answer.tile === null ? [] : [["Tile", answer.tile] as [string, string]]),
        ["Version", answer.map.version],
        ["Request", requestWords(answer.request_id, actions.announce)],
      ]),
    ),
    section("Time", timeBar(answer, entry.seconds)),
    retrievedTable(answer, actions),
    ...(entry.overlay === null ? [] : [overlayDisclosure(entry.overlay)]),
    section(
      "Take along",
      textsToCopy(
        [
          { name: "JSON", text: answerJson(answer), note: "What the line of curl answers." },
          { name: "curl", text: curlLine(actions.question), note: IN_FOLDER },
          { name: "Python", text: pythonLines(actions.question), note: IN_FOLDER },
          ...(link === null ? [] : [{ name: "Link", text: link, note: LINK }]),
        ],
        actions.announce,
      ),
    ),
    element("div", { class: "row" }, button("Ask again", actions.again)),
  );
}

function ofAnotherMap({ map }: LocalizeResponse, choose: () => void): HTMLElement {
  return element(
    "div",
    { class: "note stack near" },
    element(
      "p",
      {},
      `This is an answer of ${map.id}, version ${map.version}: not of what is shown.`,
    ),
    element("div", { class: "row" }, button("Show that map", choose)),
  );
}

/** One line about an answer, for lists and for those who do not see it. */
export function inShort(answer: LocalizeResponse): string {
  return answer.pose !== null
    ? `${verdictOf(answer.pose).name.toLowerCase()}, ${countText(answer.inliers)} inliers`
    : `${answer.coarse ? "coarse" : "not localized"}: ${answer.refusal?.message ?? ""}`;
}

const COVERED = {
  whole:
    "This holds the scatter of the matches and the errors of the map, as its own test measured them. ",
  "photo only":
    "This is the scatter of the matches alone: the map has no test of its own, and errors that landmarks " +
    "share, of depth, calibration and the mapping photos’ poses, are left out. ",
};
const FOOLED = "Look-alike places, prints, mirrors and a wrong camera can fool it.";

function localized(answer: LocalizeResponse, pose: PoseEstimate): HTMLElement {
  const { name, doubt } = verdictOf(pose);
  const metric = pose.metric === true;
  const std = ellipsoid95(covarianceOfPosition(pose)).halfAxes[0] / REACH_95;
  return element(
    "div",
    { class: `verdict ${doubt === "" ? "good" : "unsure"}` },
    element("h2", {}, name),
    ...(doubt === "" ? [] : [element("p", {}, doubt)]),
    element(
      "p",
      {},
      `${percent(answer)} of the matches agree on a place, known to ±${lengthText(std, metric, 2)} ` +
        "(one standard deviation).",
    ),
    element("p", {}, COVERED[pose.uncertainty] + FOOLED),
  );
}

function refused(answer: LocalizeResponse, { options }: AnswerActions): HTMLElement {
  const { meaning, tries } = advice(answer, options);
  const states = outcomes(answer);
  const said = { passed: "passed", stopped: "stopped here", not_reached: "not reached" };
  const steps = STAGES.map(([, name, what], i) =>
    element(
      "li",
      { class: states[i]!, title: what },
      element("span", {}, name),
      element("span", { class: "unseen" }, `: ${said[states[i]!]}`),
    ),
  );
  return element(
    "div",
    { class: "verdict unsure stack near" },
    element("h2", {}, "The map says: I do not know."),
    element("ol", { class: "pipeline", "aria-label": "How far the photo came" }, ...steps),
    ...(answer.coarse ? [element("p", {}, coarseWords(answer.coarse))] : []),
    element("p", {}, meaning),
    element(
      "p",
      { class: "small" },
      `In the words of the service: ${answer.refusal?.message ?? ""}`,
    ),
    element("h3", {}, "What to try"),
    element("ul", { class: "tries" }, ...tries.map((text) => element("li", {}, text))),
  );
}

/** What a coarse pose is worth, whose ellipsoid the 3D view draws. */
function coarseWords(coarse: CoarsePose): string {
  const [reach] = ellipsoid95(covarianceOfPosition(coarse)).halfAxes;
  return (
    "Coarse: the most similar mapping photos were taken about here. Nothing confirms it; with 95 % " +
    `the photo was taken within the ellipsoid that is drawn, at most ${lengthText(reach, coarse.metric === true, 2)} away.`
  );
}

/** The two places of an ambiguous photo. */
function candidateList(answer: LocalizeResponse, actions: AnswerActions): HTMLElement[] {
  const candidates = answer.refusal?.candidates ?? [];
  if (candidates.length === 0) return [];
  const { lookAt } = actions;
  const drawn = shownPlaces(answer);
  const rows = candidates.map(({ map, tile, position, inliers, image, preference }, place) => {
    const where = position.map((value) => value.toFixed(2)).join(", ");
    const told = preference === null ? "" : `, preferred by ${signed(preference)} deviations`;
    const facts = element(
      "p",
      {},
      `${tile ?? mapRef(map)}, at ${where}: ${countText(inliers)} inliers${told}`,
    );
    const buttons = element("div", { class: "row" });
    if (image !== null) {
      buttons.append(button(image, () => actions.highlight(image), { class: "link name" }));
    }
    // Places of another map cannot be drawn in this one.
    if (lookAt !== null && drawn.length === candidates.length) {
      buttons.append(button("Look there", () => lookAt(place)));
    }
    return element("li", { class: "stack near" }, facts, buttons);
  });
  const title = candidates.length === 1 ? "Perhaps here" : "Either of two places";
  return [section(title, element("ol", { class: "candidates" }, ...rows))];
}

function signed(value: number): string {
  return `${value < 0 ? "−" : "+"}${Math.abs(value).toFixed(1)}`;
}

function percent(answer: LocalizeResponse): string {
  return `${digits(100 * answer.inlier_ratio, 2)} %`;
}

/** Where on Earth, and which way; nothing of a map that is not anchored. */
export function earthSection(geopose: GeoPose | null): HTMLElement[] {
  if (geopose === null) return [];
  const rows: [string, string][] = [
    ["Latitude, longitude", positionText(geopose)],
    ["Height", `${geopose.position.h.toFixed(2)} m above the ellipsoid`],
    ["Heading", headingText(geopose)],
  ];
  return [section("On Earth", facts(rows))];
}

function poseTable(pose: PoseEstimate): HTMLElement {
  const metric = pose.metric === true;
  const row = (name: string, unit: string, values: string[]): HTMLElement =>
    element(
      "tr",
      {},
      element("th", { scope: "row" }, name),
      ...values.map((value) => element("td", { class: "number" }, value)),
      element("td", { class: "quiet" }, unit),
    );
  const heads = (...names: string[]): HTMLElement =>
    element(
      "tr",
      {},
      element("td"),
      ...names.map((name) => element("th", { class: "number", scope: "col" }, name)),
      element("td"),
    );
  const unit = metric ? "m" : "units";
  return section(
    "Pose",
    element(
      "table",
      { class: "pose" },
      element(
        "tbody",
        {},
        heads("x", "y", "z"),
        row(
          "Position",
          unit,
          pose.position.map((value) => value.toFixed(3)),
        ),
        row(
          "Position’s std",
          metric ? "cm" : unit,
          pose.position_std.map((std) => positionStd(std, metric)),
        ),
        row(
          "Rotation’s std",
          "°",
          pose.orientation_std_deg.map((std) => digits(std, 2)),
        ),
      ),
    ),
    ...(pose.probability === null
      ? []
      : [
          element(
            "p",
            { class: "small" },
            element("span", { class: "quiet" }, "Probability that it is right: "),
            element("span", { class: "number" }, pose.probability.toFixed(3)),
          ),
        ]),
    element(
      "p",
      { class: "small" },
      element("span", { class: "quiet" }, "Orientation w, x, y, z: "),
      element(
        "span",
        { class: "number" },
        pose.orientation.map((value) => value.toFixed(4)).join(", "),
      ),
    ),
  );
}

function cameraWords(answer: LocalizeResponse, actions: AnswerActions): HTMLElement {
  const { model, width, height, params, source } = answer.camera;
  const numbers = params.map((value) => digits(value, 6)).join(", ");
  return element(
    "div",
    {},
    `${model} ${width} × ${height}: ${numbers}`,
    element("div", { class: "quiet" }, CAMERA_SOURCES[source] ?? source),
    // The camera of a doubtful pose may be as wrong as the pose.
    ...(source === "given" || answer.pose === null || !isSure(answer.pose)
      ? []
      : [button("Use as typed camera", actions.takeCamera, { class: "link" })]),
  );
}

/** Of a photo that is stored rotated, or that the map knew only when turned: how it was read. */
function orientationWords({ orientation }: LocalizeResponse): [string, string][] {
  const { exif, read_as, turned } = orientation;
  const words: [string, string][] = [];
  if (exif !== 1) {
    const read = read_as === "upright" ? read_as : "as stored";
    words.push(["Orientation", `stored rotated (EXIF ${exif}), read ${read}`]);
  }
  if (turned) words.push(["Turned", `by ${turned}° clockwise: the map knew the photo only so`]);
  return words;
}

/** The number that the service's log knows the request by. */
function requestWords(id: string, announce: (text: string) => void): HTMLElement {
  const shown = element("span", { class: "name" }, id);
  const copy = button("Copy", () => void copied(), { class: "link", "aria-label": "Copy request" });
  const copied = async (): Promise<void> => {
    const done = await copyText(id, shown);
    announce(done ? "Request copied" : "Request selected: copy it with the keyboard");
  };
  return element("div", { class: "request" }, shown, " ", copy);
}

// In their order; others are kept as they are named.
const STAGE_NAMES: Readonly<Record<string, string>> = {
  queued: "waiting",
  open_map: "opening the map",
  decode: "decoding",
  local_features: "local features",
  global_features: "global features",
  retrieval: "retrieval",
  matching: "matching",
  pose: "pose",
  turns: "looking at other turns",
};

function timeBar(answer: LocalizeResponse, whole: number | null): HTMLElement {
  const all = Object.entries(answer.seconds);
  const total = all.reduce((sum, [, seconds]) => sum + seconds, 0);
  // What takes less than a hundredth is in the sum only.
  const parts = all.filter(([, seconds]) => seconds >= total / 100);
  const drawn = parts.reduce((sum, [, seconds]) => sum + seconds, 0);
  const bar = element("div", { class: "parts", "aria-hidden": "true" });
  const legend = element("ul", { class: "parts-legend" });
  for (const [i, [stage, seconds]] of parts.entries()) {
    const part = element("span", { class: `part-${(i % 6) + 1}` });
    part.style.flexGrow = String(seconds / drawn); // less than 1 in all would leave room empty
    bar.append(part);
    legend.append(
      element(
        "li",
        { class: `part-${(i % 6) + 1}` },
        `${STAGE_NAMES[stage] ?? stage} `,
        element("span", { class: "number quiet" }, secondsText(seconds)),
      ),
    );
  }
  const way = whole === null ? "" : `, ${secondsText(whole)} with the way there and back`;
  return element(
    "div",
    { class: "stack near" },
    element("p", { class: "number" }, `${secondsText(total)} at the service${way}`),
    bar,
    legend,
  );
}

function retrievedTable(answer: LocalizeResponse, actions: AnswerActions): HTMLElement {
  if (answer.retrieved.length === 0) return element("p", { class: "quiet" }, "No mapping photos.");
  const kinds = [...new Set(answer.retrieved.flatMap((r) => Object.keys(r.similarities)))];
  // Names are long: each has a line of its own above its numbers.
  const groups = answer.retrieved.map(({ image, score, similarities }) => {
    const name = button(image, () => actions.highlight(image), { class: "link name" });
    const numbers = [score, ...kinds.map((kind) => similarities[kind])];
    const group = element(
      "tbody",
      {},
      element("tr", {}, element("th", { scope: "rowgroup", colspan: numbers.length }, name)),
      element(
        "tr",
        {},
        ...numbers.map((n) => element("td", { class: "number" }, n?.toFixed(3) ?? "–")),
      ),
    );
    group.addEventListener("pointerenter", () => actions.highlight(image));
    group.addEventListener("pointerleave", () => actions.highlight(null));
    name.addEventListener("focus", () => actions.highlight(image));
    name.addEventListener("blur", () => actions.highlight(null));
    return group;
  });
  const heads = ["score", ...kinds].map((text) =>
    element("th", { scope: "col", class: "number" }, text),
  );
  return element(
    "details",
    { open: true },
    element(
      "summary",
      {},
      "Mapping photos that look alike",
      element("span", { class: "quiet" }, countText(groups.length)),
    ),
    element(
      "div",
      { class: "scrolled", tabindex: 0, role: "region", "aria-label": "Mapping photos" },
      element(
        "table",
        { class: "retrieved" },
        element("thead", {}, element("tr", {}, ...heads)),
        ...groups,
      ),
    ),
  );
}

function overlayDisclosure(jpeg: Blob): HTMLElement {
  const image = element("img", { alt: "The photo’s matches beside photos of the map" });
  const details = element("details", {}, element("summary", {}, "Picture of the matches"), image);
  let url = "";
  details.addEventListener("toggle", () => {
    URL.revokeObjectURL(url);
    url = "";
    if (details.open) image.src = url = URL.createObjectURL(jpeg);
  });
  // Decoded, it needs its address no more.
  image.addEventListener("load", () => URL.revokeObjectURL(url));
  return details;
}

function section(title: string, ...children: Node[]): HTMLElement {
  return element("section", { class: "stack near" }, element("h3", {}, title), ...children);
}
