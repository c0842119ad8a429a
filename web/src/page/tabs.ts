// Tabs: the pattern of the ARIA Authoring Practices, with automatic activation. Arrows, Home and
// End move between the tabs of a list; only the chosen one is reached by Tab.

export interface Tabs {
  choose(id: string): void;
}

/** Give life to a tablist whose tabs name their panels. */
export function createTabs(list: HTMLElement): Tabs {
  const tabs = [...list.querySelectorAll<HTMLElement>("[role=tab]")];

  function choose(id: string): void {
    for (const tab of tabs) {
      const chosen = tab.id === id;
      tab.setAttribute("aria-selected", String(chosen));
      tab.tabIndex = chosen ? 0 : -1;
      const panel = panelOf(list, tab);
      if (panel !== null) panel.hidden = !chosen;
    }
  }

  for (const [i, tab] of tabs.entries()) {
    tab.addEventListener("click", () => choose(tab.id));
    tab.addEventListener("keydown", (event) => {
      const to = { ArrowRight: i + 1, ArrowLeft: i - 1, Home: 0, End: -1 }[event.key];
      const next = to === undefined ? undefined : tabs.at(to % tabs.length);
      if (next === undefined) return;
      event.preventDefault();
      choose(next.id);
      next.focus();
    });
  }
  if (tabs[0] !== undefined) choose(tabs[0].id);
  return { choose };
}

function panelOf(list: HTMLElement, tab: HTMLElement): HTMLElement | null {
  // Also before the tabs are part of the document.
  const id = tab.getAttribute("aria-controls") ?? "";
  return list.parentElement?.querySelector<HTMLElement>(`:scope > #${CSS.escape(id)}`) ?? null;
}
