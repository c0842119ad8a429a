// How the report came about, where it flatters, and what it cannot know.
import { element } from "../dom";
import type { ReportData } from "./data";
import { degrees } from "./words";

export function aboutSection(data: ReportData): Node[] {
  const { coverage, up, made_by } = data;
  const list = (...texts: string[]) =>
    element("ul", {}, ...texts.map((text) => element("li", {}, text)));
  const level =
    up.source === "gravity"
      ? "What is level comes from the map's gravity."
      : "The map does not know gravity: what is level comes from how the mapping photos were held.";
  return [
    element("h3", {}, "What was done"),
    list(
      "Mapping photos were localized in the map as it would be without them, then also without " +
        "the photos nearest to them, which is as if nobody had been there with a camera.",
      "The trials taught how likely something in view is found again: the less so, the more the " +
        "direction and the distance differ from those that it was photographed from, the fewer photos " +
        "nearby see it, and when something stands in front. And how likely a pose within the limits " +
        "is, from so many matches so spread.",
      "Then it was asked what a photo would have in view at each place of a grid, and in each " +
        "direction. The grid reaches around the photos by half the distance from which they see.",
      `The photos of the grid are taken by the camera of most mapping photos, at their height, ` +
        `${degrees(Math.abs(coverage.pitch_deg))} ${coverage.pitch_deg >= 0 ? "below" : "above"} the ` +
        `level (their median). ${level}`,
    ),
    element("h3", {}, "Where it flatters"),
    list(
      "The trials use the photos that the map was made of: the same camera, the same light, the same day.",
      "Landmarks stay where the whole map puts them, with the help of the photo that is held out.",
    ),
    element("h3", {}, "What it does not know"),
    list(
      "Walls that have no landmarks: places within and behind them are on the plan too, and what " +
        "is thought to be in view there may be hidden.",
      "What changes: people, furniture, seasons, lamps.",
      "Photos held otherwise than upright, or by a camera with another angle of view.",
    ),
    element("h3", {}, "Command"),
    element("pre", { tabindex: 0 }, made_by.command),
    element("p", { class: "note" }, `visloc ${made_by.version}`),
  ];
}
