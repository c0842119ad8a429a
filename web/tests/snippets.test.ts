import { spawn, spawnSync } from "node:child_process";
import { mkdtempSync, rmSync, writeFileSync } from "node:fs";
import { createServer } from "node:http";
import { tmpdir } from "node:os";
import { join } from "node:path";
import { describe, expect, test } from "vitest";
import client from "../../clients/client.py?raw";
import type { LocalizeResponse } from "visloc-client";
import {
  answerJson,
  curlLine,
  pythonLines,
  shellQuoted,
  type Question,
} from "../src/page/snippets";

const PLAIN: Question = {
  server: new URL("http://127.0.0.1:8000/"),
  maps: ["kitchen"],
  photo: "photo.jpg",
  camera: null,
  options: {},
  withKey: false,
};
const FULL: Question = {
  ...PLAIN,
  maps: ["kitchen@20261121T111436.881Z-7f9cafe0"],
  camera: { model: "PINHOLE", width: 640, height: 480, params: [525, 525.5, 320, 1e-7] },
  options: { top_k: 5, solver: "poselib" },
};

// What files may be called: quotes, blanks, line breaks, beginnings that mean something to curl,
// to the shell or to a terminal, and text that runs the other way.
const HOSTILE = [
  "a b.jpg",
  'say "hi".jpg',
  "it's.jpg",
  "back\\slash.jpg",
  "line\nbreak.jpg",
  "tab\tand\rreturn.jpg",
  "-F.jpg",
  "-",
  "--help",
  "@photo.jpg",
  "<photo.jpg",
  "a;type=text.jpg",
  "a,b.jpg",
  "$(touch owned).jpg",
  "`touch owned`.jpg",
  "; touch owned; .jpg",
  "\u001b[31mred.jpg",
  "\u202egpj.exe",
  "'; $'\\n\u0007.jpg",
  "!!.jpg",
  "~.jpg",
  "*?.jpg",
  "ü写真😀.jpg",
  "\\'\\\\'\\\".jpg",
];

const bash = (script: string, cwd?: string): string => {
  const run = spawnSync("bash", ["-c", script], { encoding: "utf8", cwd });
  expect(run.stderr).toBe("");
  return run.stdout;
};

describe("a word for the shell", () => {
  test.each([...HOSTILE, "", "plain.jpg"])("%j is one word, the same", (word) => {
    expect(bash(`printf '%s|' ${shellQuoted(word)}`)).toBe(`${word}|`);
  });

  test.each(HOSTILE)("%j fits one line, with nothing unseen", (word) => {
    expect(shellQuoted(word)).not.toMatch(/[\p{Cc}\p{Cf}\u2028\u2029]/u);
  });
});

