// Where a walker can be by now: the last pose as a prior of the next frame (docs/api.md, priors).

/** A sphere in the world, as POST /localize takes it. */
export interface PositionPrior {
  position: { position: number[]; radius: number };
}

// How far a person gets, metres: the pose's own error and the swing of an arm at once, then a
// brisk walk. A sphere that is too tight refuses right poses; a generous one costs little.
const SLACK_M = 1;
const SPEED_M_PER_S = 2;
// So many refusals in a row, and the prior may be what is wrong.
const MOST_REFUSALS = 3;

/**
 * Remembers the last position for as long as it can be believed. A position and not the whole pose:
 * people turn around faster than they walk, and a position prior leaves the direction open.
 */
export class WalkingPrior {
  #last: { position: number[]; atMs: number } | null = null;
  #refusals = 0;

  /** @param position in metres; @param atMs when the frame was taken. */
  localized(position: number[], atMs: number): void {
    this.#last = { position, atMs };
    this.#refusals = 0;
  }

  /** After some in a row the place is looked for without it, until there is a new pose. */
  refused(): void {
    this.#refusals += 1;
    if (this.#refusals >= MOST_REFUSALS) this.forget();
  }

  forget(): void {
    this.#last = null;
    this.#refusals = 0;
  }

  /** What can be said of a frame taken at `atMs`; undefined when nothing. */
  at(atMs: number): PositionPrior | undefined {
    if (this.#last === null) return undefined;
    const seconds = Math.max(0, atMs - this.#last.atMs) / 1000;
    const radius = SLACK_M + SPEED_M_PER_S * seconds;
    return { position: { position: this.#last.position, radius } };
  }
}
