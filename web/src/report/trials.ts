// The held-out trials: how they went by how much was left out, and the photos that did worst.
import { element } from "../dom";
import { percentile } from "../geometry";
import { countText, counted } from "../words";
import { calibrationChart } from "./charts";
import type { HeldOutRun, ReportData } from "./data";
import { byLeftOut, degrees, kindestRuns, length, percent, succeeded } from "./words";

/** More failures than this nobody reads; of photos that did well a few show what "well" is. */
const [MOST_FAILURES, LEAST_PHOTOS] = [30, 10];

/** A table that scrolls by itself where the window is narrow. */
export function table(title: string, head: string[], rows: (Node | string)[][]): HTMLElement {
  const numeric = (column: number) => (column === 0 ? {} : { class: "number" });
  const made = element(
    "table",
    { "aria-label": title },
    element(
      "thead",
      {},
      element(
        "tr",
        {},
        ...head.map((name, i) => element("th", { scope: "col", ...numeric(i) }, name)),
      ),
    ),
    element(
      "tbody",
      {},
      ...rows.map(([first = "", ...rest]) =>
        element(
          "tr",
          {},
          element("th", { scope: "row" }, first),
          ...rest.map((value) => element("td", { class: "number" }, value)),
        ),
      ),
    ),
  );
  return element(
    "div",
    { class: "titled" },
    element("p", { class: "title" }, title), // a caption would be as wide as the table
    // A box that scrolls must be reachable with the keyboard.
    element("div", { class: "scrolls", tabindex: 0, role: "region", "aria-label": title }, made),
  );
}

export function trials(data: ReportData): Node[] {
  const { held_out: runs, coverage } = data;
  if (runs.length === 0) {
    return [element("p", {}, "None: without one of its photos, nothing would remain of this map.")];
  }
  const parts: Node[] = [
    element(
      "div",
      { class: "beside" },
      outcomes(data),
      coverage.calibration.length > 0 ? calibrationChart(coverage.calibration) : "",
    ),
  ];
  if (coverage.rank_correlation !== null) {
    parts.push(
      element(
        "p",
        {},
        `Between the chances that were predicted and how the trials went, the rank correlation is ` +
          `${coverage.rank_correlation.toFixed(2)}: 1 would be the right order, 0 none. Each trial ` +
          `was predicted from those of other photos only.`,
      ),
    );
  }
  return [...parts, worstPhotos(data)];
}

function outcomes({ held_out: runs, coverage: { within }, map }: ReportData): HTMLElement {
  const limits = `${length(within.position, map.metric)}, ${degrees(within.orientation_deg)}`;
  const rows = byLeftOut(runs).map(({ name, runs: group }) => {
    const answered = group.filter((run) => run.localized);
    const middle = (values: (number | null)[]) =>
      percentile(
        values.map((v) => v ?? Infinity),
        0.5,
      );
    const off = middle(answered.map((run) => run.position_error));
    const turned = middle(answered.map((run) => run.orientation_error_deg));
    return [
      name,
      countText(group.length),
      percent(group.filter((run) => succeeded(run, within)).length / group.length),
      percent(answered.length / group.length),
      answered.length === 0 ? "–" : `${length(off, map.metric)}, ${degrees(turned)}`,
    ];
  });
  return table(
    "Trials by how many photos were left out, itself among them",
    ["Left out", "Trials", `Within ${limits}`, "Any pose", "Median error"],
    rows,
  );
}

interface Worst {
  run: HeldOutRun;
  failed: boolean;
}

/** Photos that failed with the least left out, then those furthest off; one run of each. */
export function worstRuns(data: ReportData): Worst[] {
  const { within } = data.coverage;
  const rated = kindestRuns(data.held_out).map((run) => ({ run, failed: !succeeded(run, within) }));
  const off = (run: HeldOutRun) => run.position_error ?? Infinity;
  return rated.toSorted((a, b) => {
    if (off(a.run) !== off(b.run)) return off(a.run) < off(b.run) ? 1 : -1;
    return a.run.inliers - b.run.inliers;
  });
}

function worstPhotos(data: ReportData): HTMLElement {
  const worst = worstRuns(data);
  const failed = worst.filter((one) => one.failed).length;
  const shown = worst.slice(0, Math.max(LEAST_PHOTOS, Math.min(failed, MOST_FAILURES)));
  const rows = shown.map(({ run, failed: bad }) => [
    element("span", { class: "name" }, data.images[run.image]?.name ?? `photo ${run.image}`),
    element("span", { class: bad ? "failed" : "passed" }, outcomeOf(run, data, bad)),
    run.orientation_error_deg === null ? "–" : degrees(run.orientation_error_deg),
    countText(run.inliers),
    percent(run.probability),
  ]);
  const title =
    failed === 0
      ? `All ${countText(worst.length)} photos were localized without themselves; the furthest off`
      : `${counted(failed, "photo")} of ${countText(worst.length)} failed when only as little as possible was ` +
        `left out; the worst first`;
  const made = table(title, ["Photo", "Outcome", "Turned by", "Inliers", "Predicted"], rows);
  if (worst.length > shown.length) {
    made.append(
      element("p", { class: "note" }, `And ${worst.length - shown.length} that did better.`),
    );
  }
  return made;
}

function outcomeOf(run: HeldOutRun, data: ReportData, failed: boolean): string {
  if (!run.localized) return `refused: ${(run.reason ?? "unknown").replaceAll("_", " ")}`;
  const off = `${length(run.position_error ?? 0, data.map.metric)} off`;
  return failed ? `wrong: ${off}` : off;
}
