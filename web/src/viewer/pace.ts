// How much to draw so that the view stays fluid, and how fluid it was.

const LONGEST_MS = 45;
const AIM_MS = 38;
const SHORT_MS = 28;
const FEWEST_POINTS = 20_000;
const MOST_POINTS = 16_000_000;
// Pictures further apart than this belong to two movements.
const PAUSE_MS = 300;

/**
 * Learns from the time between pictures of a movement how many points one may have.
 *
 * A picture is late by what was drawn for the one before, so a single long one says little: halve
 * at most, and grow slowly.
 */
export class Pace {
  private moving: number[] = [];

  /** `points` fit into one picture, for all that is known. */
  constructor(public points: number) {}

  /** A picture begins in which the view has moved, after one of `drawn` points. */
  moved(now: number, drawn: number): void {
    const before = this.moving.at(-1);
    if (before !== undefined && now - before > PAUSE_MS && now - before > 3 * this.usual) {
      this.moving = [];
    } else if (before !== undefined) {
      this.learn(now - before, drawn);
    }
    this.moving.push(now);
    while (this.moving.length > 3 && now - this.moving[0]! > 1000) this.moving.shift();
  }

  private learn(milliseconds: number, drawn: number): void {
    if (milliseconds > LONGEST_MS) {
      const share = Math.max(AIM_MS / milliseconds, 0.5);
      this.points = Math.max(FEWEST_POINTS, Math.min(this.points, drawn) * share);
    } else if (milliseconds < SHORT_MS && drawn >= 0.9 * this.points) {
      this.points = Math.min(MOST_POINTS, this.points * 1.2);
    }
  }

  private get usual(): number {
    return 1000 / (this.framesPerSecond ?? Infinity);
  }

  /** Of the last second in which the view moved; null before. */
  get framesPerSecond(): number | null {
    if (this.moving.length < 3) return null;
    return ((this.moving.length - 1) * 1000) / (this.moving.at(-1)! - this.moving[0]!);
  }
}
