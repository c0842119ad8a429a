// axe-core on every tab, light, dark and as wide as a phone.
import { readFile } from "node:fs/promises";
import { localize, openMap, openTab, typeCamera } from "./steps.mjs";

const AXE = new URL("../node_modules/axe-core/axe.min.js", import.meta.url);
const DESK = { width: 900, height: 700 };
const PHONE = { width: 390, height: 800 };

export default async function ({ browser, url, camera, photo }) {
  const { page, seen } = await openMap(browser, url, "room");
  await typeCamera(page, camera);
  await localize(page, photo);
  await page.evaluate(await readFile(AXE, "utf-8"));
  const faults = [];
  const widths = {};
  for (const [look, size, colorScheme] of [
    ["light", DESK, "light"],
    ["dark", DESK, "dark"],
    ["phone", PHONE, "light"],
  ]) {
    await page.setViewportSize(size);
    await page.emulateMedia({ colorScheme });
    for (const tab of ["Map", "Photo", "Live"]) {
      await openTab(page, tab);
      for (const { id, nodes } of await violations(page)) {
        for (const node of nodes) faults.push(`${look}, ${tab}: ${id}: ${node}`);
      }
    }
    widths[look] = await page.evaluate(() => [document.documentElement.scrollWidth, innerWidth]);
  }
  return { ...seen, faults, widths };
}

function violations(page) {
  return page.evaluate(async () => {
    const found = await axe.run({ resultTypes: ["violations"] });
    return found.violations
      .filter(({ impact }) => impact === "serious" || impact === "critical")
      .map(({ id, nodes }) => ({
        id,
        nodes: nodes.map(({ html, failureSummary }) => `${html} ${failureSummary}`),
      }));
  });
}
