// Which maps are searched beside the one that is shown.
import type { MapInfo } from "visloc-client";
import { element } from "../dom";
import { counted, shortRef } from "../words";

/** The service searches no more at once; the map that is shown is one of them. */
export const MAX_OTHERS = 15;
/** Lines that a person may look through. */
const MAX_LISTED = 200;

export interface MapsForm {
  readonly element: HTMLElement;
  /** The maps that there are, and the one that is shown. */
  fill(maps: readonly MapInfo[], shown: MapInfo | null): void;
  /** Ids of the maps that were chosen beside the one that is shown. */
  others(): string[];
}

export function createMapsForm(): MapsForm {
  const summary = element("span", { class: "quiet" });
  const list = element("div", { class: "stack near scrolled" });
  const note = element("p", { class: "quiet small" });
  const details = element(
    "details",
    { hidden: true },
    element("summary", {}, "Maps", summary),
    element("fieldset", { class: "stack near inset" }, list, note),
  );
  list.before(element("legend", { class: "unseen" }, "Maps that are searched too"));
  let boxes: HTMLInputElement[] = [];
  let shownRef = "";

  const others = (): string[] => boxes.filter((box) => box.checked).map((box) => box.value);

  function changed(): void {
    const count = others().length;
    for (const box of boxes) box.disabled = !box.checked && count >= MAX_OTHERS;
    summary.textContent = count === 0 ? "the one that is shown" : `and ${counted(count, "other")}`;
  }

  details.addEventListener("change", changed);
  return {
    element: details,
    others,
    fill(maps, shown) {
      const ref = shown === null ? "" : shortRef(shown);
      // What was chosen stays chosen for as long as the same map is shown.
      const chosen = ref === shownRef && boxes.length > 0 ? others() : chosenFirst(maps, shown);
      shownRef = ref;
      const offered = offeredMaps(maps, shown);
      boxes = offered
        .slice(0, MAX_LISTED)
        .map(({ id }) =>
          element("input", { type: "checkbox", value: id, checked: chosen.includes(id) }),
        );
      list.replaceChildren(
        ...boxes.map((box) => element("label", { class: "check" }, box, box.value)),
      );
      const left = offered.length - boxes.length;
      const more = left > 0 ? ` ${counted(left, "more map")} are not listed here.` : "";
      note.textContent = `One of them answers; a photo that fits two of them is refused.${more}`;
      details.hidden = boxes.length === 0;
      changed();
    },
  };
}

/** Ids of the pieces of a map: the same build made them of photos that nothing links to it. */
function piecesOf(shown: MapInfo | null): string[] {
  return (shown?.pieces ?? []).map((ref) => ref.split("@")[0]!);
}

/** Maps that may be asked beside the one that is shown: its pieces first. */
export function offeredMaps(maps: readonly MapInfo[], shown: MapInfo | null): MapInfo[] {
  if (shown === null) return [];
  const pieces = piecesOf(shown);
  const others = maps.filter(({ id }) => id !== shown.id);
  return [
    ...others.filter(({ id }) => pieces.includes(id)),
    ...others.filter(({ id }) => !pieces.includes(id)),
  ];
}

/** Ids of those that are asked unless somebody says otherwise: the pieces of the same build. */
export function chosenFirst(maps: readonly MapInfo[], shown: MapInfo | null): string[] {
  const pieces = piecesOf(shown);
  return offeredMaps(maps, shown)
    .filter(({ id }) => pieces.includes(id))
    .slice(0, MAX_OTHERS)
    .map(({ id }) => id);
}
