// What the tab "Live" is made of; what it does is in live.ts.
import { element, field } from "../dom";
import { FIELD_OF_VIEW_DEG } from "./live_camera";

/** Build the elements; nothing in them comes from outside yet. */
export function livePanel() {
  const video = element("video", { playsinline: true, "aria-label": "What the camera sees" });
  video.muted = true; // an attribute does not count for elements that scripts make
  const preview = element("div", { class: "live-preview" }, video);
  const toggle = element("button", { type: "button", id: "live-toggle", class: "primary" });
  const status = element("p", { class: "live-status", id: "live-status" });
  const message = element("p", { class: "live-message small", id: "live-message" });

  const figures = {
    rate: element("dd", { id: "live-rate" }),
    latency: element("dd", { id: "live-latency" }),
    server: element("dd", { id: "live-server" }),
    share: element("dd", { id: "live-share" }),
  };

  const camera = select("live-camera", [
    ["environment", "Rear, or any"],
    ["user", "Front"],
  ]);
  const longest = select("live-longest", [
    ["640", "640 pixels"],
    ["960", "960 pixels"],
    ["1280", "1280 pixels"],
  ]);
  const view = element("input", {
    type: "number",
    id: "live-view",
    ...FIELD_OF_VIEW_DEG,
    step: "any",
    inputmode: "decimal",
    "aria-describedby": "live-view-note",
  });
  const viewNote = element("p", { class: "quiet small", id: "live-view-note" });
  const useEstimate = button("live-use-estimate", "");

  const prior = checkbox("live-prior", "live-prior-note");
  const priorNote = element("p", { class: "quiet small", id: "live-prior-note" });
  const follow = checkbox("live-follow");
  follow.checked = true;

  const clear = button("live-clear", "Clear trail");
  const csv = button("live-csv", "Save CSV");
  const tum = button("live-tum", "Save TUM");

  const root = element(
    "div",
    { class: "live stack" },
    element("div", { class: "row" }, toggle, status),
    message,
    preview,
    element(
      "dl",
      { class: "facts" },
      ...named("Rate", figures.rate),
      ...named("Latency (median)", figures.latency),
      ...named("Service (median)", figures.server),
      ...named("Localized, last 20", figures.share),
    ),
    element(
      "fieldset",
      { class: "stack near" },
      element("legend", {}, "Walk"),
      element("label", { class: "check" }, follow, "The view follows"),
      element("label", { class: "check" }, prior, "Last pose as prior"),
      priorNote,
      element("div", { class: "row" }, clear, csv, tum),
    ),
    element(
      "fieldset",
      { class: "stack near" },
      element("legend", {}, "Camera"),
      element(
        "div",
        { class: "fields" },
        field("Which", camera),
        field("Frames, longer side", longest),
        field("Field of view, degrees", view),
      ),
      viewNote,
      useEstimate,
    ),
  );
  return {
    ...{ root, preview, video, toggle, status, message, figures },
    ...{ camera, longest, view, viewNote, useEstimate },
    ...{ prior, priorNote, follow, clear, csv, tum },
  };
}

function named(name: string, value: HTMLElement): HTMLElement[] {
  return [element("dt", {}, name), value];
}

function select(id: string, choices: [value: string, label: string][]): HTMLSelectElement {
  const options = choices.map(([value, label]) => element("option", { value }, label));
  return element("select", { id }, ...options);
}

function checkbox(id: string, note?: string): HTMLInputElement {
  return element("input", { type: "checkbox", id, "aria-describedby": note ?? false });
}

function button(id: string, name: string): HTMLButtonElement {
  return element("button", { type: "button", id }, name);
}
