// Live: the frames of this device's camera, localized one after the other on a walk.
import { mapRef, type LocalizeResponse, type MapInfo } from "visloc-client";
import { element } from "../dom";
import { headingText, positionText } from "../earth";
import { lengthText } from "../geometry";
import { countText, counted } from "../words";
import type { PageContext } from "./context";
import { FIELD_OF_VIEW_DEG, FocalEstimates, chooseCamera, frameSize } from "./live_camera";
import { LiveFigures } from "./live_figures";
import type { Frame } from "./live_loop";
import { FrameReader, ScreenLock, namedCameras, openCamera, whyNoCamera } from "./live_media";
import { livePanel } from "./live_panel";
import { WalkingPrior } from "./live_prior";
import { LiveSession } from "./live_session";
import { Trail } from "./live_trail";
import { WalkView } from "./live_view";
import { sentence } from "./problem_view";
import { isSure, verdictOf } from "./shown_pose";
import "../style/live.css";

export interface LiveState {
  /** Frames are read and sent: neither off, nor waiting for a camera, a map or a hidden page. */
  readonly running: boolean;
  readonly answers: number;
  readonly localized: number;
  readonly refused: number;
  /** Frames that were not answered. */
  readonly errors: number;
  readonly inFlight: number;
  readonly maxInFlight: number;
  /** Answers per second over the last five. */
  readonly rate: number;
  /** From a frame to its answer, the last one; null before. */
  readonly latencyMs: number | null;
  readonly last: LocalizeResponse | null;
  readonly trailLength: number;
  readonly message: string;
}

export interface Live {
  readonly state: LiveState;
  /** `why` is told to the user. */
  stop(why?: string): void;
}

const ANNOUNCE_EVERY_MS = 5000;

// Of the diagonal of what the view shows of the map: what nobody sees as a step.
const STEP_SHARE = 1 / 2000;

