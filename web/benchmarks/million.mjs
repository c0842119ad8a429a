// Measures the page with a large map in Chromium without a graphics card; benchmarks/page.py
// starts it. Prints what it found as JSON.
//
//   node benchmarks/million.mjs PAGE CHROMIUM SECONDS [PICTURES]
import { chromium } from "playwright-core";

const [address, executablePath, seconds, pictures] = process.argv.slice(2);
const LONGEST_MS = 120_000;

const browser = await chromium.launch({
  executablePath,
  args: [
    "--no-sandbox",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
  ],
});
try {
  const page = await browser.newPage({ viewport: { width: 1280, height: 720 } });
  page.setDefaultTimeout(LONGEST_MS);
  await page.goto(address);
  // By the page's own clock: milliseconds since the navigation.
  const firstPicture = await page.evaluate(firstPictureMs);
  await settled(page);
  const allDrawn = await page.evaluate(() => performance.now());
  if (pictures) await page.screenshot({ path: `${pictures}/rest.png` });

  const box = await page.locator("canvas").first().boundingBox();
  const middle = [box.x + box.width / 2, box.y + box.height / 2];
  await page.evaluate(record);
  await page.mouse.move(...middle);
  await page.mouse.down();
  const began = Date.now();
  for (let turn = 0; Date.now() - began < 1000 * seconds; turn += 0.03) {
    await page.mouse.move(
      middle[0] + 0.4 * box.width * Math.sin(turn),
      middle[1] + 0.1 * box.height * Math.sin(0.6 * turn),
    );
    await page.waitForTimeout(8);
  }
  const frames = await page.evaluate(() => window.frames_);
  if (pictures) await page.screenshot({ path: `${pictures}/moving.png` });
  await page.mouse.up();
  const released = Date.now();
  await settled(page);
  const intervals = frames.slice(1).map((frame, i) => frame.at - frames[i].at);
  // The first second is for finding out how much fits.
  const settledIntervals = intervals.filter((_, i) => frames[i].at - frames[0].at > 1000);
  console.log(
    JSON.stringify({
      first_picture_ms: firstPicture,
      all_drawn_ms: allDrawn,
      points: await page.evaluate(() => window.visloc.statistics.pointsLoaded),
      frames_per_second: (1000 * intervals.length) / sum(intervals),
      settled_frames_per_second: (1000 * settledIntervals.length) / sum(settledIntervals),
      slowest_frame_ms: Math.max(...settledIntervals),
      points_while_moving: median(frames.map((frame) => frame.drawn)),
      rest_complete_ms: Date.now() - released,
    }),
  );
} finally {
  await browser.close();
}

/** In the page: when it had its first picture with landmarks. */
async function firstPictureMs() {
  while (!(window.visloc?.statistics?.firstPictureMs > 0)) {
    await new Promise(requestAnimationFrame);
  }
  return performance.now();
}

/** Wait until all points are there and drawn, for more than a moment. */
async function settled(page) {
  for (let same = 0; same < 5;) {
    await page.waitForTimeout(40);
    const whole = await page.evaluate(() => {
      const { map, statistics } = window.visloc;
      return statistics.pointsDrawn === Math.min(map.landmarks, 3_000_000);
    });
    same = whole ? same + 1 : 0;
  }
}

/** In the page: when each picture came in which the view has moved, and how much is in it. */
function record() {
  window.frames_ = [];
  let last = "";
  const next = (at) => {
    const view = JSON.stringify(window.visloc.view);
    if (view !== last) window.frames_.push({ at, drawn: window.visloc.statistics.pointsDrawn });
    last = view;
    requestAnimationFrame(next);
  };
  requestAnimationFrame(next);
}

function sum(values) {
  return values.reduce((total, value) => total + value, 0);
}

function median(values) {
  return values.toSorted((a, b) => a - b)[Math.floor(values.length / 2)];
}
