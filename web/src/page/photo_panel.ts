// The tab "Photo": photos come in, are asked about one after the other, and their answers shown.
import {
  mapRef,
  ownError,
  type Camera,
  type LocalizeResponse,
  type MapInfo,
  type Problem,
  type Client,
} from "visloc-client";
import { button, byId, element } from "../dom";
import type { ShownPose, Viewer } from "../viewer/types";
import { answerView, inShort } from "./answer_view";
import { createCameraForm } from "./camera_form";
import { jpegHeader } from "./jpeg_header";
import { createMapsForm } from "./maps_form";
import { createOptionsForm } from "./options_form";
import { createPhotoQueue, questionOf, type Entry, type Wish } from "./photo_queue";
import { problemView } from "./problem_view";
import type { SharedPose } from "./share";
import { damagedLink, sharedView } from "./shared_view";
import { isSure, shownPlaces } from "./shown_pose";
import { countText } from "../words";

export interface PhotoPanelParts {
  service: Client;
  server: URL;
  viewer: Viewer;
  map(): MapInfo | null;
  /** All that the service lists. */
  maps(): readonly MapInfo[];
  hasKey(): boolean;
  /** Ask for another API key than the one that was refused so. */
  askForKey(problem: Problem): void;
  /** Choose the map of an answer: an id or `id@version`. */
  chooseMap(ref: string): void;
  /** Look which maps there are. */
  reloadMaps(): void;
  announce(text: string): void;
  /** Bring this tab to the front. */
  open(): void;
  /** A photo is about to be drawn: a walk is not any more. */
  beforeDrawing(): void;
  /** The pose of a link is not shown any more. */
  linkLeft(): void;
}

export interface PhotoPanel {
  camera(): Camera | null;
  options(): Record<string, string | number>;
  add(photos: { photo: Blob; name: string }[]): void;
  /** Another map is shown: what was drawn of a photo is gone. */
  mapChanged(): void;
  /** Landmarks of the map that is shown are drawn: the view may go to a pose. */
  mapDrawn(): void;
  /** Show the pose of a link instead of a photo; in its map, as soon as that is shown. */
  showShared(pose: SharedPose | "damaged"): void;
  /** Draw no photo, until somebody asks about one or chooses one. */
  undraw(): void;
  /** Another key was given: ask again what failed for the lack of one. */
  keyChanged(): void;
  /** Of the photo that is shown, or was asked about last. */
  readonly answer: LocalizeResponse | null;
  readonly problem: Problem | null;
}

