// axe-core on every tab, light, dark and as wide as a phone.
import { axeFaults } from "./axe.mjs";
import { localize, openMap, openTab, typeCamera } from "./steps.mjs";

const DESK = { width: 900, height: 700 };
const PHONE = { width: 390, height: 800 };

export default async function ({ browser, url, camera, photo }) {
  const { page, seen } = await openMap(browser, url, "room");
  await typeCamera(page, camera);
  await localize(page, photo);
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
      for (const fault of await axeFaults(page)) faults.push(`${look}, ${tab}: ${fault}`);
    }
    widths[look] = await page.evaluate(() => [document.documentElement.scrollWidth, innerWidth]);
  }
  return { ...seen, faults, widths };
}
