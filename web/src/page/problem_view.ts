// What the service refused, or why it did not answer, in words; and what to do.
import type { ServiceError } from "visloc-client";
import { button, element, facts } from "../dom";

export interface ProblemActions {
  /** Ask for an API key. */
  giveKey(): void;
  /** Look which maps there are: what is not there may have been removed. */
  reloadMaps(): void;
  /** Do again what failed; none where that happens by itself. */
  again?: () => void;
}

export function problemView(error: ServiceError, actions: ProblemActions): HTMLElement {
  const { problem } = error;
  const [title, advice] = wordsFor(error);
  const buttons = element("div", { class: "row" });
  if (problem.status === 401 || problem.status === 403) {
    buttons.append(button("Give an API key", actions.giveKey, { class: "primary" }));
  }
  if (problem.status === 404) {
    buttons.append(button("Look which maps there are", actions.reloadMaps, { class: "primary" }));
  } else if (actions.again !== undefined) {
    buttons.append(button("Ask again", actions.again));
  }

  const rows: [string, string][] = [];
  for (const [name, value] of [
    ["Field", problem.field],
    ["Expected", problem.expected],
    ["Got", problem.got],
    ["Code", problem.code],
    ["Request", problem.request_id],
  ] as const) {
    if (value !== null && value !== "") rows.push([name, value]);
  }
  return element(
    "div",
    { class: "note bad stack near problem" },
    element("h2", {}, title),
    element("p", {}, sentence(problem.detail)),
    ...(advice === "" ? [] : [element("p", {}, advice)]),
    facts(rows),
    ...(buttons.childElementCount > 0 ? [buttons] : []),
  );
}

function wordsFor({ problem, retryAfterSeconds }: ServiceError): [title: string, advice: string] {
  const wait =
    retryAfterSeconds === null
      ? "Wait a moment, then ask again."
      : `Wait ${Math.ceil(retryAfterSeconds)} s, then ask again.`;
  const report =
    problem.request_id === ""
      ? "Tell whoever runs the service."
      : "Tell whoever runs the service, with the number of the request.";
  switch (problem.status) {
    case 0:
      if (problem.code === "server.unreachable") {
        return ["No answer", "Is the service running, and the network there?"];
      }
      return [problem.title, ""];
    case 401:
      return [
        problem.code === "access.key_unknown"
          ? "This API key is not known"
          : "An API key is needed",
        "Whoever runs the service makes keys.",
      ];
    case 403:
      return [
        "Not allowed",
        "Looking at maps takes a key with “read”, photos one with “localize”.",
      ];
    case 404:
      return ["Not there", "It may have been removed since this page came: choose another one."];
    case 413:
      return ["Too large", "Make the photo smaller."];
    case 429:
      return ["The service is busy", wait];
    case 503:
      return ["The service is not ready", wait];
    case 504:
      return ["It took too long", "Ask again later, or for less: fewer photos to match (top_k)."];
    case 400:
    case 422:
      return ["The service cannot use this", ""];
    default:
      return [problem.status < 500 ? "The service refuses this" : "The service failed", report];
  }
}

/** As a sentence: the service's texts begin small and have no full stop. */
export function sentence(text: string): string {
  const begun = text.charAt(0).toUpperCase() + text.slice(1);
  return /[.?!]$/.test(begun) ? begun : `${begun}.`;
}
