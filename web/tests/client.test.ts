import { afterEach, describe, expect, test, vi } from "vitest";
import {
  connect,
  localizeForm,
  mapRef,
  ServiceError,
  type Features,
  type LocalizeCall,
  type SequenceCall,
} from "visloc-client";

const BASE = new URL("https://maps.example.org/visloc/");
const CALL: LocalizeCall = {
  map: "kitchen",
  image: new Blob(["photo"]),
  name: 'a "b".jpg',
  camera: null,
  options: {},
};

const FEATURES: Features = {
  kind: "xfeat",
  keypoints: new Float32Array([0.5, 0.5, 1.5, 0.5]),
  descriptors: new Int8Array([1, 2, -3, 4, 5, 6]),
  global_descriptors: { gem: new Uint8Array([7, 8]) },
};

/** Answer every request with this, and return the requests. */
function answering(respond: () => Response | Promise<Response>): Request[] {
  const asked: Request[] = [];
  vi.stubGlobal("fetch", (url: URL, init: RequestInit) => {
    asked.push(new Request(url, init));
    return Promise.resolve().then(respond);
  });
  return asked;
}

const json = (body: unknown, init: ResponseInit = {}): Response =>
  new Response(JSON.stringify(body), init);

const failure = (call: Promise<unknown>): Promise<ServiceError> =>
  call.then(
    () => expect.fail("no error"),
    (error: unknown) => {
      expect(error).toBeInstanceOf(ServiceError);
      return error as ServiceError;
    },
  );

afterEach(() => vi.unstubAllGlobals());

describe("asking", () => {
  test("goes below the address of the page, with names that are escaped", async () => {
    const asked = answering(() => json({ maps: [] }));
    const service = connect(BASE);
    await service.maps();
    await failure(service.map("kitchen@1"));
    await failure(service.points("../../evil?x#y", 5, 10));
    await failure(service.images("kitchen", 0, 1000));
    expect(asked.map(({ url }) => url)).toEqual([
      "https://maps.example.org/visloc/maps",
      "https://maps.example.org/visloc/maps/kitchen%401",
      "https://maps.example.org/visloc/maps/..%2F..%2Fevil%3Fx%23y/points?first=5&count=10",
      "https://maps.example.org/visloc/maps/kitchen/images?first=0&count=1000",
    ]);
  });

  test("sends the API key only when one is given, and the newest", async () => {
    const asked = answering(() => json({ maps: [] }));
    let key: string | null = null;
    const service = connect(BASE, { apiKey: () => key });
    await service.maps();
    key = "secret";
    await service.maps();
    expect(asked.map(({ headers }) => headers.get("Authorization"))).toEqual([
      null,
      "Bearer secret",
    ]);
  });

  test("may have one key, and an address without a slash", async () => {
    const asked = answering(() => json({ maps: [] }));
    await connect("https://maps.example.org/visloc", { apiKey: "secret" }).maps();
    expect(asked[0]!.url).toBe("https://maps.example.org/visloc/maps");
    expect(asked[0]!.headers.get("Authorization")).toBe("Bearer secret");
  });

  test("names the map for a balancer, and the time that is allowed", async () => {
    const asked = answering(() => json({}));
    await failure(connect(BASE, { timeoutSeconds: 2.5 }).map("kitchen@7"));
    await failure(connect(BASE, { timeoutSeconds: null }).maps());
    const named = asked.map(({ headers }) =>
      ["X-Visloc-Map", "X-Request-Timeout"].map((name) => headers.get(name)),
    );
    expect(named).toEqual([
      ["kitchen", "2.5"],
      [null, null],
    ]);
  });

  test("names the version that is shown", () => {
    expect(mapRef({ id: "kitchen", version: "7" })).toBe("kitchen@7");
  });
});

