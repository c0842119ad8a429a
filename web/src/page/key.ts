// The API key: asked for when the service wants one, sent only when given, kept only when asked to.
import { button, element } from "../dom";

const STORED_AS = "visloc.api_key";

export interface KeyEntry {
  /** The key that was given; null without one. */
  current(): string | null;
  /** Ask for it, and say why. */
  ask(why: string): void;
  /** Be told when another one, or none, was given. */
  onChange(listener: () => void): void;
}

/** Let `opener` open the dialog for the key. */
export function createKeyEntry(opener: HTMLButtonElement): KeyEntry {
  let key: string | null = sessionStorageOrNull()?.getItem(STORED_AS) ?? null;
  const listeners: (() => void)[] = [];

  const why = element("p", { id: "key-why" });
  const input = element("input", {
    ...{ id: "key-value", type: "password", autocomplete: "off", spellcheck: "false" },
    ...{ "aria-describedby": "key-why", maxlength: 1000 },
  });
  const remember = element("input", { id: "key-remember", type: "checkbox" });
  const form = element(
    "form",
    { class: "stack" },
    element("h2", { id: "key-title" }, "API key"),
    why,
    element("div", { class: "field" }, element("label", { for: "key-value" }, "Key"), input),
    element("label", { class: "check" }, remember, "Remember in this tab"),
    element(
      "div",
      { class: "row" },
      element("button", { type: "submit", class: "primary" }, "Use"),
      button("Forget", () => give("")),
      button("Cancel", () => dialog.close(), { class: "plain" }),
    ),
  );
  const dialog = element("dialog", { class: "small-dialog", "aria-labelledby": "key-title" }, form);
  document.body.append(dialog);

  function give(value: string): void {
    const given = value.trim();
    key = given === "" ? null : given;
    const storage = sessionStorageOrNull();
    if (key !== null && remember.checked) storage?.setItem(STORED_AS, key);
    else storage?.removeItem(STORED_AS);
    input.value = "";
    show();
    dialog.close();
    for (const listener of listeners) listener();
  }

  function ask(reason: string): void {
    why.textContent = reason;
    remember.checked = key !== null && sessionStorageOrNull()?.getItem(STORED_AS) === key;
    if (!dialog.open) dialog.showModal();
    input.focus();
  }

  function show(): void {
    opener.textContent = key === null ? "API key" : "API key ✓";
  }

  form.addEventListener("submit", (event) => {
    event.preventDefault();
    const typed = input.value.trim();
    // Nothing typed leaves the key as it is: to take it away, there is a button.
    if (typed === "") dialog.close();
    else if (/^[\x21-\x7e]+$/.test(typed)) give(typed);
    else ask("This is no key: keys are letters, digits and signs of ASCII, without blanks.");
  });
  opener.addEventListener("click", () =>
    ask(
      key === null
        ? "Whoever runs the service makes keys. Without one, none is sent."
        : "A key is being sent with every request. Type another one, or forget it.",
    ),
  );
  show();
  return { current: () => key, ask, onChange: (listener) => void listeners.push(listener) };
}

function sessionStorageOrNull(): Storage | null {
  try {
    return sessionStorage;
  } catch (error) {
    if (!(error instanceof DOMException)) throw error;
    return null; // the browser keeps nothing for this page
  }
}
