// The question and its answer as text to take along: JSON, a line for a shell, lines of Python.
import { cameraText, type Camera, type LocalizeResponse } from "visloc-client";

/** What was asked. */
export interface Question {
  /** Address of the service; ends in a slash. */
  server: URL;
  /** Each an id or `id@version`. */
  maps: string[];
  /** Name of the photo's file. A browser does not tell its folder. */
  photo: string;
  camera: Camera | null;
  options: Record<string, string | number>;
  /** Whether an API key was sent. It is never part of a text: that names the variable. */
  withKey: boolean;
}

/** The answer as the lines below get it: they do not ask for the matches and their picture. */
export function answerJson(answer: LocalizeResponse): string {
  const text = JSON.stringify({ ...answer, debug: null }, null, 2);
  // Lists of numbers on one line; texts are passed over, as what they hold may look like one.
  return text.replace(/"(?:\\.|[^"\\])*"|\[[-+.\deE,\s]+\]/g, (found) =>
    found.startsWith("[")
      ? found.replace(/\s+/g, " ").replace("[ ", "[").replace(" ]", "]")
      : found,
  );
}

/** One line for a shell, for the folder in which the photo lies. */
export function curlLine(question: Question): string {
  const parts = ["curl"];
  // Double quotes, so that the shell puts the key in.
  if (question.withKey) parts.push('-H "Authorization: Bearer $VISLOC_API_KEY"');
  parts.push(`-F ${shellQuoted(`image=@${curlFile(question.photo)}`)}`);
  const [map = "", ...others] = question.maps;
  parts.push(curlText(others.length > 0 ? "maps" : "map", [map, ...others].join(",")));
  if (question.camera !== null) parts.push(curlText("camera", cameraText(question.camera)));
  if (Object.keys(question.options).length > 0) {
    parts.push(curlText("options", JSON.stringify(question.options)));
  }
  parts.push(shellQuoted(new URL("localize", question.server).href));
  return parts.join(" ");
}

/** Lines for Python with the package `clients` (clients/client.py). */
export function pythonLines(question: Question): string {
  const { camera, options } = question;
  const base = question.server.href.replace(/\/$/, "");
  const server = [pythonText(base)];
  if (question.withKey) server.push('api_key=os.environ["VISLOC_API_KEY"]');
  const [map = "", ...others] = question.maps.map(pythonText);
  const where = others.length > 0 ? `[${[map, ...others].join(", ")}]` : map;
  const asked = [pythonText(question.photo), where];
  const hasOptions = Object.keys(options).length > 0;
  if (camera !== null) asked.push("camera");
  if (hasOptions) asked.push(camera === null ? "options=options" : "options");

  const lines: string[] = [];
  if (question.withKey) lines.push("import os", "");
  lines.push("from clients import Client");
  if (camera !== null) lines.push("from visloc import Camera");
  lines.push("");
  if (camera !== null) {
    const { model, width, height, params } = camera;
    const numbers = [width, height, `(${params.join(", ")})`].join(", ");
    lines.push(`camera = Camera(${pythonText(model)}, ${numbers})`);
  }
  if (hasOptions) {
    const entries = Object.entries(options).map(
      ([name, value]) => `${pythonText(name)}: ${pythonValue(value)}`,
    );
    lines.push(`options = {${entries.join(", ")}}`);
  }
  lines.push(
    `with Client(${server.join(", ")}) as client:`,
    `    answer = client.localize(${asked.join(", ")})`,
    "print(answer.pose.position if answer.localized else answer.refusal)",
  );
  return lines.join("\n");
}

/**
 * Quote one word for a shell. What controls a terminal, or turns text around, is escaped as
 * `$'...'` has it (POSIX 2024; bash, zsh and ksh before), so that pasting the line is safe and what
 * one sees is what runs.
 */
export function shellQuoted(word: string): string {
  if (/^[A-Za-z0-9_@%+=:,./-]+$/.test(word)) return word;
  if (!UNSEEN.test(word)) return `'${word.replaceAll("'", "'\\''")}'`;
  const escaped = word
    .replace(/[\\']/g, "\\$&")
    .replace(new RegExp(UNSEEN, "gu"), (character) =>
      [...new TextEncoder().encode(character)]
        .map((byte) => `\\${byte.toString(8).padStart(3, "0")}`)
        .join(""),
    );
  return `$'${escaped}'`;
}

// Characters that control, format, or separate lines, and halves of characters.
const UNSEEN = /[\p{Cc}\p{Cf}\p{Zl}\p{Zp}\p{Cs}]/u;

/** A file for `-F name=@...`: in quotes, as commas and semicolons have a meaning outside. */
function curlFile(name: string): string {
  // To curl, a file "-" is the standard input, in quotes too.
  const file = name === "-" ? "./-" : name;
  return `"${file.replace(/[\\"]/g, "\\$&")}"`;
}

/** A text of the form. With -F, `@` and `<` at its beginning name files, and `;` begins a type. */
function curlText(name: string, value: string): string {
  const option = /^[@<]|;/.test(value) ? "--form-string" : "-F";
  return `${option} ${shellQuoted(`${name}=${value}`)}`;
}

/** A literal of Python, in which nothing is unseen. JSON's escapes are Python's too. */
function pythonText(text: string): string {
  return JSON.stringify(text).replace(new RegExp(UNSEEN, "gu"), (character) => {
    const hex = character.codePointAt(0)!.toString(16);
    return hex.length > 4 ? `\\U${hex.padStart(8, "0")}` : `\\u${hex.padStart(4, "0")}`;
  });
}

function pythonValue(value: string | number): string {
  return typeof value === "number" ? String(value) : pythonText(value);
}
