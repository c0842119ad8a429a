// Shares, places and verdicts in words.
import { lengthText } from "../geometry";
import { countText, counted } from "../words";
import type { HeldOutRun, ReportData } from "./data";
import { boxOf, onPlan, type PlanPoint } from "./plan";

/** Classes of a probability, from the best; `from` is the least that belongs to it. */
export const CHANCES = [
  { from: 0.9, name: "localized in 90 % of cases or more" },
  { from: 0.5, name: "in 50 to 90 %" },
  { from: 0.1, name: "in 10 to 50 %" },
  { from: 0, name: "in less than 10 %" },
] as const;

/** 0 is the best class. */
export function classOfChance(probability: number): number {
  return CHANCES.findIndex(({ from }) => probability >= from);
}

export function percent(share: number): string {
  const value = 100 * share;
  if (value > 0 && value < 0.5) return "under\u00a01\u00a0%";
  if (value < 100 && value >= 99.5) return "over\u00a099\u00a0%";
  return `${Math.round(value)}\u00a0%`;
}

/** A length of the world: two digits, as much as there is to know. */
export function length(value: number, metric: boolean): string {
  return lengthText(value, metric, 2);
}

export function degrees(value: number): string {
  return `${value < 10 ? Number(value.toPrecision(2)) : Math.round(value)}°`;
}

/** Twelve o'clock is up on the plan. */
export function clock(heading: number): string {
  const hour = Math.round((((90 - heading) % 360) + 360) / 30) % 12;
  return `${hour === 0 ? 12 : hour}\u00a0o’clock`;
}

const PLACES = [
  ["upper left", "top", "upper right"],
  ["left", "middle", "right"],
  ["lower left", "bottom", "lower right"],
];

/** Where on the plan: by thirds of what the cells cover. */
export function placeName(coverage: ReportData["coverage"], point: PlanPoint): string {
  const box = boxOf(coverage.cells.map((cell) => onPlan(coverage, cell.position)));
  const third = (value: number, low: number, high: number) =>
    high > low ? Math.min(2, Math.max(0, Math.floor((3 * (value - low)) / (high - low)))) : 1;
  const row = third(point.y, box.min.y, box.max.y);
  return PLACES[row]?.[third(point.x, box.min.x, box.max.x)] ?? "middle";
}

/** Whether a run counts: within the limits of where the photo was taken. */
export function succeeded(run: HeldOutRun, within: ReportData["coverage"]["within"]): boolean {
  return (
    run.localized &&
    (run.position_error ?? Infinity) <= within.position &&
    (run.orientation_error_deg ?? Infinity) <= within.orientation_deg
  );
}

/** Of each photo the run that left out the fewest: the kindest, and the likest to a real query. */
export function kindestRuns(runs: HeldOutRun[]): HeldOutRun[] {
  const best = new Map<number, HeldOutRun>();
  for (const run of runs) {
    const known = best.get(run.image);
    if (!known || run.left_out < known.left_out) best.set(run.image, run);
  }
  return [...best.values()];
}

const LEFT_OUT_FROM = [1, 2, 5, 10, 20, 50];

/** Runs by how many photos were left out, the fewest first; only what there is. */
export function byLeftOut(runs: HeldOutRun[]): { name: string; runs: HeldOutRun[] }[] {
  return LEFT_OUT_FROM.map((from, index) => {
    const below = LEFT_OUT_FROM[index + 1] ?? Infinity;
    const last = below - 1;
    const name =
      last === from ? `${from}` : last === Infinity ? `${from} and more` : `${from} to ${last}`;
    return { name, runs: runs.filter((run) => run.left_out >= from && run.left_out < below) };
  }).filter((group) => group.runs.length > 0);
}

/** Share of places and directions in each class, from the best. */
export function sharesOfChance(coverage: ReportData["coverage"]): number[] {
  const totals = CHANCES.map(() => 0);
  let all = 0;
  for (const cell of coverage.cells) {
    for (const probability of cell.probability) {
      const index = classOfChance(probability);
      totals[index] = (totals[index] ?? 0) + 1;
      all += 1;
    }
  }
  return totals.map((total) => (all === 0 ? 0 : total / all));
}

/** What the map is worth, in two or three sentences. */
export function verdict(data: ReportData): string[] {
  const { coverage, held_out: runs } = data;
  const sentences: string[] = [];
  const kindest = kindestRuns(runs);
  if (kindest.length > 0) {
    const good = kindest.filter((run) => succeeded(run, coverage.within)).length;
    sentences.push(
      `A photo taken where the mapping photos were taken is localized in ` +
        `${percent(good / kindest.length)} of trials: ${countText(good)} of ` +
        `${counted(kindest.length, "mapping photo")}, each localized in the map without itself.`,
    );
  } else {
    sentences.push("No mapping photo could be held out, so that all below is a guess.");
  }
  const shares = sharesOfChance(coverage);
  const likely = (shares[0] ?? 0) + (shares[1] ?? 0);
  sentences.push(
    `In and around the mapped area, looking any way, a photo has an even chance or better in ` +
      `${percent(likely)} of places and directions.`,
  );
  const worst = coverage.weak_spots[0];
  if (worst) {
    const place = placeName(coverage, onPlan(coverage, worst.position));
    sentences.push(
      `More photos help most ${place === "middle" ? "in the middle" : `at the ${place}`} of the ` +
        `plan, looking towards ${clock(worst.direction_deg)}, where the chance is ` +
        `${percent(worst.probability)}.`,
    );
  } else {
    sentences.push("No weak spot was found.");
  }
  return sentences;
}

/** No pair of places was found to look alike: why. */
export function lookAlikesInWords(asked: number): string {
  return asked === 0
    ? "Not testable: all photos share one place, so that none can be looked for elsewhere."
    : `None were found: ${counted(asked, "photo")} looked for elsewhere.`;
}
