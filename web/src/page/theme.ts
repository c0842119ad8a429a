// Light, dark, or as the system has it.
import type { Theme } from "../viewer/types";

const STORED_AS = "visloc.theme";

/** Let `select` choose the theme, and tell `onChange` of every one but the first. */
export function createTheme(select: HTMLSelectElement): {
  current(): Theme;
  onChange(listener: (theme: Theme) => void): void;
} {
  const system = matchMedia("(prefers-color-scheme: dark)");
  const listeners: ((theme: Theme) => void)[] = [];
  const current = (): Theme => {
    if (select.value === "light" || select.value === "dark") return select.value;
    return system.matches ? "dark" : "light";
  };
  const apply = (): void => {
    if (select.value === "system") delete document.documentElement.dataset["theme"];
    else document.documentElement.dataset["theme"] = select.value;
    for (const listener of listeners) listener(current());
  };

  const stored = read();
  if (stored === "light" || stored === "dark") select.value = stored;
  else select.value = "system";
  apply();
  select.addEventListener("change", () => {
    write(select.value);
    apply();
  });
  system.addEventListener("change", apply);
  return { current, onChange: (listener) => void listeners.push(listener) };
}

// A browser that keeps nothing for this page throws; then the choice holds until the page is left.
function read(): string | null {
  try {
    return localStorage.getItem(STORED_AS);
  } catch (error) {
    if (!(error instanceof DOMException)) throw error;
    return null;
  }
}

function write(value: string): void {
  try {
    localStorage.setItem(STORED_AS, value);
  } catch (error) {
    if (!(error instanceof DOMException)) throw error;
  }
}
