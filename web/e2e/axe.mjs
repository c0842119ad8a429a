// What axe-core finds wrong with a page for those who see, hear or move differently.
import { readFile } from "node:fs/promises";

const AXE = new URL("../node_modules/axe-core/axe.min.js", import.meta.url);

/** Serious and critical faults, a text each. */
export async function axeFaults(page) {
  if (!(await page.evaluate(() => "axe" in window)))
    await page.evaluate(await readFile(AXE, "utf-8"));
  return page.evaluate(async () => {
    const { violations } = await axe.run({ resultTypes: ["violations"] });
    return violations
      .filter(({ impact }) => impact === "serious" || impact === "critical")
      .flatMap(({ id, nodes }) =>
        nodes.map(({ html, failureSummary }) => `${id}: ${html} ${failureSummary}`),
      );
  });
}
