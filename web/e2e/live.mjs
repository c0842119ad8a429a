// The camera sees what driver.mjs was given; its frames are localized on the walk.
import { openMap, openTab, typeCamera } from "./steps.mjs";
import { until } from "./watched.mjs";

export default async function ({ browser, url, camera, answers }) {
  const { page, seen } = await openMap(browser, url, "room");
  await typeCamera(page, camera);
  await openTab(page, "Live");
  await page.getByRole("button", { name: "Start the camera" }).click();
  const found = new Map();
  while (found.size < answers) {
    const last = await until(
      page,
      (known) => {
        const { last } = visloc.live;
        return last !== null && !known.includes(last.request_id) && last;
      },
      [...found.keys()],
    );
    found.set(last.request_id, last);
  }
  const running = await page.evaluate(() => ({ ...visloc.live, last: null }));
  const shown = await page.getByRole("tabpanel", { name: "Live" }).innerText();
  await page.getByRole("button", { name: "Stop" }).click();
  const stopped = await until(
    page,
    () => visloc.live.inFlight === 0 && { ...visloc.live, last: null },
  );
  return { ...seen, found: [...found.values()], running, stopped, shown };
}
