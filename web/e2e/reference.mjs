// The references of the HTTP API: /docs, where a route is tried, and /redoc.
import { openWatched } from "./watched.mjs";

export default async function ({ browser, url }) {
  const docs = await openWatched(browser, `${url}/docs`);
  const route = docs.page.locator(".opblock", { hasText: "/healthz" });
  await route.locator(".opblock-summary-control").click();
  await route.getByRole("button", { name: "Try it out" }).click();
  await route.getByRole("button", { name: "Execute" }).click();
  const answer = await route
    .locator(".live-responses-table tbody .response-col_status")
    .innerText();
  const tried = await docs.page.locator("#api").innerText();

  const redoc = await openWatched(browser, `${url}/redoc`);
  await redoc.page.getByRole("heading", { name: "Localize Rig" }).waitFor();
  const read = await redoc.page.locator("#api").innerText();
  return { docs: { ...docs.seen, answer, text: tried }, redoc: { ...redoc.seen, text: read } };
}
