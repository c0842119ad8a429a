// A photo of another place: the map does not know, and says why.
import { localize, openMap } from "./steps.mjs";

export default async function ({ browser, url, camera, photo }) {
  const { page, seen } = await openMap(browser, url, "room");
  const before = await page.evaluate(() => visloc.view);
  const { answer, problem } = await localize(page, photo);
  const view = await page.evaluate(() => visloc.view);
  const shown = await page.getByRole("tabpanel", { name: "Photo" }).innerText();
  const announced = await page.locator("[aria-live]").first().innerText();
  return { ...seen, answer, problem, shown, announced, before, view };
}