describe("the form of a photo", () => {
  test("holds nothing that was not chosen", () => {
    expect([...localizeForm(CALL).keys()]).toEqual(["map", "image"]);
  });

  test("holds what was, as the API has it", () => {
    const form = localizeForm({
      ...CALL,
      camera: { model: "PINHOLE", width: 640, height: 480, params: [525, 525.5, 320, 240] },
      options: { top_k: 5 },
      priors: { gnss: { latitude: 48.1, longitude: 8.2, accuracy: 4.5 } },
      debug: true,
    });
    expect(form.get("camera")).toBe("PINHOLE,640,480,525,525.5,320,240");
    expect(form.get("options")).toBe('{"top_k":5}');
    expect(form.get("priors")).toBe('{"gnss":{"latitude":48.1,"longitude":8.2,"accuracy":4.5}}');
    expect(form.get("debug")).toBe("true");
    expect((form.get("image") as File).name).toBe('a "b".jpg');
  });

  test.each([
    ["kitchen", "kitchen", null],
    [["kitchen@7"], "kitchen@7", null],
    [["kitchen@7", "hall"], null, '["kitchen@7","hall"]'],
  ])("names the map or maps %j, and the first of them to a balancer", async (map, one, many) => {
    const form = localizeForm({ ...CALL, map });
    expect([form.get("map"), form.get("maps")]).toEqual([one, many]);
    const asked = answering(() => json({}));
    await failure(connect(BASE).localize({ ...CALL, map }));
    expect(asked[0]!.headers.get("X-Visloc-Map")).toBe("kitchen");
  });

  test("names a photo that came without a name", () => {
    expect((localizeForm({ ...CALL, name: "" }).get("image") as File).name).toBe("photo");
  });

  test("takes bytes, and a mask", async () => {
    const form = localizeForm({
      map: "kitchen",
      image: new Uint8Array([1, 2, 3]),
      mask: new Blob(["m"]),
    });
    expect([...form.keys()]).toEqual(["map", "image", "mask"]);
    expect(await (form.get("image") as File).bytes()).toEqual(new Uint8Array([1, 2, 3]));
  });

  test("takes features instead", async () => {
    const form = localizeForm({ map: "kitchen", features: FEATURES });
    expect([...form.keys()]).toEqual(["map", "features"]);
    const sent = JSON.parse(await (form.get("features") as File).text());
    expect(sent).toEqual({
      kind: "xfeat",
      keypoints: { dtype: "float32", shape: [2, 2], data: "AAAAPwAAAD8AAMA/AAAAPw==" },
      descriptors: { dtype: "int8", shape: [2, 3], data: "AQL9BAUG" },
      global_descriptors: { gem: { dtype: "uint8", shape: [2], data: "Bwg=" } },
    });
  });

  test("is posted", async () => {
    const answer = {
      ...{ status: "not_localized", camera: {}, orientation: {}, retrieved: [], map: {} },
      ...{ seconds: {} },
    };
    const asked = answering(() => json(answer));
    expect(await connect(BASE).localize(CALL)).toEqual(answer);
    expect(asked[0]!.method).toBe("POST");
    expect(asked[0]!.headers.get("Content-Type")).toMatch(/^multipart\/form-data/);
  });
});

describe("the form of a rig", () => {
  test("has a file for each photo, which the request names", async () => {
    const answer = { status: "not_localized", images: [], map: {}, seconds: {} };
    const asked = answering(() => json(answer));
    const image = new Blob(["left"]);
    const mask = new Blob(["mask"]);
    const images = [
      { sensor: "left", image, mask, timestamp: 5 },
      { sensor: "right", features: FEATURES },
    ];
    await connect(BASE).localizeRig({ map: "kitchen@7", rig: "rig", images });
    expect(asked[0]!.url).toBe("https://maps.example.org/visloc/localize/rig");
    expect(asked[0]!.headers.get("X-Visloc-Map")).toBe("kitchen");
    const form = await asked[0]!.formData();
    const request = JSON.parse(form.get("request") as string);
    expect(request.images[0]).toEqual({
      ...{ sensor: "left", timestamp: 5, part: "image0", mask_part: "image1" },
    });
    expect(request.images[1].features.kind).toBe("xfeat");
    expect(request).toMatchObject({ map: "kitchen@7", rig: "rig" });
    expect(await (form.get("image0") as File).text()).toBe("left");
    expect(await (form.get("image1") as File).text()).toBe("mask");
  });
});

