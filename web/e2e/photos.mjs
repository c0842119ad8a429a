// Photos are localized, the view flies there, and what was asked is copied.
import { localize, openMap, typeCamera } from "./steps.mjs";

export default async function ({ browser, url, camera, photos }) {
  const { context, page, seen } = await openMap(browser, url, "room");
  await context.grantPermissions(["clipboard-read", "clipboard-write"]);
  await typeCamera(page, camera);
  await page.locator("#panel-photo summary", { hasText: "Options" }).click();
  const solver = page.locator("#option-solver");
  await solver.selectOption("poselib");
  const solvers = await solver.locator("option").allInnerTexts();
  const results = [];
  for (const photo of photos) {
    const { answer, problem } = await localize(page, photo);
    results.push({ answer, problem, view: await page.evaluate(() => visloc.view) });
  }
  const shown = await page.getByRole("tabpanel", { name: "Photo" }).innerText();
  return {
    ...seen,
    results,
    shown,
    solvers,
    marked: await marked(page),
    copied: await copied(page),
  };
}

/** Pixels of the photo's picture in the green of inliers. */
function marked(page) {
  return page.getByRole("img", { name: /inliers/ }).evaluate((canvas) => {
    const { data } = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
    let count = 0;
    for (let i = 0; i < data.length; i += 4) {
      const [red, green, blue] = data.subarray(i, i + 3);
      if (green > 170 && green - red > 80 && green - blue > 40) count += 1;
    }
    return count;
  });
}

/** What each of the buttons puts on the clipboard. */
async function copied(page) {
  const texts = {};
  for (const name of ["JSON", "curl", "Python"]) {
    await page.getByRole("tab", { name, exact: true }).click();
    await page.getByRole("button", { name: `Copy ${name}` }).click();
    await page
      .getByRole("status")
      .filter({ hasText: `${name} copied` })
      .waitFor();
    texts[name] = await page.evaluate(() => navigator.clipboard.readText());
  }
  return texts;
}
