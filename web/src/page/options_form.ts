// What may be chosen per photo. What is left alone is not sent: the service has its defaults.
import { ownError } from "../api";
import { button, element, field } from "../dom";

// Words and defaults as in the tables of docs/api.md.
const CHOICES: { name: string; label: string; unset: string; words: string[] }[] = [
  {
    name: "preset",
    label: "Preset of thresholds",
    unset: "default",
    words: ["default", "config1", "config2"],
  },
  {
    name: "extraction",
    label: "Effort for the photo’s features",
    unset: "default",
    words: ["fast", "default", "accurate"],
  },
  {
    name: "read_as",
    label: "Read photo as",
    unset: "as its EXIF says",
    words: ["stored", "upright"],
  },
  {
    name: "fusion",
    label: "Fusion of similarities",
    unset: "the map’s",
    words: [
      ...["gharm", "mean", "power", "min", "max", "mean_and_power", "min_and_max"],
      ...["mean_and_min", "harmonic", "round_robin"],
    ],
  },
  {
    name: "matcher",
    label: "Matcher",
    unset: "mutual",
    words: ["mutual", "ratio", "lightglue"],
  },
  {
    name: "solver",
    label: "Solver",
    unset: "pycolmap",
    words: ["pycolmap", "poselib", "registration"],
  },
];

export interface OptionsForm {
  readonly element: HTMLElement;
  /** What was changed from the defaults. Throws ServiceError for what is no number. */
  options(): Record<string, string | number>;
  open(): void;
}

export function createOptionsForm(): OptionsForm {
  const selects = CHOICES.map(({ name, label, unset, words }) => {
    const id = `option-${name}`;
    const select = element("select", { id, name }, element("option", { value: "" }, `(${unset})`));
    select.append(...words.map((word) => element("option", { value: word }, word)));
    return { name, select, field: field(label, select) };
  });
  const topK = element("input", {
    ...{ id: "option-top_k", name: "top_k", type: "number", min: 1, max: 1000, step: 1 },
    placeholder: "(20)",
  });
  const summary = element("span", { class: "quiet" });
  const reset = button("Back to the defaults", () => {
    for (const { select } of selects) select.value = "";
    topK.value = "";
    changed();
  });
  const details = element(
    "details",
    {},
    element("summary", {}, "Options", summary),
    element(
      "div",
      { class: "stack inset" },
      element(
        "div",
        { class: "fields wide" },
        field("Mapping photos to match (top_k)", topK),
        ...selects.map((one) => one.field),
      ),
      element("div", { class: "row" }, reset),
    ),
  );

  function options(): Record<string, string | number> {
    // A field that holds no number says that it holds nothing.
    if (topK.validity.badInput) {
      const detail = "the number of mapping photos to match (top_k) is no number";
      throw ownError("options.top_k", "An option is wrong", detail, {
        field: "options.top_k",
        expected: "a whole number, 1 to 1000",
      });
    }
    return chosen();
  }

  function chosen(): Record<string, string | number> {
    const given: Record<string, string | number> = {};
    // Of other numbers the service says what it expects.
    if (topK.value !== "") given["top_k"] = Number(topK.value);
    for (const { name, select } of selects) {
      if (select.value !== "") given[name] = select.value;
    }
    return given;
  }

  function changed(): void {
    const wrong = topK.validity.badInput;
    topK.setAttribute("aria-invalid", String(wrong));
    const words = Object.entries(chosen()).map(([name, value]) => `${name} ${value}`);
    if (wrong) words.unshift("top_k is no number");
    summary.textContent = words.length === 0 ? "the service’s defaults" : words.join(", ");
    reset.disabled = words.length === 0;
  }

  details.addEventListener("input", changed);
  changed();
  return {
    element: details,
    options,
    open() {
      details.open = true;
    },
  };
}
