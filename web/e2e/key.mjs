// A service that wants an API key: played here, before the real one, which wants none.
import { openWatched, until } from "./watched.mjs";

export default async function ({ browser, url, key }) {
  const { page, seen } = await openWatched(browser, `${url}/`, {
    prepare: (page) =>
      page.route("**/maps**", async (route) => {
        const { authorization, ...headers } = route.request().headers();
        if (authorization === `Bearer ${key}`) return route.continue({ headers });
        return route.fulfill({
          status: 401,
          contentType: "application/problem+json",
          headers: { "WWW-Authenticate": "Bearer" },
          body: JSON.stringify({
            ...{ title: "Unauthorized", status: 401, detail: "this needs an API key" },
            ...{ code: "access.key_missing", field: "Authorization", expected: "Bearer KEY" },
            ...{ got: null, request_id: "0" },
          }),
        });
      }),
  });
  const dialog = page.getByRole("dialog", { name: "API key" });
  await dialog.waitFor();
  const asked = await dialog.innerText();
  const before = seen.requests.splice(0);
  await dialog.getByLabel("Key", { exact: true }).fill(key);
  await dialog.getByRole("button", { name: "Use" }).click();
  await until(page, () => visloc.map && visloc.statistics.pointsLoaded === visloc.map.landmarks);
  const kept = await page.evaluate(() =>
    JSON.stringify([{ ...localStorage }, { ...sessionStorage }]),
  );
  return { ...seen, asked, before, kept, address: page.url() };
}
