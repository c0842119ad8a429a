// Lines of an answer that comes piece by piece.

/** The lines of a body in UTF-8, without those that are empty. Throws where the last is cut off. */
export async function* lines(response: Response): AsyncGenerator<string, void> {
  if (response.body === null) return;
  const decoder = new TextDecoder();
  const reader = response.body.getReader();
  let rest = "";
  for (;;) {
    const { done, value } = await reader.read();
    if (done) break;
    const [first, ...others] = decoder.decode(value, { stream: true }).split("\n");
    if (others.length === 0) {
      rest += first;
      continue;
    }
    yield* [rest + first, ...others.slice(0, -1)].filter((line) => line.trim() !== "");
    rest = others.at(-1)!;
  }
  if ((rest + decoder.decode()).trim() !== "")
    throw new Error(`half a line: ${rest.length} characters`);
}
