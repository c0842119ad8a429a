// Runs scenarios in one browser, for tests/e2e/test_page.py: reads a line of JSON
// {"scenario": NAME, ...}, runs NAME.mjs beside this file, and answers with a line
// {"seen": {...}} or {"failed": "..."}.
//
//     node web/e2e/driver.mjs CHROMIUM VIDEO
//
// VIDEO, frames as concatenated JPEG files, is what the browser's fake camera sees.
import { createInterface } from "node:readline";
import { launch } from "./browser.mjs";
import { watched } from "./watched.mjs";

const LONGEST_MS = 60_000;
const [executablePath, video] = process.argv.slice(2);

const browser = await launch(executablePath, video);

async function run(scenario, given) {
  const { default: play } = await import(`./${scenario}.mjs`);
  const late = new Promise((_, reject) => {
    setTimeout(() => reject(new Error(`no end after ${LONGEST_MS} ms`)), LONGEST_MS).unref();
  });
  const contexts = new Set(browser.contexts());
  try {
    return await Promise.race([play({ browser, ...given }), late]);
  } finally {
    for (const context of browser.contexts()) if (!contexts.has(context)) await context.close();
  }
}

for await (const line of createInterface({ input: process.stdin })) {
  const { scenario, ...given } = JSON.parse(line);
  const answer = await run(scenario, given).then(
    (seen) => ({ seen }),
    (error) => ({
      failed: [error.stack, "Console:", ...(watched.at(-1)?.console ?? [])].join("\n"),
    }),
  );
  process.stdout.write(`${JSON.stringify(answer)}\n`);
}
await browser.close();
