// A pose is shared by a link, which shows it to somebody else; leaving it, the address lets it go.
import { localize, openMap, typeCamera } from "./steps.mjs";
import { openWatched, until } from "./watched.mjs";

export default async function ({ browser, url, camera, photo, other }) {
  const first = await openMap(browser, url, "room");
  await first.context.grantPermissions(["clipboard-read", "clipboard-write"]);
  await typeCamera(first.page, camera);
  const { answer } = await localize(first.page, photo);
  const panel = first.page.getByRole("tabpanel", { name: "Photo" });
  const shown = await panel.innerText();
  const view = await first.page.evaluate(() => visloc.view);
  await first.page.getByRole("tab", { name: "Link", exact: true }).click();
  await first.page.getByRole("button", { name: "Copy Link" }).click();
  await first.page.getByRole("status").filter({ hasText: "Link copied" }).waitFor();
  const link = await first.page.evaluate(() => navigator.clipboard.readText());

  const { page, seen } = await openWatched(browser, link);
  await until(page, () => visloc.map && visloc.statistics.pointsLoaded === visloc.map.landmarks);
  await page.getByRole("heading", { name: "A pose from a link" }).waitFor();
  const opened = {
    map: await page.evaluate(() => visloc.map),
    view: await page.evaluate(() => visloc.view),
    shown: await page.getByRole("tabpanel", { name: "Photo" }).innerText(),
    described: await page.locator("canvas[role=application]").getAttribute("aria-label"),
    address: page.url(),
  };
  await typeCamera(page, camera);
  await localize(page, other);
  const left = page.url();
  await page.goto(link.slice(0, link.indexOf("camera")));
  await page.getByRole("heading", { name: "This link is damaged" }).waitFor();
  return { ...seen, answer, shown, view, link, opened, left };
}