export function createPhotoPanel(host: HTMLElement, parts: PhotoPanelParts): PhotoPanel {
  const { viewer, announce } = parts;
  const camera = createCameraForm();
  const options = createOptionsForm(parts.service);
  const maps = createMapsForm();
  const list = element("ul", { class: "photos" });
  const listHead = element("h2", { class: "small" });
  const listing = element("section", { class: "stack near", hidden: true });
  listing.append(
    element(
      "div",
      { class: "row" },
      listHead,
      element("span", { class: "gap" }),
      button("Clear", clear, { class: "link" }),
    ),
    list,
  );
  const shown = element("div", { class: "shown" });
  const photoView = byId("photo-view", HTMLButtonElement);
  let selected: Entry | null = null;
  /** Show each answer as it comes, until another photo is clicked. */
  let follow = true;
  let drawing = true;
  let drawn: ShownPose[] = [];
  /** What a link told, while no photo is looked at. */
  let shared: SharedPose | null = null;
  let flyToShared = false;

  const queue = createPhotoQueue(parts.service, parts.hasKey, (entry) => {
    if (entry.state === "running" && follow && shared === null) selected = entry;
    fillList();
    if (entry !== selected) return;
    if (entry.answer !== null) announce(`${entry.name}: ${inShort(entry.answer)}`);
    else if (entry.error !== null) announce(`${entry.name}: ${entry.error.problem.detail}`);
    show(entry, true);
    if (entry.state === "answered" || entry.state === "failed") reveal();
  });

  const chooser = element("input", { id: "photo-files", type: "file", multiple: true });
  // What the service reads. Offered only these, phones hand out their HEIC photos as JPEG.
  chooser.accept = "image/jpeg,image/png,image/webp,image/tiff,image/bmp";
  chooser.classList.add("unseen");
  chooser.addEventListener("change", () => {
    add([...(chooser.files ?? [])].map((file) => ({ photo: file, name: file.name })));
    chooser.value = ""; // the same file may be chosen again
  });
  host.append(
    element(
      "div",
      { class: "stack" },
      element(
        "div",
        { class: "intake" },
        chooser,
        element("label", { for: "photo-files", class: "button primary" }, "Choose photos"),
        element("p", { class: "quiet" }, "or drop or paste them"),
      ),
      element("div", { class: "settings" }, camera.element, maps.element, options.element),
      listing,
      shown,
    ),
  );

  function wish(): Wish {
    const map = parts.map();
    if (map === null) {
      throw ownError("page.map", "No map is chosen", "choose a map first");
    }
    return {
      ...{ map, others: maps.others(), debug: !sparesData() },
      ...{ camera: camera.camera(), options: options.options() },
    };
  }

  function add(photos: { photo: Blob; name: string }[]): void {
    if (photos.length === 0) return;
    parts.open();
    startDrawing();
    follow = true;
    const entries = photos.map(({ photo, name }) => queue.add(photo, name, wish));
    if (entries[0]!.state === "failed") select(entries[0]!);
    camera.sent();
    void suggestSize(photos[0]!.photo);
    announce(photos.length === 1 ? `Asking about ${photos[0]!.name}` : `${photos.length} photos`);
  }

  async function suggestSize(photo: Blob): Promise<void> {
    try {
      const size = await jpegHeader(photo);
      if (size !== null) camera.suggestSize(size.width, size.height);
    } catch (error) {
      if (!(error instanceof DOMException)) throw error; // who asks about it says so
    }
  }

  /** Photos are what the 3D view is for now. */
  function startDrawing(): void {
    leaveShared();
    parts.beforeDrawing();
    drawing = true;
  }

  function leaveShared(): void {
    if (shared === null) return;
    shared = null;
    parts.linkLeft();
  }

  /** The numbers of a link, and its pose where its map is shown. */
  function fillShared(pose: SharedPose, fly: boolean): void {
    const map = parts.map();
    const here = map !== null && mapRef(map) === pose.map;
    shown.replaceChildren(
      sharedView(pose, {
        metric: map?.metric ?? true,
        chooseMap: here || map === null ? null : () => parts.chooseMap(pose.map),
      }),
    );
    if (!drawing) return;
    drawn = here ? [{ ...pose.shown, fromLink: true }] : [];
    viewer.showPoses(drawn);
    viewer.highlight(new Set());
    photoView.hidden = !here;
    if (fly) flyTo(0);
  }

  function again(entry: Entry, wanted: () => Wish = wish): void {
    startDrawing();
    selected = entry;
    queue.again(entry, wanted);
  }

  function clear(): void {
    queue.clear();
    selected = null;
    leaveShared();
    fillList();
    shown.replaceChildren();
    draw(null);
    chooser.focus(); // the button is hidden now
  }

  function select(entry: Entry): void {
    selected = entry;
    fillList();
    show(entry, true);
  }

  /** Where the panel is low, as on a phone, the answer may be below what is seen of it. */
  function reveal(): void {
    const { top, height } = host.getBoundingClientRect();
    if (shown.getBoundingClientRect().top - top > height / 2) listing.scrollIntoView();
  }

  function fillList(): void {
    const { entries } = queue;
    listing.hidden = entries.length === 0;
    listHead.textContent = entries.length === 1 ? "Photo" : `${entries.length} photos`;
    // The focus stays on the photo that had it.
    const focused = document.activeElement?.closest<HTMLElement>("[data-entry]")?.dataset["entry"];
    list.replaceChildren(
      ...entries.map((entry) => {
        const line = button("", () => {
          follow = false;
          startDrawing();
          select(entry);
        });
        line.dataset["entry"] = String(entry.id);
        line.append(
          element("span", { class: "name" }, entry.name),
          element("span", { class: "quiet" }, stateWords(entry)),
        );
        line.dataset["state"] = outcome(entry);
        if (entry === selected) line.setAttribute("aria-current", "true");
        return element("li", {}, line);
      }),
    );
    if (focused !== undefined) {
      list.querySelector<HTMLElement>(`[data-entry="${focused}"]`)?.focus();
    }
  }

  function show(entry: Entry, fly: boolean): void {
    const focused = shown.contains(document.activeElement);
    fill(entry, fly);
    // What had the focus, such as "Ask again", is gone.
    if (!focused) return;
    const head = shown.querySelector<HTMLElement>("h2, .asking");
    head?.setAttribute("tabindex", "-1");
    head?.focus({ preventScroll: true });
  }

  function fill(entry: Entry, fly: boolean): void {
    const { answer, error } = entry;
    if (answer !== null && entry.wish !== null) {
      const asked = entry.wish;
      shown.replaceChildren(
        answerView(entry, answer, {
          options: entry.wish.options,
          chooseMap: isShown(answer) ? null : () => parts.chooseMap(mapRef(answer.map)),
          question: questionOf(entry, entry.wish, parts.server),
          announce,
          highlight: (image) =>
            viewer.highlight(image === null ? retrievedOf(answer) : new Set([image])),
          lookAt: isShown(answer)
            ? (place) => {
                startDrawing();
                draw(answer);
                flyTo(place);
              }
            : null,
          takeCamera: () => {
            const { model, width, height, params } = answer.camera;
            camera.set({ model, width, height, params });
            announce("The camera of this answer is used for what is asked from now on");
          },
          fetchMatches:
            answer.debug === null ? () => again(entry, () => ({ ...asked, debug: true })) : null,
          again: () => again(entry),
        }),
      );
      draw(isShown(answer) ? answer : null, fly);
      return;
    }
    draw(null);
    if (error !== null) {
      if (error.problem.code.startsWith("camera.")) camera.open();
      if (error.problem.code.startsWith("options.")) options.open();
      const giveKey = (): void => parts.askForKey(error.problem);
      const actions = { giveKey, reloadMaps: parts.reloadMaps, again: () => again(entry) };
      shown.replaceChildren(problemView(error, actions));
    } else {
      shown.replaceChildren(waiting(entry));
    }
  }

  /** Whether the answer is of the map that is shown. */
  function isShown(answer: LocalizeResponse): boolean {
    const map = parts.map();
    return map !== null && mapRef(map) === mapRef(answer.map);
  }

  function draw(answer: LocalizeResponse | null, fly = false): void {
    if (!drawing) return;
    drawn = answer === null ? [] : shownPlaces(answer);
    viewer.showPoses(drawn);
    viewer.highlight(answer === null ? new Set() : retrievedOf(answer));
    const isPlaced = answer?.pose != null || answer?.coarse != null;
    photoView.hidden = !isPlaced;
    if (!fly) return;
    // Of a refused photo, where it was looked for.
    if (isPlaced) flyTo(0);
    else if (answer !== null) viewer.overview();
  }
  function flyTo(place: number): void {
    const pose = drawn[place];
    if (pose !== undefined) viewer.flyTo(pose);
  }
  photoView.addEventListener("click", () => flyTo(0));

  return {
    camera: camera.camera,
    options: options.options,
    add,
    mapChanged() {
      camera.offer(parts.map()?.cameras ?? {});
      maps.fill(parts.maps(), parts.map());
      if (shared !== null) fillShared(shared, false);
      else if (selected !== null) show(selected, false);
    },
    mapDrawn() {
      if (!flyToShared || shared === null || drawn.length === 0) return;
      flyToShared = false;
      flyTo(0);
    },
    showShared(pose) {
      shared = null; // the address is that of the new link already
      parts.open();
      startDrawing();
      selected = null;
      fillList();
      if (pose === "damaged") {
        draw(null);
        shown.replaceChildren(damagedLink());
        announce("This link is damaged");
        return;
      }
      [shared, flyToShared] = [pose, true];
      fillShared(pose, true);
      announce("The pose of a link");
    },
    undraw() {
      draw(null);
      drawing = false;
    },
    keyChanged() {
      if (!parts.hasKey()) return;
      for (const entry of queue.entries) {
        const status = entry.error?.problem.status;
        if (status === 401 || status === 403) queue.again(entry, wish);
      }
    },
    get answer() {
      return selected?.answer ?? null;
    },
    get problem() {
      return selected?.error?.problem ?? null;
    },
  };
}

