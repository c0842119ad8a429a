// Live: the frames of this device's camera, localized one after the other on a walk.
import { mapRef, type LocalizeResponse, type MapInfo } from "../api";
import { element } from "../dom";
import { lengthText } from "../geometry";
import type { PageContext } from "./context";
import { FIELD_OF_VIEW_DEG, FocalEstimates, chooseCamera, frameSize } from "./live_camera";
import { LiveFigures } from "./live_figures";
import { localizeFrames, pause, type Frame } from "./live_loop";
import {
  FrameReader,
  ScreenLock,
  cameraProblem,
  namedCameras,
  openCamera,
  whyNoCamera,
} from "./live_media";
import { livePanel } from "./live_panel";
import { WalkingPrior } from "./live_prior";
import { Trail } from "./live_trail";
import { WalkView } from "./live_view";
import { countText } from "./words";
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
  stop(): void;
}

const ANNOUNCE_EVERY_MS = 5000;

// Of the map's diagonal: what nobody sees as a step.
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
  const trail = new Trail(() => STEP_SHARE * diagonal(context.map()));
  const requests = { inFlight: 0, maxInFlight: 0 };
  let last: LocalizeResponse | null = null;
  let message = "";
  // Started by the user; its signal ends with it. Null when off.
  let session: AbortController | null = null;
  let stream: MediaStream | null = null;
  // Within a session: one run of the loop; paused between runs.
  let run: AbortController | null = null;
  let ended = Promise.resolve();
  let opening = 0; // counts, so that a camera that comes after another was chosen is closed again
  let failing = false;
  let announced = { outcome: "", at: -Infinity };

  // Starting and stopping

  async function start(): Promise<void> {
    const impossible = whyNoCamera(window);
    if (impossible !== null) return say(impossible);
    if (context.map() === null) return say("Choose a map first.");
    const started = (session = new AbortController());
    figures.clear();
    requests.maxInFlight = 0;
    last = null;
    failing = false;
    say("Waiting for the camera…");
    drawState();
    if (await openStream(started.signal)) {
      void screen.hold();
      resume();
    }
  }

  /** Open the chosen camera; false when that failed, or it is no longer wanted. */
  async function openStream(signal: AbortSignal): Promise<boolean> {
    closeStream();
    const mine = (opening += 1);
    const unwanted = (): boolean => signal.aborted || mine !== opening;
    let opened: MediaStream;
    try {
      opened = await openCamera(panel.camera.value);
    } catch (error) {
      // Only getUserMedia was asked; not all browsers derive its OverconstrainedError from Error.
      if (!unwanted()) stop(cameraProblem(error as Error));
      return false;
    }
    if (unwanted()) {
      close(opened);
      return false;
    }
    stream = opened;
    for (const track of stream.getTracks()) {
      track.addEventListener("ended", () => stop("The camera was taken away."));
    }
    panel.video.srcObject = stream;
    drawState(); // shows the video: some browsers do not play a hidden one
    await panel.video.play().catch(() => undefined); // another stream came before it played
    await nameCameras();
    return !unwanted();
  }

  function closeStream(): void {
    if (stream !== null) close(stream);
    stream = null;
    panel.video.srcObject = null;
  }

  function stop(why = `Stopped after ${figures.answers} answers.`): void {
    if (session === null) return;
    session.abort();
    session = null;
    interrupt();
    closeStream();
    screen.release();
    prior.forget();
    say(why);
    drawState();
    context.announce(why);
  }

  /** End the run, and with it the request that is under way. */
  function interrupt(): void {
    run?.abort();
    run = null;
  }

  /** Begin a run, unless something is missing; the one before has ended by then. */
  function resume(): void {
    interrupt();
    if (session === null || stream === null) return;
    if (document.hidden) return;
    const map = context.map();
    if (map === null) return say("Choose a map to go on.");
    const begun = (run = new AbortController());
    figures.resume(performance.now());
    say(`Looking for this place in ${map.id}…`);
    drawState();
    ended = ended.then(() => walk(map, begun.signal));
  }

  async function walk(map: MapInfo, signal: AbortSignal): Promise<void> {
    const ask = (frame: Frame, limited: AbortSignal): Promise<LocalizeResponse> =>
      counted(() => localize(map, frame, limited));
    const grab = (limited: AbortSignal): Promise<Frame> => reader.grab(limited);
    try {
      const why = await localizeFrames({ grab, ask, answered, failed, wait: pause }, signal);
      if (why !== null) stop(why);
    } catch (error) {
      stop(`Stopped by a mistake of this page: ${String(error)}`);
      reportError(error);
    }
  }

  // Frames and answers

  async function counted<Answer>(ask: () => Promise<Answer>): Promise<Answer> {
    requests.inFlight += 1;
    requests.maxInFlight = Math.max(requests.maxInFlight, requests.inFlight);
    try {
      return await ask();
    } finally {
      requests.inFlight -= 1;
    }
  }

  function localize(map: MapInfo, frame: Frame, signal: AbortSignal): Promise<LocalizeResponse> {
    const { camera } = chooseCamera(frame, context.camera(), fieldOfViewGiven());
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
    say(answerInWords(answer, context.map()?.metric ?? true));
    drawState();
    const outcome = panel.status.textContent;
    if (outcome !== announced.outcome && now - announced.at > ANNOUNCE_EVERY_MS) {
      announced = { outcome, at: now };
      context.announce(outcome);
    }
  }

  function failed(why: string): void {
    figures.errors += 1;
    failing = true;
    say(why);
    drawState();
  }

  // What is shown

  function say(text: string): void {
    message = text;
    panel.message.textContent = text;
  }

  function drawState(): void {
    panel.preview.hidden = stream === null;
    panel.toggle.textContent = session === null ? "Start the camera" : "Stop";
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
    if (session === null) return ["off", "Off"];
    if (run === null) return ["off", "Paused"];
    if (failing) return ["failed", "No answer"];
    if (last === null) return ["off", "Starting"];
    return last.pose === null ? ["refused", "I do not know"] : ["localized", "Localized"];
  }

  function drawFigures(): void {
    const words = figures.inWords(performance.now());
    if (run === null) words.rate = null;
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
      panel.viewNote.textContent = chooseCamera(frame, context.camera(), given).message;
    } else {
      panel.viewNote.textContent =
        "Along the longer side of a frame: 60 to 75 of most phones. Left empty, the service " +
        "looks for the focal length with each pose: slower, and refused more often.";
    }
  }

  panel.toggle.addEventListener("click", () => (session === null ? void start() : stop()));
  panel.camera.addEventListener("change", () => {
    // Another camera has another field of view.
    estimates.clear();
    panel.view.value = "";
    drawState();
    if (session === null) return;
    const { signal } = session;
    interrupt();
    void openStream(signal).then((opened) => opened && resume());
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
    resume();
    drawState();
  });
  document.addEventListener("visibilitychange", () => {
    if (session === null) return;
    if (!document.hidden) {
      void screen.hold(); // the system took it away
      return resume();
    }
    interrupt();
    say("Paused while the page is hidden.");
    drawState();
  });
  setInterval(() => run !== null && drawFigures(), 500); // the rate falls while nothing comes

  say(
    whyNoCamera(window) ??
      "Frames of this device's camera are localized one after the other. Nothing is kept of them.",
  );
  drawState();
  drawPriorNote();
  host.append(panel.root);
  return {
    get state(): LiveState {
      return Object.freeze({
        running: run !== null,
        answers: figures.answers,
        localized: figures.localized,
        refused: figures.answers - figures.localized,
        errors: figures.errors,
        ...requests,
        rate: figures.rate(performance.now()),
        latencyMs: figures.latencyMs,
        last,
        trailLength: trail.drawn.length,
        message,
      });
    },
    stop: () => stop(),
  };
}

/** Why there is no pose, or how good it is. */
function answerInWords(
  { pose, refusal, inliers, correspondences }: LocalizeResponse,
  metric: boolean,
) {
  if (pose === null) {
    const why = refusal?.message ?? "No reason was given";
    return why.charAt(0).toUpperCase() + why.slice(1) + (why.endsWith("?") ? "" : ".");
  }
  const std = lengthText(Number(Math.hypot(...pose.position_std).toPrecision(2)), metric);
  return `± ${std}; ${countText(inliers)} of ${countText(correspondences)} matches agree.`;
}

function close(stream: MediaStream): void {
  for (const track of stream.getTracks()) track.stop();
}

/** Of the box around the map's landmarks. */
function diagonal(map: MapInfo | null): number {
  if (map === null) return 0;
  const { min, max } = map.extent;
  return Math.hypot(...max.map((end, axis) => end - (min[axis] ?? end)));
}
