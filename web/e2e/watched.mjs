// A page that is watched: what it logs, asks for and lets happen.

const LOOK = {
  viewport: { width: 900, height: 700 }, // every pixel is drawn by the processor
  reducedMotion: "reduce", // what flies is there at once
};

/** What was seen in all pages so far, to say more about a scenario that fails. */
export const watched = [];

/**
 * Open a page of its own and watch it from its first request on.
 *
 * `prepare` may set routes before anything is loaded. Returns the page and what is seen, which
 * grows: `console` errors and uncaught ones, `violations` of the Content-Security-Policy, all
 * `requests`, and `dialogs`, which are dismissed.
 */
export async function openWatched(browser, url, { prepare, ...options } = {}) {
  const context = await browser.newContext({ ...LOOK, ...options });
  context.setDefaultTimeout(20_000);
  const page = await context.newPage();
  const seen = { console: [], violations: [], requests: [], dialogs: [] };
  watched.push(seen);
  page.on("console", (message) => {
    if (message.type() === "error") seen.console.push(message.text());
  });
  page.on("pageerror", (error) => seen.console.push(String(error)));
  page.on("request", (request) => {
    seen.requests.push({ url: request.url(), authorization: request.headers().authorization });
  });
  page.on("dialog", async (dialog) => {
    seen.dialogs.push(dialog.message());
    await dialog.dismiss();
  });
  await page.exposeFunction("reportViolation", (text) => seen.violations.push(text));
  await page.addInitScript(() => {
    addEventListener("securitypolicyviolation", (event) => {
      window.reportViolation(`${event.effectiveDirective}: ${event.blockedURI} ${event.sample}`);
    });
  });
  await prepare?.(page);
  await page.goto(url);
  return { context, page, seen };
}

/** Wait until `read`, run in the page, gives something other than null or false; return that. */
export async function until(page, read, argument) {
  return (await page.waitForFunction(read, argument)).jsonValue();
}
