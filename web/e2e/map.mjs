// A map is chosen, and its landmarks come.
import { openMap } from "./steps.mjs";
import { until } from "./watched.mjs";

export default async function ({ browser, url }) {
  const { page, seen } = await openMap(browser, url, "room");
  const statistics = await until(
    page,
    () => visloc.statistics.pointsDrawn > 0 && { ...visloc.statistics },
  );
  const map = await page.evaluate(() => visloc.map);
  const panel = await page.getByRole("tabpanel", { name: "Map" }).innerText();
  return { ...seen, map, statistics, panel };
}
