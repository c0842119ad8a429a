// The pose of a walk in the 3D view, and the view that goes along.
import type { LocalizeResponse } from "visloc-client";
import type { Viewer } from "../viewer/types";
import { shownPose } from "./shown_pose";

// A view that never rests cannot be looked at; and whoever turns it wants to look for themselves.
const FLY_EVERY_MS = 1500;
const HANDS_OFF_MS = 5000;
// What stands on the screen is taken for the present: an older pose goes when a frame is refused.
const POSE_SHOWN_MS = 3000;

export class WalkView {
  #shownAt = -Infinity;
  #flownAt = -Infinity;
  #handsOnAt = -Infinity;

  constructor(readonly viewer: Viewer) {
    const touched = ({ target }: Event): void => {
      if (target instanceof HTMLCanvasElement) this.#handsOnAt = performance.now();
    };
    for (const touch of ["pointerdown", "wheel", "keydown"]) {
      document.addEventListener(touch, touched, { passive: true, capture: true });
    }
  }

  /** @param follow whether the view goes along, unless somebody is turning it. */
  show(answer: LocalizeResponse, follow: boolean): void {
    const now = performance.now();
    const pose = shownPose(answer);
    if (pose === null) {
      if (now - this.#shownAt > POSE_SHOWN_MS) this.viewer.showPoses([]);
      return;
    }
    this.viewer.showPoses([pose]);
    this.#shownAt = now;
    const leftAlone = now - this.#handsOnAt > HANDS_OFF_MS;
    if (follow && leftAlone && now - this.#flownAt > FLY_EVERY_MS) {
      this.#flownAt = now;
      this.viewer.flyTo(pose);
    }
  }

  /** The walk is over: its last pose is past. */
  clear(): void {
    this.viewer.showPoses([]);
  }
}