/** Fill the tab; nothing asks for the camera before it is started. */
export function createLive(host: HTMLElement, context: PageContext): Live {
  const panel = livePanel();
  const reader = new FrameReader(panel.video, () => Number(panel.longest.value));
  const view = new WalkView(context.viewer);
  const screen = new ScreenLock();
  const figures = new LiveFigures();
  const prior = new WalkingPrior();
  const estimates = new FocalEstimates();
  const trail = new Trail(() => STEP_SHARE * Math.hypot(...(context.viewer.extent ?? [])));
  let last: LocalizeResponse | null = null;
  let failing = false;
  let announced = { outcome: "", at: -Infinity };
  const session = new LiveSession({
    map: () => context.map(),
    hidden: () => document.hidden,
    openCamera: () => openCamera(panel.camera.value),
    play,
    grab: (signal) => reader.grab(signal),
    localize,
    answered,
    failed(why) {
      figures.errors += 1;
      failing = true;
      session.say(why);
    },
    resumed: () => figures.resume(performance.now()),
    ended(why) {
      prior.forget();
      view.clear();
      context.announce(why);
    },
    changed: drawState,
  });

  function start(): void {
    const impossible = whyNoCamera(window);
    if (impossible !== null) return session.say(impossible);
    if (context.map() === null) return session.say("Choose a map first.");
    figures.clear();
    last = null;
    failing = false;
    context.walkBegins();
    void session.start();
  }

  function stop(why = `Stopped after ${counted(figures.answers, "answer")}.`): void {
    session.stop(why);
  }

  async function play(stream: MediaStream | null): Promise<void> {
    panel.video.srcObject = stream;
    if (stream === null) return screen.release();
    void screen.hold();
    drawState(); // shows the video: some browsers do not play a hidden one
    await panel.video.play().catch(() => undefined); // another stream came before it played
    await nameCameras();
  }

  // Frames and answers

  function localize(map: MapInfo, frame: Frame, signal: AbortSignal): Promise<LocalizeResponse> {
    const { camera } = chooseCamera(frame, context.camera, fieldOfViewGiven());
    const priors = panel.prior.checked && map.metric ? prior.at(frame.atMs) : undefined;
    const call = {
      map: mapRef(map), // the one whose landmarks are shown
      image: frame.jpeg,
      name: "frame.jpg",
      camera,
      options: { extraction: "fast", ...context.options() },
      ...(priors === undefined ? {} : { priors }),
    };
    return context.service.localize(call, signal);
  }

  function answered(answer: LocalizeResponse, frame: Frame): void {
    const now = performance.now();
    figures.answered(answer, frame.atMs, now);
    last = answer;
    failing = false;
    if (trail.add({ timestamp: frame.timestamp, answer })) {
      context.viewer.setTrail([...trail.drawn]);
    }
    estimates.add(answer);
    if (answer.pose === null) prior.refused();
    else prior.localized(answer.pose.position, frame.atMs);
    view.show(answer, panel.follow.checked);
    session.say(answerInWords(answer));
    const outcome = panel.status.textContent;
    if (outcome !== announced.outcome && now - announced.at > ANNOUNCE_EVERY_MS) {
      announced = { outcome, at: now };
      context.announce(outcome);
    }
  }

  // What is shown

  function drawState(): void {
    panel.message.textContent = session.message;
    panel.preview.hidden = !session.filming;
    panel.toggle.textContent = session.on ? "Stop" : "Start the camera";
    const [outcome, words] = outcomeWords();
    panel.status.dataset.outcome = outcome;
    panel.status.textContent = words;
    drawFigures();
    drawViewNote();
    const proposal = estimates.proposal();
    panel.useEstimate.hidden = proposal === null || fieldOfViewGiven() !== null;
    if (proposal !== null) {
      const { degrees, answers } = proposal;
      panel.useEstimate.textContent = `Use the ${degrees.toFixed(1)}° that ${answers} answers found`;
    }
    for (const button of [panel.clear, panel.csv, panel.tum]) button.disabled = trail.frames === 0;
  }

  function outcomeWords(): [outcome: string, words: string] {
    if (!session.on) return ["off", "Off"];
    if (!session.running) return ["off", "Paused"];
    if (failing) return ["failed", "No answer"];
    if (last === null) return ["off", "Starting"];
    if (last.pose === null) return ["refused", "I do not know"];
    return [isSure(last.pose) ? "localized" : "doubtful", verdictOf(last.pose).name];
  }

  function drawFigures(): void {
    const words = figures.inWords(performance.now());
    if (!session.running) words.rate = null;
    for (const name of ["rate", "latency", "server", "share"] as const) {
      panel.figures[name].textContent = words[name] ?? "–";
    }
  }

  function drawPriorNote(): void {
    const metric = context.map()?.metric ?? true;
    panel.prior.disabled = !metric;
    panel.priorNote.textContent = metric
      ? "Search only where one can have walked since: within 1 m and 2 m for each second. A pose " +
        "elsewhere is refused; after three refusals the whole map is searched again."
      : "Not with this map: it is not in metres, so that nobody knows how far a second's walk is.";
  }

  async function nameCameras(): Promise<void> {
    const known = new Set([...panel.camera.options].map((option) => option.value));
    for (const { id, label } of await namedCameras()) {
      if (!known.has(id)) panel.camera.append(element("option", { value: id }, label));
    }
  }

  // Choices

  function fieldOfViewGiven(): number | null {
    const degrees = panel.view.valueAsNumber;
    const { min, max } = FIELD_OF_VIEW_DEG;
    return degrees >= min && degrees <= max ? degrees : null; // NaN is neither
  }

  function drawViewNote(): void {
    const { videoWidth: width, videoHeight: height } = panel.video;
    const { min, max } = FIELD_OF_VIEW_DEG;
    const refused = panel.view.validity.badInput || panel.view.value !== "";
    const given = fieldOfViewGiven();
    panel.view.setAttribute("aria-invalid", String(refused && given === null));
    if (refused && given === null) {
      panel.viewNote.textContent = `A field of view is between ${min} and ${max} degrees.`;
    } else if (width > 0) {
      const frame = frameSize({ width, height }, Number(panel.longest.value));
      panel.viewNote.textContent = chooseCamera(frame, context.camera, given).message;
    } else {
      panel.viewNote.textContent =
        "Along the longer side of a frame: 60 to 75 of most phones. Left empty, the service " +
        "looks for the focal length with each pose: slower, and refused more often.";
    }
  }

  panel.toggle.addEventListener("click", () => (session.on ? stop() : start()));
  panel.camera.addEventListener("change", () => {
    // Another camera has another field of view.
    estimates.clear();
    panel.view.value = "";
    drawState();
    void session.reopen();
  });
  panel.view.addEventListener("input", drawState);
  panel.useEstimate.addEventListener("click", () => {
    panel.view.value = estimates.proposal()?.degrees.toFixed(1) ?? "";
    drawState();
    panel.view.focus(); // the button goes away
  });
  panel.prior.addEventListener("change", () => prior.forget());
  panel.clear.addEventListener("click", () => {
    trail.clear();
    context.viewer.setTrail([]);
    drawState();
  });
  panel.csv.addEventListener("click", () => save(trail.csv(), "text/csv", "csv"));
  panel.tum.addEventListener("click", () => save(trail.tum(), "text/plain", "txt"));

  function save(text: string, type: string, ending: string): void {
    const address = URL.createObjectURL(new Blob([text], { type }));
    element("a", { href: address, download: `trail-${context.map()?.id ?? ""}.${ending}` }).click();
    setTimeout(() => URL.revokeObjectURL(address), 60_000);
  }

  // What happens around

  context.onMapChange(() => {
    trail.clear();
    prior.forget();
    estimates.clear();
    figures.clear();
    last = null;
    drawPriorNote();
    drawState();
    session.resume();
  });
  document.addEventListener("visibilitychange", () => {
    if (document.hidden) return session.pause("Paused while the page is hidden.");
    if (session.filming) void screen.hold(); // the system took it away
    session.resume();
  });
  // Nobody is filmed who does not see it; and the 3D view is free for what the other tabs show.
  const tabLeft = (): void => void (host.hidden && stop("Stopped, because the tab was left."));
  new MutationObserver(tabLeft).observe(host, { attributeFilter: ["hidden"] });
  setInterval(() => session.running && drawFigures(), 500); // the rate falls while nothing comes

  session.say(
    whyNoCamera(window) ??
      "Frames of this device's camera are localized one after the other. Nothing is kept of them.",
  );
  drawPriorNote();
  host.append(panel.root);
  return {
    get state(): LiveState {
      return Object.freeze({
        running: session.running,
        answers: figures.answers,
        localized: figures.localized,
        refused: figures.answers - figures.localized,
        errors: figures.errors,
        inFlight: session.inFlight,
        maxInFlight: session.maxInFlight,
        rate: figures.rate(performance.now()),
        latencyMs: figures.latencyMs,
        last,
        trailLength: trail.drawn.length,
        message: session.message,
      });
    },
    stop,
  };
}

/** Why there is no pose, or how good it is. */
function answerInWords({
  pose,
  refusal,
  inliers,
  correspondences,
  geopose,
}: LocalizeResponse): string {
  if (pose === null) return sentence(refusal?.message ?? "no reason was given");
  const std = lengthText(Math.hypot(...pose.position_std), pose.metric === true, 2);
  const alone = pose.uncertainty === "photo only" ? " by scatter alone" : "";
  const sure = pose.probability === null ? "" : ` Probability ${pose.probability.toFixed(2)}.`;
  const agree = `${countText(inliers)} of ${countText(correspondences)} matches agree.`;
  const earth =
    geopose === null ? "" : ` On Earth ${positionText(geopose)}, heading ${headingText(geopose)}.`;
  return `± ${std}${alone}; ${agree}${sure}${earth}`;
}