describe("a sequence", () => {
  const instant = { status: "localized", images: [], map: {}, seconds: {} };
  const CALL: SequenceCall = {
    map: "kitchen",
    instants: [0, 1].map((timestamp) => ({ timestamp, images: [] })),
  };

  /** Answer with these pieces of NDJSON. */
  function saying(...pieces: string[]): Request[] {
    const headers = { "Content-Type": "application/x-ndjson" };
    return answering(() => {
      const bytes = pieces.map((piece) => new TextEncoder().encode(piece));
      return new Response(new Blob(bytes).stream(), { headers });
    });
  }

  async function answers(given = CALL): Promise<{ came: string[]; error: ServiceError | null }> {
    const came: string[] = [];
    try {
      for await (const each of connect(BASE).localizeSequence(given)) came.push(each.status);
    } catch (error) {
      return { came, error: error as ServiceError };
    }
    return { came, error: null };
  }

  const line = JSON.stringify(instant) + "\n";

  test("is posted as a form, and its answers are lines", async () => {
    const asked = saying(line.slice(0, 7), line.slice(7) + line);
    const images = [{ image: new Blob(["a"]) }];
    const instants = [0, 1].map((timestamp) => ({ timestamp, images }));
    expect(await answers({ ...CALL, instants })).toEqual({
      came: ["localized", "localized"],
      error: null,
    });
    expect(asked[0]!.headers.get("Accept")).toBe("application/x-ndjson");
    const form = await asked[0]!.formData();
    expect([...form.keys()].sort()).toEqual(["image0", "image1", "request"]);
    expect(JSON.parse(String(form.get("request")))).toEqual({
      map: "kitchen",
      instants: [0, 1].map((timestamp) => ({ timestamp, images: [{ part: `image${timestamp}` }] })),
    });
  });

  test("may end with an error, after the answers before it", async () => {
    const problem = { status: 400, code: "priors.maps", detail: "no such tile", field: "priors" };
    saying(line + JSON.stringify({ problem }) + "\n");
    const { came, error } = await answers();
    expect(came).toEqual(["localized"]);
    expect(error).toMatchObject({ code: "priors.maps", field: "priors", message: "no such tile" });
    expect(error!.problem.status).toBe(400);
  });

  test.each([
    ["half a line", line + line.slice(0, 9)],
    ["fewer answers than instants", line],
    ["a line that is no answer", line + "{}\n"],
    ["a line that is not JSON", line + "<html>\n"],
  ])("is no answer of the service: %s", async (_, body) => {
    saying(body);
    const { came, error } = await answers();
    expect(came).toEqual(["localized"]);
    expect(error!.code).toBe("server.answer");
  });

  test("is no answer of the service where something else answers", async () => {
    answering(() => json({ hello: "world" }));
    expect((await answers()).error!.code).toBe("server.answer");
  });
});

describe("the options of a query", () => {
  test("are read from the description of the API", async () => {
    const solver = { title: "pose solver", enum: ["pycolmap", null], default: "pycolmap" };
    const schemas = { LocalizeOptions: { properties: { solver } } };
    const asked = answering(() => json({ components: { schemas } }));
    expect(await connect(BASE).options()).toEqual({ solver });
    expect(asked[0]!.url).toBe("https://maps.example.org/visloc/openapi.json");
  });

  test("are no options where something else answers", async () => {
    answering(() => json({ components: {} }));
    const { problem } = await failure(connect(BASE).options());
    expect(problem.code).toBe("server.answer");
  });
});

