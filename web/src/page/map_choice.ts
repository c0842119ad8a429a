// Which map is shown: the list of them, the choice, and the address that links to it.
import { mapRef, ServiceError, type Client, type MapInfo } from "visloc-client";
import { shortRef } from "../words";
import { element } from "../dom";
import { instantText } from "../words";

/** What came of the wish to see a map. */
export type Choice =
  | { kind: "asking" }
  | { kind: "no_maps" }
  | { kind: "problem"; error: ServiceError }
  | { kind: "map"; map: MapInfo };

export interface MapChoice {
  /** All that the service listed. */
  readonly maps: readonly MapInfo[];
  /** Choose a map: an id or `id@version`. */
  choose(ref: string): void;
  /** Ask for the list again, and keep the choice where it still exists. */
  reload(): void;
}

// While the service starts; it says itself how long when it is busy.
const ASK_AGAIN_MS = 3000;

/** Let `select` and the address choose; `onChoice` is told what came of it. */
export function createMapChoice(
  select: HTMLSelectElement,
  service: Client,
  onChoice: (choice: Choice) => void,
): MapChoice {
  let maps: MapInfo[] = [];
  let chosen: MapInfo | null = null;
  let asking = new AbortController();
  let askAgain = 0;

  /**
   * Do the newest thing only: what was being asked before is given up.
   *
   * @param quietly it was asked before, and the service was busy: that need not be said again.
   */
  async function attempt(
    ask: (signal: AbortSignal) => Promise<Choice>,
    quietly = false,
  ): Promise<void> {
    asking.abort();
    clearTimeout(askAgain);
    const { signal } = (asking = new AbortController());
    if (!quietly) onChoice({ kind: "asking" });
    let choice: Choice;
    try {
      choice = await ask(signal);
    } catch (error) {
      if (signal.aborted) return;
      if (!(error instanceof ServiceError)) throw error;
      choice = { kind: "problem", error };
      const { status } = error.problem;
      if (status === 503 || status === 429) {
        const wait = (error.retryAfterSeconds ?? 0) * 1000;
        const again = (): void => void attempt(ask, true);
        askAgain = window.setTimeout(again, Math.max(wait, ASK_AGAIN_MS));
        if (quietly && !signal.aborted) return;
      }
    }
    if (signal.aborted) return;
    chosen = choice.kind === "map" ? choice.map : null;
    // A link to a pose stays as it is while its map is shown.
    if (chosen !== null && ![shortRef(chosen), mapRef(chosen)].includes(refOfHash() ?? "")) {
      history.replaceState(null, "", hashOf(shortRef(chosen)));
    }
    fill();
    onChoice(choice);
  }

  // Described anew: another version may be current since the list came.
  const choose = (ref: string): Promise<void> =>
    attempt(async (signal) => ({ kind: "map", map: await service.map(ref, signal) }));

  const reload = (): void =>
    void attempt(async (signal) => {
      maps = await service.maps(signal);
      fill();
      const ref = refOfHash() ?? (chosen === null ? maps[0]?.id : shortRef(chosen));
      if (ref === undefined) return { kind: "no_maps" };
      return { kind: "map", map: await service.map(ref, signal) };
    });

  function fill(): void {
    const options = maps.flatMap((map) => [
      element("option", { value: map.id }, map.id),
      ...map.versions
        .filter((other) => !other.current)
        .reverse() // the newest first
        .map(({ version }) =>
          element(
            "option",
            { value: `${map.id}@${version}` },
            `${map.id} · ${versionText(version)}`,
          ),
        ),
    ]);
    const value = chosen === null ? "" : shortRef(chosen);
    if (!options.some((option) => option.value === value)) {
      // None is chosen, or one that was published since the list came.
      options.unshift(element("option", { value }, chosen === null ? "Choose a map" : value));
    }
    select.replaceChildren(...options);
    select.value = value;
    select.disabled = maps.length === 0;
  }

  select.addEventListener("change", () => {
    if (select.value !== "") void choose(select.value);
  });
  addEventListener("hashchange", () => {
    const ref = refOfHash();
    if (ref === null) return;
    if (chosen !== null && [shortRef(chosen), mapRef(chosen)].includes(ref)) return;
    // While the list is still being asked for, that goes on to the choice.
    if (maps.length === 0) reload();
    else void choose(ref);
  });
  return {
    get maps() {
      return maps;
    },
    choose: (ref) => void choose(ref),
    reload,
  };
}

/** `#map=id` or `#map=id@version`. */
export function hashOf(ref: string): string {
  return `#map=${encodeURIComponent(ref).replaceAll("%40", "@")}`;
}

function refOfHash(): string | null {
  return new URLSearchParams(location.hash.slice(1)).get("map") || null;
}

/** Versions begin with the instant at which they were built; others are as they are. */
function versionText(version: string): string {
  const parts = /^(\d{4})(\d\d)(\d\d)T(\d\d)(\d\d)(\d\d)\.\d+Z-/.exec(version);
  if (parts === null) return version;
  const [, year, month, day, hour, minute, second] = parts;
  return instantText(`${year}-${month}-${day}T${hour}:${minute}:${second}Z`);
}