describe("the curl line", () => {
  test("is that of the documentation", () => {
    expect(curlLine(PLAIN)).toBe(
      `curl -F 'image=@"photo.jpg"' -F map=kitchen http://127.0.0.1:8000/localize`,
    );
    expect(curlLine(FULL)).toBe(
      `curl -F 'image=@"photo.jpg"' -F map=kitchen@20261121T111436.881Z-7f9cafe0 ` +
        `-F camera=PINHOLE,640,480,525,525.5,320,1e-7 ` +
        `-F 'options={"top_k":5,"solver":"poselib"}' http://127.0.0.1:8000/localize`,
    );
  });

  test("names the variable of the key only when a key was sent", () => {
    expect(curlLine(PLAIN)).not.toContain("VISLOC_API_KEY");
    expect(curlLine({ ...PLAIN, withKey: true })).toContain(
      `-H "Authorization: Bearer $VISLOC_API_KEY"`,
    );
  });

  test("keeps the path of a service behind a proxy", () => {
    const server = new URL("https://maps.example.org/visloc/");
    expect(curlLine({ ...PLAIN, server })).toContain("https://maps.example.org/visloc/localize");
  });

  test.each(HOSTILE)("of %j gives curl that one file and runs nothing else", (photo) => {
    const line = curlLine({ ...PLAIN, photo });
    const words = bash(`curl() { printf '%s\\0' "$@"; }; ${line}`).split("\0");
    expect(words).toHaveLength(6); // the last one is empty
    expect(words[1]).toMatch(/^image=@"(\.\/-|[^]*)"$/);
    const quoted = words[1]!.slice('image=@"'.length, -1);
    expect(quoted.replace(/\\(["\\])/g, "$1")).toBe(photo === "-" ? "./-" : photo);
  });

  test.skipIf(spawnSync("curl", ["--version"]).error)(
    "sends the file when it runs, whatever the file is called",
    async () => {
      const folder = mkdtempSync(join(tmpdir(), "visloc-snippets-"));
      const bodies: string[] = [];
      const server = createServer((request, response) => {
        let body = `${request.headers["authorization"]}\n`;
        request.on("data", (part) => (body += new TextDecoder().decode(part)));
        request.on("end", () => {
          bodies.push(body);
          response.end();
        });
      });
      await new Promise<void>((listening) => server.listen(0, "127.0.0.1", listening));
      const { port } = server.address();
      const lines = HOSTILE.map((photo, i) => {
        writeFileSync(join(folder, photo), `photo ${i}.`);
        const question = { ...FULL, server: new URL(`http://127.0.0.1:${port}/`), photo };
        return curlLine({ ...question, withKey: true });
      });
      writeFileSync(join(folder, "run.sh"), lines.join("\n"));
      const env = { ...process.env, VISLOC_API_KEY: "secret", no_proxy: "127.0.0.1" };
      const run = spawn("bash", ["run.sh"], { cwd: folder, env, stdio: "ignore" });
      await new Promise((ended) => run.on("close", () => ended(null)));
      server.close();
      rmSync(folder, { recursive: true });

      expect(bodies).toHaveLength(HOSTILE.length);
      bodies.forEach((body, i) => {
        expect(body).toMatch(/^Bearer secret\n/);
        expect(body).toContain(`photo ${i}.`);
        expect(body).toContain("PINHOLE,640,480,525,525.5,320,1e-7");
        expect(body).toContain('{"top_k":5,"solver":"poselib"}');
      });
    },
  );
});

describe("the Python lines", () => {
  test("are those of the documentation", () => {
    expect(pythonLines(FULL)).toBe(
      [
        "from clients import Client",
        "from visloc import Camera",
        "",
        'camera = Camera("PINHOLE", 640, 480, (525, 525.5, 320, 1e-7))',
        'options = {"top_k": 5, "solver": "poselib"}',
        'with Client("http://127.0.0.1:8000") as client:',
        '    answer = client.localize("photo.jpg", "kitchen@20261121T111436.881Z-7f9cafe0", ' +
          "camera, options)",
        "print(answer.pose.position if answer.localized else answer.refusal)",
      ].join("\n"),
    );
  });

  test("name options when there is no camera, and the variable of the key", () => {
    const lines = pythonLines({ ...PLAIN, options: { top_k: 5 }, withKey: true });
    expect(lines).toContain('client.localize("photo.jpg", "kitchen", options=options)');
    expect(lines).toContain('api_key=os.environ["VISLOC_API_KEY"]');
    expect(lines).not.toContain("Camera");
  });

  // Stand-ins for the two packages; tests/ of the service run such lines against the real ones.
  const STAND_INS = `
import json, sys, types
class Client:
    def __init__(self, server, *, api_key=None): self.server = server
    def __enter__(self): return self
    def __exit__(self, *error): pass
    def localize(self, query, map, camera=None, options=None):
        print(json.dumps([self.server, query, map, camera, options]))
        return types.SimpleNamespace(localized=False, refusal="-")
sys.modules["clients"] = types.SimpleNamespace(Client=Client)
sys.modules["visloc"] = types.SimpleNamespace(Camera=lambda *camera: camera)
`;
  test.each(HOSTILE)("of %j are read as that name", (photo) => {
    const lines = pythonLines({ ...FULL, photo });
    expect(lines).not.toMatch(/[^\P{Cc}\n]|\p{Cf}/u);
    const run = spawnSync("python3", ["-"], { input: STAND_INS + lines, encoding: "utf8" });
    expect(run.stderr).toBe("");
    expect(JSON.parse(run.stdout.split("\n")[0]!)).toEqual([
      "http://127.0.0.1:8000",
      photo,
      FULL.maps[0],
      ["PINHOLE", 640, 480, [525, 525.5, 320, 1e-7]],
      FULL.options,
    ]);
  });

  test.each([
    [["kitchen"], "-F map=kitchen", '"photo.jpg", "kitchen")'],
    [["kitchen", "hall"], "-F maps=kitchen,hall", '"photo.jpg", ["kitchen", "hall"])'],
  ])("name the maps %j", (maps, curl, python) => {
    expect(curlLine({ ...PLAIN, maps })).toContain(curl);
    expect(pythonLines({ ...PLAIN, maps })).toContain(python);
  });

  test("fit the signature of the client", () => {
    const signature = /def localize\(\s*self,([^)]*)\)/.exec(client)![1]!;
    const names = [...signature.matchAll(/^\s*(\w+):/gm)].map((match) => match[1]);
    expect(names.slice(0, 4)).toEqual(["query", "map", "camera", "options"]);
  });
});

test("the JSON is the answer without its matches, lists of numbers on a line", () => {
  const answer = {
    status: "localized",
    pose: { position: [0.25, -1, 3e-7] },
    retrieved: [
      { image: "[ 1,\n 2 ].jpg", score: 1 },
      { image: 'a[ 1,  2 ]"[ 3,  4 ]\\.jpg', score: 1 },
    ],
    debug: { keypoints: [1, 2], points: [], inliers: [true], overlay: "AAAA" },
  } as unknown as LocalizeResponse;
  const text = answerJson(answer);
  expect(text).toContain('"position": [0.25, -1, 3e-7]');
  expect(JSON.parse(text)).toEqual({ ...answer, debug: null });
});
