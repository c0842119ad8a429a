// SVG elements without markup, as dom.ts makes HTML.

type Attributes = Record<string, string | number | boolean>;

/** Make an element of SVG. Attributes that are false are left out; true ones are empty. */
export function svg<Tag extends keyof SVGElementTagNameMap>(
  tag: Tag,
  attributes: Attributes = {},
  ...children: (Node | string)[]
): SVGElementTagNameMap[Tag] {
  const made = document.createElementNS("http://www.w3.org/2000/svg", tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (value !== false) made.setAttribute(name, value === true ? "" : format(value));
  }
  made.append(...children);
  return made;
}

/** Numbers to a hundredth of a pixel: paths of thousands of cells stay small. */
export function format(value: string | number): string {
  return typeof value === "number" ? String(Math.round(value * 100) / 100) : value;
}
