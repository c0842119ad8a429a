// The overlay of examples/web_overlay: a photo, and how far the map is drawn from what it shows.
import { openWatched, until } from "./watched.mjs";

export default async function ({ browser, url, service, photo }) {
  const { page, seen } = await openWatched(browser, `${url}/examples/web_overlay/?map=room`);
  await page.getByLabel("Service").fill(service);
  await page.getByLabel("Photo").setInputFiles(photo);
  await until(page, () => window.overlay ?? false);
  const overlay = await page.evaluate(() => window.overlay);
  const status = await page.getByRole("status").innerText();
  const { console } = structuredClone(seen); // a refusal is an error there
  await page.getByLabel("Map").fill("nowhere");
  await page.getByLabel("Photo").setInputFiles([]);
  await page.getByLabel("Photo").setInputFiles(photo);
  await page.getByText("map.unknown").waitFor();
  return { ...seen, console, overlay, status };
}
