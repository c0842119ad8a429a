// Text to take along: behind tabs, with a button that copies it.
import { button, element } from "../dom";
import { createTabs } from "./tabs";

/** `announce` says what was done. */
export function textsToCopy(
  texts: { name: string; text: string; note: string }[],
  announce: (text: string) => void,
): HTMLElement {
  const list = element("div", { class: "tabs small", role: "tablist", "aria-label": "Copy as" });
  const whole = element("div", { class: "texts" }, list);
  for (const { name, text, note } of texts) {
    const id = `copy-${name.toLowerCase()}`;
    const tab = element("button", {
      type: "button",
      role: "tab",
      id,
      "aria-controls": `${id}-text`,
    });
    tab.textContent = name;
    list.append(tab);
    const code = element("pre", { tabindex: 0, "aria-label": name }, text);
    const copied = button("Copy", () => void copy());
    const copy = async (): Promise<void> => {
      const done = await copyText(text, code);
      copied.textContent = done ? "Copied" : "Selected";
      copied.removeAttribute("aria-label");
      announce(done ? `${name} copied` : `${name} selected: copy it with the keyboard`);
      setTimeout(() => {
        copied.textContent = "Copy";
        copied.setAttribute("aria-label", `Copy ${name}`);
      }, 2000);
    };
    copied.setAttribute("aria-label", `Copy ${name}`);
    const below = element("div", { class: "row" });
    below.append(element("p", { class: "quiet small gap" }, note), copied);
    const panel = element("div", { id: `${id}-text`, role: "tabpanel", "aria-labelledby": id });
    panel.append(code, below);
    whole.append(panel);
  }
  createTabs(list);
  return whole;
}

/**
 * Copy a text. Browsers give the clipboard to pages that came over https or from this very device;
 * in others an older command copies what is selected. Where that fails too, the text is selected.
 */
export async function copyText(text: string, shown: HTMLElement): Promise<boolean> {
  if (navigator.clipboard !== undefined) {
    try {
      await navigator.clipboard.writeText(text);
      return true;
    } catch (error) {
      if (!(error instanceof DOMException)) throw error; // not allowed: go on
    }
  }
  getSelection()?.selectAllChildren(shown);
  return document.execCommand("copy");
}
