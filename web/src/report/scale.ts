// From a number to one of four classes, the best first, and what each class is called.
import type { CoverageCell } from "./data";
import { CHANCES, classOfChance, length } from "./words";

export type Quantity = "probability" | "position_std";

export interface Scale {
  title: string;
  /** Of the four classes, and of what has no value. */
  names: string[];
  none: string | null;
  /** Null for what has no value. */
  classOf(cell: CoverageCell, direction: number): number | null;
  /** Length of a petal as a share of the cell's: a second sign beside the colour. */
  reach(cell: CoverageCell, direction: number): number;
}

export function chanceScale(): Scale {
  const of = (cell: CoverageCell, direction: number) => cell.probability[direction] ?? 0;
  return {
    title: "A photo taken here, looking that way, is",
    names: CHANCES.map(({ name }) => name),
    none: null,
    classOf: (cell, direction) => classOfChance(of(cell, direction)),
    // Not in proportion: what is weak must be seen best.
    reach: (cell, direction) => 0.6 + 0.4 * Math.sqrt(of(cell, direction)),
  };
}

export function uncertaintyScale(cells: CoverageCell[], metric: boolean): Scale {
  const bounds = uncertaintyBounds(cells.flatMap((cell) => cell.position_std));
  const shown = bounds.map((bound) => length(bound, metric));
  const classOf = (cell: CoverageCell, direction: number) => {
    const value = cell.position_std[direction] ?? null;
    if (value === null) return null;
    const found = bounds.findIndex((bound) => value <= bound);
    return found < 0 ? 3 : found;
  };
  return {
    title: "Position of a photo that is localized here, standard deviation",
    names: [
      `up to ${shown[0]}`,
      `${shown[0]} to ${shown[1]}`,
      `${shown[1]} to ${shown[2]}`,
      `more than ${shown[2]}`,
    ],
    none: "no pose expected",
    classOf,
    reach: (cell, direction) => [1, 0.9, 0.8, 0.7][classOf(cell, direction) ?? 3] ?? 0.6,
  };
}

/** Three neighbours of the series 1, 2, 5, 10, ..., the first above a quarter of the values. */
export function uncertaintyBounds(values: (number | null)[]): number[] {
  const known = values.filter((value): value is number => value !== null && value > 0);
  known.sort((a, b) => a - b);
  const quarter = known[Math.floor(known.length / 4)] ?? 0.01;
  const start = 3 * Math.floor(Math.log10(quarter));
  // Whole powers are divided by, not multiplied with: 2 / 100 is 0.02, 2 * 0.01 not always.
  const step = (index: number) => {
    const [digit, power] = [
      [1, 2, 5][index % 3 < 0 ? (index % 3) + 3 : index % 3] ?? 1,
      Math.floor(index / 3),
    ];
    return power < 0 ? digit / 10 ** -power : digit * 10 ** power;
  };
  let index = start;
  while (step(index) < quarter) index += 1;
  return [step(index), step(index + 1), step(index + 2)];
}
