// What a user does, by the names that the page gives things.
import { readFile } from "node:fs/promises";
import { openWatched, until } from "./watched.mjs";

/** Open the page, choose a map and wait for its landmarks. */
export async function openMap(browser, url, map, options) {
  const opened = await openWatched(browser, `${url}/`, options);
  await until(opened.page, () => visloc.map);
  await opened.page.getByRole("combobox", { name: "Map", exact: true }).selectOption(map);
  await until(
    opened.page,
    (id) => visloc.map?.id === id && visloc.statistics.pointsLoaded === visloc.map.landmarks,
    map,
  );
  return opened;
}

export async function openTab(page, name) {
  await page.getByRole("tab", { name, exact: true }).click();
}

/** `text` as the command line takes a camera; null for what the photo's EXIF says. */
export async function typeCamera(page, text) {
  await openTab(page, "Photo");
  const typed = page.getByRole("radio", { name: "Typed" });
  if (!(await typed.isVisible())) await page.locator("#panel-photo summary").first().click();
  if (text === null) return page.getByRole("radio", { name: "From the photo’s EXIF" }).check();
  await typed.check();
  await page.getByLabel("As text, if you have it so").fill(text);
}

/** Give the page a photo by a file that is "dropped", "chosen" or "pasted". */
export async function givePhoto(page, { path, name, way }) {
  const buffer = await readFile(path);
  if (way === "chosen") {
    return page.getByLabel("Choose photos").setInputFiles({ name, mimeType: "image/jpeg", buffer });
  }
  const bytes = [...buffer];
  return page.evaluate(
    ({ bytes, name, way }) => {
      const data = new DataTransfer();
      data.items.add(new File([new Uint8Array(bytes)], name, { type: "image/jpeg" }));
      const given = { bubbles: true, cancelable: true };
      document.body.dispatchEvent(
        way === "dropped"
          ? new DragEvent("drop", { ...given, dataTransfer: data })
          : new ClipboardEvent("paste", { ...given, clipboardData: data }),
      );
    },
    { bytes, name, way },
  );
}

/** Give a photo and wait for what comes of it: {answer, problem}, one of them null. */
export async function localize(page, photo) {
  const before = await page.evaluate(() => visloc.answer?.request_id ?? null);
  await givePhoto(page, photo);
  return until(
    page,
    (before) =>
      (visloc.problem !== null ||
        (visloc.answer !== null && visloc.answer.request_id !== before)) && {
        answer: visloc.answer,
        problem: visloc.problem,
      },
    before,
  );
}
