// The file of `mapping report`, opened from the disk: no service, no network.
import { axeFaults } from "./axe.mjs";
import { openWatched, until } from "./watched.mjs";

export default async function ({ browser, file }) {
  const { page, seen } = await openWatched(browser, file);
  const view = page.locator(".stage canvas");
  await view.waitFor();
  const cells = await until(page, () => document.querySelectorAll("svg .cells *").length);
  const shown = await page.locator("body").innerText();
  const described = await page.locator(".stage [aria-label]").first().getAttribute("aria-label");
  return { ...seen, cells, shown, described, faults: await axeFaults(page) };
}
