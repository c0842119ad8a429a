// Words and marks over the picture: the scale, the axes of the world, names of cameras, messages.
import { Quaternion, Vector3 as Vector, type Camera } from "three";
import { element } from "../dom";
import { lengthText, niceLength } from "../geometry";

const SVG = "http://www.w3.org/2000/svg";
const GIZMO_RADIUS = 22;

export class Overlay {
  private readonly bar = element("span", { class: "viewer-scale-bar" });
  private readonly barText = element("span");
  private readonly scale = element("div", { class: "viewer-scale" }, this.bar, this.barText);
  private readonly tooltip = element("div", { class: "viewer-tooltip", hidden: true });
  private readonly notice = element("div", { class: "viewer-notice", role: "alert", hidden: true });
  private readonly gizmo = document.createElementNS(SVG, "svg");
  private readonly axes = ["X", "Y", "Z"].map((name) => {
    const line = document.createElementNS(SVG, "line");
    const text = document.createElementNS(SVG, "text");
    text.textContent = name;
    const axis = document.createElementNS(SVG, "g");
    axis.classList.add(`viewer-axis-${name.toLowerCase()}`);
    axis.append(line, text);
    return { axis, line, text };
  });
  private shownScale = "";

  constructor(host: HTMLElement) {
    this.gizmo.setAttribute("viewBox", "-32 -32 64 64");
    this.gizmo.classList.add("viewer-gizmo");
    // What they say is in the label of the canvas.
    for (const part of [this.gizmo, this.scale, this.tooltip]) {
      part.setAttribute("aria-hidden", "true");
    }
    this.gizmo.append(...this.axes.map(({ axis }) => axis));
    host.append(this.scale, this.gizmo, this.tooltip, this.notice);
  }

  /** Show how long a bar of at most 120 px is where the view turns about. */
  setScale(unitsPerPixel: number, metric: boolean): void {
    const length = niceLength(120 * unitsPerPixel);
    const width = `${(length / unitsPerPixel).toFixed(0)}px`;
    const text = lengthText(length, metric);
    if (this.shownScale === width + text) return;
    this.shownScale = width + text;
    this.bar.style.width = width;
    this.barText.textContent = text;
  }

  setAxes(sceneFromWorld: Quaternion, camera: Camera): void {
    const view = camera.quaternion.clone().invert().multiply(sceneFromWorld);
    const ends = [new Vector(1, 0, 0), new Vector(0, 1, 0), new Vector(0, 0, 1)];
    ends.forEach((end, i) => {
      end.applyQuaternion(view);
      const { line, text } = this.axes[i]!;
      line.setAttribute("x2", (GIZMO_RADIUS * end.x).toFixed(1));
      line.setAttribute("y2", (-GIZMO_RADIUS * end.y).toFixed(1));
      text.setAttribute("x", ((GIZMO_RADIUS + 6) * end.x).toFixed(1));
      text.setAttribute("y", (-(GIZMO_RADIUS + 6) * end.y).toFixed(1));
    });
  }

  /** Show a name beside a place of the picture, on the side that has room; null takes it away. */
  showName(name: string | null, x = 0, y = 0, width = 0): void {
    this.tooltip.hidden = name === null;
    if (name === null) return;
    this.tooltip.textContent = name;
    this.tooltip.style.transform = `translate(calc(${x}px ${x > width / 2 ? "- 100% - 24px" : ""}), ${y}px)`;
  }

  /** A message over the picture; null takes it away. */
  tell(message: string | null): void {
    this.notice.hidden = message === null;
    this.notice.textContent = message;
  }
}
