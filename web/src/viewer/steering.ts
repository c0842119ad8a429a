// How the view is moved: by mouse and touch, by keys, and by flights to a place.
import { PerspectiveCamera, Spherical, Vector3 as Vector } from "three";
import { OrbitControls } from "three/examples/jsm/controls/OrbitControls.js";

const FLIGHT_MS = 800;
const KEY_TURN = Math.PI / 36;
const KEY_ZOOM = 0.85;

interface Flight {
  start: number | null;
  from: { position: Vector; target: Vector };
  to: { position: Vector; target: Vector };
}

export class Steering {
  readonly camera = new PerspectiveCamera(50, 1, 0.01, 100);
  private readonly controls: OrbitControls;
  private readonly still = matchMedia("(prefers-reduced-motion: reduce)");
  private flight: Flight | null = null;
  private near = 0.01;
  /** Whether people have moved the view since it was last put somewhere. */
  touched = false;

  /** `damped` to come to rest slowly; `onChange` is called when the view is about to move; `onHome` for the key that shows all. */
  constructor(
    private readonly canvas: HTMLCanvasElement,
    private readonly damped: boolean,
    private readonly onChange: () => void,
    private readonly onHome: () => void,
  ) {
    this.camera.position.set(0, 1, 2);
    this.controls = new OrbitControls(this.camera, canvas);
    this.controls.zoomToCursor = true;
    this.controls.dampingFactor = 0.12;
    this.controls.rotateSpeed = 0.8;
    this.controls.addEventListener("change", onChange);
    this.controls.addEventListener("start", this.cancel);
    canvas.addEventListener("wheel", this.cancel, { passive: true });
    canvas.addEventListener("keydown", this.onKey);
  }

  get target(): Vector {
    return this.controls.target;
  }

  get distance(): number {
    return this.camera.position.distanceTo(this.target);
  }

  private readonly cancel = (): void => {
    this.flight = null;
    this.touched = true;
  };

  /** Where the view may go: about a sphere of the scene. */
  bound(radius: number): void {
    this.near = radius / 2000;
    this.controls.minDistance = radius / 500;
    this.controls.maxDistance = radius * 20;
  }

  /** Move the view; at once where people wish no motion, or `jump`. */
  go(position: Vector, target: Vector, jump = false): void {
    this.flight = null;
    this.touched = false;
    if (jump || this.still.matches) {
      this.place(position, target);
    } else {
      const from = { position: this.camera.position.clone(), target: this.target.clone() };
      this.flight = { start: null, from, to: { position, target } };
    }
    this.onChange();
  }

  private place(position: Vector, target: Vector): void {
    this.camera.position.copy(position);
    this.controls.target.copy(target);
    // A movement under way would carry the view on from there.
    this.controls.enableDamping = false;
    this.controls.update();
  }

  /** Before a picture: move on. Returns whether something is still to move after it. */
  update(now: number): boolean {
    const flight = this.flight;
    if (flight !== null) {
      flight.start ??= now;
      const share = Math.min((now - flight.start) / FLIGHT_MS, 1);
      const eased = share * share * (3 - 2 * share);
      this.place(
        flight.from.position.clone().lerp(flight.to.position, eased),
        flight.from.target.clone().lerp(flight.to.target, eased),
      );
      if (share === 1) this.flight = null;
    } else {
      this.controls.enableDamping = this.damped && !this.still.matches;
      this.controls.update();
    }
    this.camera.near = Math.max(this.near, this.distance / 200);
    return this.flight !== null;
  }

  /** Say how far the scene reaches from its centre, so that all of it is within the view. */
  enclose(centre: Vector, radius: number): void {
    this.camera.far = this.camera.position.distanceTo(centre) + 4 * radius + this.camera.near;
    this.camera.updateProjectionMatrix();
  }

  private readonly onKey = (event: KeyboardEvent): void => {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const around = new Spherical().setFromVector3(this.camera.position.clone().sub(this.target));
    const { minDistance, maxDistance } = this.controls;
    if (event.key === "ArrowLeft") around.theta -= KEY_TURN;
    else if (event.key === "ArrowRight") around.theta += KEY_TURN;
    else if (event.key === "ArrowUp") around.phi -= KEY_TURN;
    else if (event.key === "ArrowDown") around.phi += KEY_TURN;
    else if (event.key === "+" || event.key === "=") around.radius *= KEY_ZOOM;
    else if (event.key === "-") around.radius /= KEY_ZOOM;
    else if (event.key !== "Home") return;
    event.preventDefault();
    if (event.key === "Home") {
      this.onHome();
      return;
    }
    around.radius = Math.min(Math.max(around.radius, minDistance), maxDistance);
    around.makeSafe();
    this.go(new Vector().setFromSpherical(around).add(this.target), this.target.clone(), true);
    this.touched = true;
  };

  dispose(): void {
    this.controls.dispose();
    this.canvas.removeEventListener("wheel", this.cancel);
    this.canvas.removeEventListener("keydown", this.onKey);
  }
}
