// What may be chosen per photo. What is left alone is not sent: the service has its defaults.
import { ownError, ServiceError, type OptionSchema, type Client } from "visloc-client";
import { button, element, field } from "../dom";
import { sentence } from "./problem_view";

// Numbers that the form offers; every option that has a list of words is offered too.
const NUMBERS = ["top_k"];

export interface OptionsForm {
  readonly element: HTMLElement;
  /** What was changed from the defaults. Throws ServiceError for what is no number. */
  options(): Record<string, string | number>;
  open(): void;
}

/** Which options there are, and their words, the service says once the form is opened. */
export function createOptionsForm(service: Pick<Client, "options">): OptionsForm {
  let controls: Control[] = [];
  let asked = false;
  const fields = element("div", { class: "fields wide" });
  const summary = element("span", { class: "quiet" });
  const reset = button("Back to the defaults", () => {
    for (const { input } of controls) input.value = "";
    changed();
  });
  const details = element(
    "details",
    {},
    element("summary", {}, "Options", summary),
    element("div", { class: "stack inset" }, fields, element("div", { class: "row" }, reset)),
  );

  async function fill(): Promise<void> {
    if (asked) return;
    asked = true;
    try {
      controls = controlsOf(await service.options());
      fields.replaceChildren(...controls.map(({ label, input }) => field(label, input)));
    } catch (error) {
      if (!(error instanceof ServiceError)) throw error;
      asked = false; // opened again, it is asked again
      fields.replaceChildren(element("p", {}, sentence(error.problem.detail)));
    }
  }

  function options(): Record<string, string | number> {
    for (const { name, input, schema } of controls) {
      // A field that holds no number says that it holds nothing.
      if (!input.validity.badInput) continue;
      throw ownError(`options.${name}`, "An option is wrong", `${name} is no number`, {
        field: `options.${name}`,
        expected: `a number, ${schema.minimum} to ${schema.maximum}`,
      });
    }
    return chosen();
  }

  function chosen(): Record<string, string | number> {
    const given: Record<string, string | number> = {};
    for (const { name, input, schema } of controls) {
      // Of numbers out of range the service says what it expects.
      if (input.value !== "") given[name] = schema.enum ? input.value : Number(input.value);
    }
    return given;
  }

  function changed(): void {
    const words = Object.entries(chosen()).map(([name, value]) => `${name} ${value}`);
    for (const { name, input } of controls) {
      const wrong = input.validity.badInput;
      input.setAttribute("aria-invalid", String(wrong));
      if (wrong) words.unshift(`${name} is no number`);
    }
    summary.textContent = words.length === 0 ? "the service’s defaults" : words.join(", ");
    reset.disabled = words.length === 0;
  }

  details.addEventListener("input", changed);
  details.addEventListener("toggle", () => void (details.open && fill()));
  changed();
  return {
    element: details,
    options,
    open() {
      details.open = true;
    },
  };
}

interface Control {
  name: string;
  label: string;
  input: HTMLSelectElement | HTMLInputElement;
  schema: OptionSchema;
}

function controlsOf(schemas: Record<string, OptionSchema>): Control[] {
  return Object.entries(schemas)
    .filter(([name, schema]) => schema.enum !== undefined || NUMBERS.includes(name))
    .map(([name, schema]) => {
      const unset = `(${schema.default ?? "default"})`;
      const { title } = schema;
      const label = `${title.charAt(0).toUpperCase()}${title.slice(1)} (${name})`;
      const id = `option-${name}`;
      const input = schema.enum
        ? selectOf(schema.enum, unset, { id, name })
        : element("input", {
            ...{ id, name, type: "number", step: 1, placeholder: unset },
            ...{ min: schema.minimum ?? "", max: schema.maximum ?? "" },
          });
      return { name, label, input, schema };
    });
}

function selectOf(
  words: (string | null)[],
  unset: string,
  attributes: Record<string, string>,
): HTMLSelectElement {
  const named = words.filter((word) => word !== null);
  return element(
    "select",
    attributes,
    element("option", { value: "" }, unset),
    ...named.map((word) => element("option", { value: word }, word)),
  );
}
