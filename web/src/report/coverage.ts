// The section with the plan: its controls and legend, the weak spots, and all of it as a table.
import { element } from "../dom";
import type { ReportData, WeakSpot } from "./data";
import { onPlan, type PlanPoint } from "./plan";
import { createPlan, legend, type PlanChoice, type PlanView } from "./planview";
import { chanceScale, uncertaintyScale } from "./scale";
import { table } from "./trials";
import { clock, length, percent, placeName } from "./words";

const HINT = "Point at a place on the plan for its numbers.";

export interface CoverageSection {
  nodes: Node[];
  /** To be called once the nodes are on the page: drawing takes their size. */
  ready(): void;
}

export function coverageSection(
  data: ReportData,
  landmarks: PlanPoint[],
  on: { visit(spot: WeakSpot): void; chooseDirection(direction: number | null): void },
): CoverageSection {
  const { coverage, map } = data;
  if (coverage.cells.length === 0) {
    return {
      nodes: [element("p", {}, "There is no place to predict for: see the notes above.")],
      ready: () => {},
    };
  }
  const scales = { chance: chanceScale(), std: uncertaintyScale(coverage.cells, map.metric) };
  const choice: PlanChoice = { scale: scales.chance, direction: null, photos: true };
  const host = element("div", {
    class: "plan scrolls",
    tabindex: 0,
    role: "region",
    "aria-label": "Plan",
  });
  const told = element("p", { class: "told" }, HINT);
  const key = element("div", { class: "key" });
  let plan: PlanView | null = null;

  function show(): void {
    key.replaceChildren(
      element("p", {}, choice.scale.title),
      legend(choice.scale),
      element(
        "p",
        { class: "note" },
        choice.direction === null
          ? "One petal for each direction of view; a longer petal is a better one. Dots with a " +
              "tick: mapping photos and where they look. Grey: landmarks."
          : "The photos shown are those that look that way, within 45°.",
      ),
    );
    plan?.show(choice);
  }

  const quantity = choices("Show", "quantity", [
    ["chance of being localized", () => (choice.scale = scales.chance)],
    ["uncertainty of the position", () => (choice.scale = scales.std)],
  ]);
  quantity.addEventListener("change", show);
  const looking = element(
    "select",
    {},
    element("option", { value: "all" }, "all directions"),
    ...coverage.directions_deg.map((heading, index) =>
      element("option", { value: index }, `towards ${clock(heading)}${side(heading)}`),
    ),
  );
  looking.addEventListener("change", () => {
    choice.direction = looking.value === "all" ? null : Number(looking.value);
    on.chooseDirection(choice.direction);
    show();
  });
  const photos = element("input", { type: "checkbox", checked: true });
  photos.addEventListener("change", () => {
    choice.photos = photos.checked;
    show();
  });

  const nodes = [
    element(
      "p",
      {},
      "Seen from above. How likely is a photo localized that is taken there, looking that way, " +
        `within ${length(coverage.within.position, map.metric)} and ` +
        `${coverage.within.orientation_deg}° of the truth? Take more photos at the numbers.`,
    ),
    element(
      "div",
      { class: "controls" },
      quantity,
      element("label", { class: "choice" }, "Looking", looking),
      element("label", { class: "choice" }, photos, "Mapping photos"),
    ),
    element(
      "div",
      { class: "survey" },
      element("div", { class: "picture" }, host, told, key),
      weakSpots(data, (spot) => plan?.stress(spot), on.visit),
    ),
    asTable(data),
  ];
  return {
    nodes,
    ready: () => {
      plan = createPlan(host, data, landmarks, choice, (text) => {
        told.textContent = text ?? HINT;
      });
      show();
    },
  };
}

function weakSpots(
  data: ReportData,
  stress: (spot: number | null) => void,
  visit: (spot: WeakSpot) => void,
): HTMLElement {
  const { coverage } = data;
  const items = coverage.weak_spots.map((spot, index) => {
    const place = placeName(coverage, onPlan(coverage, spot.position));
    const name = `${place[0]?.toUpperCase()}${place.slice(1)}, towards ${clock(spot.direction_deg)}`;
    const button = element(
      "button",
      { type: "button", "aria-label": `${name}: look there in 3D` },
      "3D",
    );
    button.addEventListener("click", () => visit(spot));
    const item = element(
      "li",
      {},
      element("strong", {}, name),
      element("span", { class: "note" }, `${percent(spot.probability)}: ${spot.why}`),
      button,
    );
    item.addEventListener("pointerenter", () => stress(index));
    item.addEventListener("pointerleave", () => stress(null));
    item.addEventListener("focusin", () => stress(index));
    item.addEventListener("focusout", () => stress(null));
    return item;
  });
  return element(
    "aside",
    { "aria-label": "Weak spots" },
    element("h3", {}, "Where to take more photos"),
    items.length > 0
      ? element("ol", { class: "weak-spots" }, ...items)
      : element("p", {}, "Nowhere in particular: no weak spot was found."),
  );
}

/** Every number of the plan; made when it is opened, since few want thousands of rows. */
function asTable(data: ReportData): HTMLElement {
  const { coverage } = data;
  const details = element("details", {}, element("summary", {}, "The chances as a table"));
  details.addEventListener(
    "toggle",
    () => {
      const rows = coverage.cells.map((cell) => [
        cell.position.map((value) => value.toFixed(2)).join(", "),
        ...coverage.directions_deg.map((_, index) => percent(cell.probability[index] ?? 0)),
      ]);
      const head = ["Place (x, y, z)", ...coverage.directions_deg.map(clock)];
      details.append(
        table("Chance of being localized, by place and direction of view", head, rows),
      );
    },
    { once: true },
  );
  return details;
}

function choices(title: string, name: string, options: [string, () => void][]): HTMLElement {
  const labels = options.map(([text, choose], index) => {
    const input = element("input", { type: "radio", name, checked: index === 0 });
    input.addEventListener("change", choose);
    return element("label", { class: "choice" }, input, text);
  });
  return element("fieldset", {}, element("legend", {}, title), ...labels);
}

function side(heading: number): string {
  const found = { 0: " (right)", 90: " (up)", 180: " (left)", 270: " (down)" };
  return found[heading as keyof typeof found] ?? "";
}
