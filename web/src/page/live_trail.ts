// What was answered on a walk: a line to draw, and files for those who go on working with it.
import type { LocalizeResponse, Vector3 } from "visloc-client";
import { length, subtract } from "../geometry";

/** One answered frame. */
export interface TrailEntry {
  /** When the frame was taken: seconds since 1970. */
  timestamp: number;
  answer: LocalizeResponse;
}

// Points of the line, and frames kept for the files: hours at a few per second.
const MOST_DRAWN = 2000;
const MOST_KEPT = 50_000;

/** A row of the files; the rest of an answer is not kept. */
interface Row {
  timestamp: number;
  status: string;
  reason: string;
  inliers: number;
  position: number[];
  orientation: number[];
}

export class Trail {
  #rows: Row[] = [];
  #drawn: Vector3[] = [];

  /** @param step positions nearer than this to the last one drawn are not drawn. */
  constructor(readonly step: () => number) {}

  /** Take an answer; true when there is something new to draw. */
  add({ timestamp, answer }: TrailEntry): boolean {
    const { pose, refusal, status, inliers } = answer;
    const [position, orientation] = [pose?.position ?? [], pose?.orientation ?? []];
    const reason = refusal?.reason ?? "";
    this.#rows.push({ timestamp, status, reason, inliers, position, orientation });
    if (this.#rows.length > MOST_KEPT) this.#rows.shift();
    return pose !== null && this.#draw(pose.position as Vector3);
  }

  clear(): void {
    this.#rows = [];
    this.#drawn = [];
  }

  /** Positions of the line, oldest first. */
  get drawn(): readonly Vector3[] {
    return this.#drawn;
  }

  get frames(): number {
    return this.#rows.length;
  }

  /** A row for each frame; without a pose where there was none. */
  csv(): string {
    const header = "timestamp_s,status,reason,inliers,x,y,z,qw,qx,qy,qz";
    const rows = this.#rows.map((row) => {
      const numbers = row.position.length > 0 ? [...row.position, ...row.orientation] : NO_POSE;
      const { status, reason, inliers } = row;
      return [row.timestamp.toFixed(3), status, reason, inliers, ...numbers].join(",");
    });
    return [header, ...rows, ""].join("\n");
  }

  /** As trajectories are exchanged (TUM): world_from_cam, the quaternion with w last. */
  tum(): string {
    const rows = this.#rows
      .filter((row) => row.position.length > 0)
      .map(({ timestamp, position, orientation: [w, ...xyz] }) =>
        [timestamp.toFixed(3), ...position, ...xyz, w].join(" "),
      );
    return ["# timestamp tx ty tz qx qy qz qw", ...rows, ""].join("\n");
  }

  #draw(position: Vector3): boolean {
    const last = this.#drawn.at(-1);
    if (last !== undefined && length(subtract(position, last)) < this.step()) return false;
    this.#drawn.push(position);
    if (this.#drawn.length > MOST_DRAWN) this.#drawn.shift();
    return true;
  }
}

const NO_POSE: string[] = Array<string>(7).fill("");
