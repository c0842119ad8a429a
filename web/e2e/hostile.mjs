// Names that would be markup, if anybody took them for it: of files, photos of the map, and maps.
import { localize, openMap } from "./steps.mjs";

export default async function ({ browser, url, photo, names, markup }) {
  const { page, seen } = await openMap(browser, url, "room", {
    prepare: async (page) => {
      await page.route("**/localize", async (route) => {
        const response = await route.fetch();
        const answer = await response.json();
        for (const found of answer.retrieved) found.image = markup;
        await route.fulfill({ response, json: answer });
      });
      await page.route("**/maps", async (route) => {
        const response = await route.fetch();
        const { maps, ...rest } = await response.json();
        maps.push({ ...maps[0], id: markup, local_features: markup });
        await route.fulfill({ response, json: { ...rest, maps } });
      });
    },
  });
  const shown = [];
  for (const name of names) {
    await localize(page, { ...photo, name });
    shown.push(await page.getByRole("tabpanel", { name: "Photo" }).innerText());
  }
  const maps = await page.getByRole("combobox", { name: "Map", exact: true }).innerText();
  const injected = await page.locator("[onerror], img[src='x'], body script:not([src])").count();
  return { ...seen, shown, maps, injected };
}
