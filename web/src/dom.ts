// Elements without markup: what comes from outside is only ever text.

export type Child = Node | string;

/** Make an element. Attributes that are false are left out; true ones are empty. */
export function element<Tag extends keyof HTMLElementTagNameMap>(
  tag: Tag,
  attributes: Record<string, string | number | boolean> = {},
  ...children: Child[]
): HTMLElementTagNameMap[Tag] {
  const made = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (value !== false) made.setAttribute(name, value === true ? "" : String(value));
  }
  made.append(...children);
  return made;
}

/** Make a button that does something. */
export function button(
  text: string,
  onClick: () => void,
  attributes: Record<string, string | number | boolean> = {},
): HTMLButtonElement {
  const made = element("button", { type: "button", ...attributes }, text);
  made.addEventListener("click", onClick);
  return made;
}

/** A control, which has an id, below its name. */
export function field(name: string, control: HTMLElement): HTMLDivElement {
  return element("div", { class: "field" }, element("label", { for: control.id }, name), control);
}

/** Names and their values. */
export function facts(rows: [name: string, value: Child][]): HTMLDListElement {
  const list = element("dl", { class: "facts" });
  for (const [name, value] of rows) {
    list.append(element("dt", {}, name), element("dd", {}, value));
  }
  return list;
}

/** The element of the page's own markup that has this id. */
export function byId<Kind extends HTMLElement>(id: string, kind: new () => Kind): Kind {
  const found = document.getElementById(id);
  if (!(found instanceof kind)) throw new Error(`the page has no ${kind.name} #${id}`);
  return found;
}
