// What the tab "Photo" says about the pose of a link.
import { button, element, facts } from "../dom";
import { lengthText } from "../geometry";
import { earthSection } from "./answer_view";
import type { SharedPose } from "./share";

export interface SharedActions {
  metric: boolean;
  /** Show the map of the pose; null where it is shown, or is still to come. */
  chooseMap: (() => void) | null;
}

/** The numbers of a link: they are not an answer of this service. */
export function sharedView(pose: SharedPose, { metric, chooseMap }: SharedActions): HTMLElement {
  const { position, positionCovariance } = pose.shown;
  const unit = metric ? "m" : "units";
  const at = position.map((value) => value.toFixed(3)).join(", ");
  const std = [0, 4, 8].map((i) => lengthText(Math.sqrt(positionCovariance[i]!), metric, 2));
  const rows: [string, string][] = [
    ["Position", `${at} ${unit}`],
    ["Position’s std", std.join(", ")],
    ...(pose.probability === null
      ? []
      : [["Probability that it is right", pose.probability.toFixed(3)] as [string, string]]),
    ["Map", pose.map],
    ...(pose.request === "" ? [] : [["Request", pose.request] as [string, string]]),
  ];
  return element(
    "div",
    { class: "stack answer" },
    ...(chooseMap === null
      ? []
      : [element("div", { class: "note row" }, button("Show the map of this pose", chooseMap))]),
    element(
      "div",
      { class: "verdict" },
      element("h2", {}, "A pose from a link"),
      element(
        "p",
        {},
        "These numbers came with the link, which anybody may have written. The service did not check them.",
      ),
    ),
    facts(rows),
    ...earthSection(pose.geopose),
  );
}

export function damagedLink(): HTMLElement {
  return element(
    "div",
    { class: "verdict unsure" },
    element("h2", {}, "This link is damaged"),
    element("p", {}, "It tells of a pose, but a part is missing or is no number. Copy all of it."),
  );
}
