// On a phone: several maps, a camera of the map, and matches only when they are asked for.
import { localize, openMap, openTab } from "./steps.mjs";
import { until } from "./watched.mjs";

const PHONE = { viewport: { width: 390, height: 844 }, isMobile: true, hasTouch: true };

export default async function ({ browser, url, camera, photo }) {
  const { page, seen } = await openMap(browser, url, "room", PHONE);
  const about = await page.getByRole("tabpanel", { name: "Map" }).innerText();
  await openTab(page, "Photo");
  const panel = page.getByRole("tabpanel", { name: "Photo" });
  const maps = panel.locator("details", { hasText: "Maps that are searched too" });
  await maps.locator("summary").click();
  const other = maps.getByRole("checkbox", { name: "room-2" });
  const chosen = await other.isChecked();
  const inBoth = await localize(page, photo);
  await other.uncheck();

  await panel.locator("summary", { hasText: "Camera" }).click();
  await page.getByRole("radio", { name: "Of the map" }).check();
  await page.getByLabel("A camera that took mapping photos").selectOption(camera);
  const inOne = await localize(page, photo);
  const shown = await panel.innerText();
  const green = await panel.locator(".verdict.good").count();

  await panel.getByRole("button", { name: /Show the matches/ }).click();
  const matches = await until(page, () => visloc.answer?.debug?.inliers.length ?? 0);
  const again = await panel.getByRole("button", { name: /Show the matches/ }).count();
  const width = await page.evaluate(() => document.documentElement.scrollWidth);
  return { ...seen, about, chosen, inBoth, inOne, shown, green, matches, again, width };
}