describe("errors", () => {
  test("are the service's problem details", async () => {
    const problem = {
      title: "Unprocessable Entity",
      status: 422,
      detail: "wrong number of parameters for PINHOLE",
      code: "camera.param_count",
      field: "camera.params",
      expected: "4: fx, fy, cx, cy",
      got: "3",
      request_id: "f38b",
    };
    answering(() =>
      json({ type: "about:blank", kind: "InvalidInput", ...problem }, { status: 422 }),
    );
    const error = await failure(connect(BASE).localize(CALL));
    expect(error.problem).toEqual(problem);
    expect(error.message).toBe(problem.detail);
    expect(error.retryAfterSeconds).toBeNull();
  });

  test("say how long to wait, when the service does", async () => {
    const headers = { "Retry-After": "7" };
    answering(() => json({ code: "server.busy", detail: "busy" }, { status: 429, headers }));
    expect((await failure(connect(BASE).maps())).retryAfterSeconds).toBe(7);
  });

  test("tell a proxy's page from an error of the service", async () => {
    answering(() => new Response("<h1>Bad gateway</h1>", { status: 502 }));
    const { problem } = await failure(connect(BASE).maps());
    expect([problem.code, problem.status]).toEqual(["server.answer", 502]);
  });

  test.each([
    ["0", 0.5],
    ["-3", 0.5],
    ["99999999", 3600],
    ["Wed, 21 Oct 2026 07:28:00 GMT", null],
  ])("that ask to wait %s are waited after for %s s", async (asked, seconds) => {
    answering(() => json({}, { status: 429, headers: { "Retry-After": asked } }));
    expect((await failure(connect(BASE).maps())).retryAfterSeconds).toBe(seconds);
  });

  describe.each([
    ["no JSON", () => new Response("<h1>Sign in</h1>")],
    ["another JSON", () => json({ hello: 1, status: "ok" })],
    ["a number", () => json(7)],
    ["null", () => json(null)],
  ])("an answer that is %s is none", (_, respond) => {
    const service = connect(BASE);
    test.each([
      ["maps", () => service.maps()],
      ["map", () => service.map("kitchen")],
      ["images", () => service.images("kitchen", 0, 10)],
      ["localize", () => service.localize(CALL)],
    ])("to %s", async (_, call) => {
      answering(respond);
      expect((await failure(call())).problem.code).toBe("server.answer");
    });
  });

  test.each([
    ["not there", "https://app.example.org", false, "server.unreachable"],
    ["there, and does not allow the page", "https://app.example.org", true, "access.origin"],
    ["there, and does not allow an app", "capacitor://localhost", true, "access.origin"],
    ["not there, for its own page", BASE.origin, false, "server.unreachable"],
    ["in trouble, for its own page", BASE.origin, true, "server.unreachable"],
  ])("of a service that is %s, a page of %s is told", async (_, origin, isThere, code) => {
    vi.stubGlobal("location", { origin });
    const probes: string[] = [];
    vi.stubGlobal("fetch", async (url: URL, init: RequestInit) => {
      if (init.mode === "no-cors") probes.push(url.href);
      if (init.mode === "no-cors" && isThere) return new Response();
      throw new TypeError("Failed to fetch");
    });
    const { problem } = await failure(connect(BASE).maps());
    expect([problem.code, problem.status]).toEqual([code, 0]);
    if (code === "access.origin") expect(problem.got).toBe(origin);
    // Nothing is asked twice of a page's own service.
    expect(probes).toEqual(
      origin === BASE.origin ? [] : ["https://maps.example.org/visloc/healthz"],
    );
  });

  test("a service that is not there is unreachable", async () => {
    answering(() => Promise.reject(new TypeError("Failed to fetch")));
    const { problem } = await failure(connect(BASE).maps());
    expect([problem.code, problem.status]).toEqual(["server.unreachable", 0]);
  });

  test.each([
    ["is being stopped", () => json({ code: "server.stopping" }, { status: 503 })],
    ["is behind a balancer that lost it", () => new Response("", { status: 502 })],
    ["broke the connection", () => Promise.reject(new TypeError("Failed to fetch"))],
  ])("a service that %s is asked once more, with the whole form", async (_, fail) => {
    const answers = [fail, () => json({ code: "image.empty" }, { status: 422 })];
    const asked = answering(() => answers.shift()!());
    expect((await failure(connect(BASE).localize(CALL))).code).toBe("image.empty");
    expect(asked).toHaveLength(2);
    expect(await ((await asked[1]!.formData()).get("image") as File).text()).toBe("photo");
  });

  test("of a service that is merely busy are not repeated", async () => {
    const asked = answering(() => json({ code: "server.busy" }, { status: 503 }));
    expect((await failure(connect(BASE).maps())).code).toBe("server.busy");
    expect(asked).toHaveLength(1);
  });

  test("tell a service that does not answer in time", async () => {
    vi.stubGlobal(
      "fetch",
      (_: URL, { signal }: RequestInit) =>
        new Promise((_, reject) =>
          signal!.addEventListener("abort", () => reject(signal!.reason as Error)),
        ),
    );
    const error = await failure(connect(BASE, { timeoutSeconds: 0.05 }).maps());
    expect([error.code, error.expected]).toEqual(["server.timeout", "an answer within 0.05 s"]);
    const gone = new Error("gone");
    const stop = new AbortController();
    const asked = connect(BASE).maps(stop.signal);
    stop.abort(gone);
    await expect(asked).rejects.toBe(gone);
  });

  test("are landmarks that are none", async () => {
    answering(() => new Response("<h1>Sign in</h1>"));
    const { code, message } = await failure(connect(BASE).points("kitchen", 0, 10));
    expect(code).toBe("server.answer");
    expect(message).toMatch(/less than their header/);
  });

  test("what the page itself gave up is no error of the service", async () => {
    const aborted = new DOMException("given up", "AbortError");
    answering(() => Promise.reject(aborted));
    const signal = AbortSignal.abort(aborted);
    await expect(connect(BASE).maps(signal)).rejects.toBe(aborted);
  });
});