function retrievedOf(answer: LocalizeResponse): Set<string> {
  return new Set(answer.retrieved.map(({ image }) => image));
}

/** A phone, or whoever asks to save data, gets no megabyte that nobody wished for. */
function sparesData(): boolean {
  const { connection } = navigator as { connection?: { saveData?: boolean } };
  return connection?.saveData === true || matchMedia("(pointer: coarse)").matches;
}

type Outcome = "waiting" | "running" | "localized" | "doubtful" | "refused" | "failed";

function outcome(entry: Entry): Outcome {
  if (entry.state !== "answered") return entry.state;
  const pose = entry.answer?.pose ?? null;
  if (pose === null) return "refused";
  return isSure(pose) ? "localized" : "doubtful";
}

function stateWords(entry: Entry): string {
  const words = {
    waiting: entry.waitSeconds === null ? "waits" : `waits ${waitText(entry)}: service is busy`,
    running: "is asked …",
    failed: "error",
    refused: "not localized",
  };
  const state = outcome(entry);
  const inliers = `${countText(entry.answer?.inliers ?? 0)} inliers`;
  if (state === "localized") return inliers;
  return state === "doubtful" ? `in doubt, ${inliers}` : words[state];
}

function waiting(entry: Entry): HTMLElement {
  const text =
    entry.waitSeconds === null
      ? `Asking the service about ${entry.name} …`
      : `The service is busy: ${entry.name} is asked about again in ${waitText(entry)}.`;
  return element("p", { class: "quiet asking" }, text);
}

/** As long as the service asked for, when it last did. */
function waitText({ waitSeconds }: Entry): string {
  return `${Math.ceil(waitSeconds ?? 0)} s`;
}
