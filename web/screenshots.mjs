// Takes the pictures of docs/images/, page-VIEW-LOOK.webp: each view light, dark and on a phone.
//
//     node web/screenshots.mjs --url http://127.0.0.1:8000 --map kitchen --camera MODEL,W,H,... \
//         --photo photo.jpg --elsewhere castle.jpg --report kitchen.html --output docs/images walk/*.jpg
//
// `--photo` is of the map and `--elsewhere` is not; the photos of the walk, JPEG files of one size,
// are what the camera sees. The browser is VISLOC_CHROMIUM, else /usr/bin/chromium.
import { mkdtemp, mkdir, readFile, rm, writeFile } from "node:fs/promises";
import { tmpdir } from "node:os";
import { basename, join, resolve } from "node:path";
import { parseArgs } from "node:util";
import { pathToFileURL } from "node:url";
import { launch } from "./e2e/browser.mjs";
import { localize, openMap, openTab, typeCamera } from "./e2e/steps.mjs";
import { openWatched, until } from "./e2e/watched.mjs";

const FRAMES_PER_PHOTO = 25; // of 30 per second: a slow service still sees each
const STEPS_OF_WALK = 12;
const MOST_HEIGHT = 1400; // of the report's picture, pixels
const DESK = { viewport: { width: 1280, height: 800 } };
const PHONE = {
  ...{ viewport: { width: 390, height: 844 }, deviceScaleFactor: 2 },
  ...{ isMobile: true, hasTouch: true },
};
const LOOKS = {
  light: { ...DESK, colorScheme: "light" },
  dark: { ...DESK, colorScheme: "dark" },
  phone: { ...PHONE, colorScheme: "light" },
};

const text = { type: "string" };
const { values: given, positionals: walk } = parseArgs({
  options: Object.fromEntries(
    ["url", "map", "camera", "photo", "elsewhere", "report", "output"].map((name) => [name, text]),
  ),
  allowPositionals: true,
});

const folder = await mkdtemp(join(tmpdir(), "visloc-"));
const video = join(folder, "walk.mjpeg");
const frames = await Promise.all(walk.map((path) => readFile(path)));
await writeFile(
  video,
  frames.flatMap((frame) => Array(FRAMES_PER_PHOTO).fill(frame)),
);
await mkdir(given.output, { recursive: true });
const browser = await launch(process.env.VISLOC_CHROMIUM ?? "/usr/bin/chromium", video);
try {
  for (const [look, options] of Object.entries(LOOKS)) {
    await takeMap(look, options);
    await takePhoto(look, options, "photo", given.photo);
    await takePhoto(look, options, "refused", given.elsewhere);
    await takeLive(look, options);
    await takeReport(look, options);
  }
} finally {
  await browser.close();
  await rm(folder, { recursive: true });
}

async function takeMap(look, options) {
  const { context, page } = await openMap(browser, given.url, given.map, options);
  await take(page, "map", look);
  await context.close();
}

async function takePhoto(look, options, view, path) {
  const { context, page } = await openMap(browser, given.url, given.map, options);
  // The camera is that of the map's photos; others tell their own.
  if (view === "photo") await typeCamera(page, given.camera);
  await localize(page, { path, name: basename(path), way: "chosen" });
  if (view === "photo") await page.locator("#panel-photo summary").first().click(); // closes it
  await take(page, view, look);
  await context.close();
}

async function takeLive(look, options) {
  const { context, page } = await openMap(browser, given.url, given.map, options);
  await typeCamera(page, given.camera);
  await openTab(page, "Live");
  await page.getByRole("button", { name: "Start the camera" }).click();
  await page.waitForFunction(
    (steps) => visloc.live.trailLength >= steps && visloc.live.last?.pose,
    STEPS_OF_WALK,
    { timeout: 120_000 },
  );
  await take(page, "live", look);
  await context.close();
}

async function takeReport(look, options) {
  const address = pathToFileURL(resolve(given.report)).href;
  const { context, page } = await openWatched(browser, address, options);
  await until(page, () => document.querySelector("canvas"));
  // The clip counts from the top of the page, not of the window.
  const place = await page.locator("main section").first().boundingBox();
  await take(page, "report", look, { ...place, height: Math.min(place.height, MOST_HEIGHT) });
  await context.close();
}

/** What is in the window, as WebP: a quarter of PNG's size for clouds of points. */
async function take(page, view, look, place = { x: 0, y: 0, ...page.viewportSize() }) {
  await page.waitForTimeout(1500); // the last picture of the view
  const clip = { ...place, scale: await page.evaluate(() => devicePixelRatio) };
  const session = await page.context().newCDPSession(page);
  const format = { format: "webp", quality: 75, captureBeyondViewport: true };
  const { data } = await session.send("Page.captureScreenshot", { ...format, clip });
  const path = join(given.output, `page-${view}-${look}.webp`);
  await writeFile(path, Buffer.from(data, "base64"));
  console.log(path);
}
