// Speaks the service's HTTP API (docs/api.md), in browsers and in Node.js.
//
// What the service answers is taken for what it says it is; what is no answer of the service, such
// as a proxy's page, is told apart here, so that callers meet one kind of error: ServiceError.
import { lineError, noAnswer, ownError, serviceError, type ServiceError } from "./errors.js";
import { lines } from "./lines.js";
import { parsePoints, PointsError, type PointBlock } from "./points.js";
import {
  localizeForm,
  rigForm,
  sequenceForm,
  type LocalizeCall,
  type RigCall,
  type SequenceCall,
} from "./requests.js";
import type { LocalizeResponse, MapImages, MapInfo, OptionSchema, RigResponse } from "./words.js";

/** Before a request is sent a second time, to another server behind the same address. */
const RESEND_PAUSE_MS = 100;
const DEFAULT_TIMEOUT_S = 60;
const PROBE_MS = 3000;
const NDJSON = "application/x-ndjson";
const RIG_MEMBERS = ["status", "images", "map", "seconds"] as const;

export interface Settings {
  /** A function is asked before each request; null for none. */
  apiKey?: string | (() => string | null);
  /** Longest wait for an answer, seconds; the service gets the same limit. Null: the service's own. */
  timeoutSeconds?: number | null;
}

/** Every method throws ServiceError, or what `signal` was aborted with. */
export interface Client {
  /** Say where a photo was taken: a pose, or why there is none. */
  localize(call: LocalizeCall, signal?: AbortSignal): Promise<LocalizeResponse>;
  /** Say where several cameras that move together are, from their photos of one instant. */
  localizeRig(call: RigCall, signal?: AbortSignal): Promise<RigResponse>;
  /**
   * Say where a camera or a rig was at the instants of a walk, one answer for each, in their order:
   * `for await (const answer of client.localizeSequence(call))`. An answer comes as soon as no later
   * instant can change it. The time limit is for each answer. Leaving the loop ends the work.
   */
  localizeSequence(call: SequenceCall, signal?: AbortSignal): AsyncGenerator<RigResponse, void>;
  maps(signal?: AbortSignal): Promise<MapInfo[]>;
  /** Describe one map: an id or `id@version`. */
  map(ref: string, signal?: AbortSignal): Promise<MapInfo>;
  /** Landmarks in an order of which every beginning is an even sample of the map. */
  points(ref: string, first: number, count: number, signal?: AbortSignal): Promise<PointBlock>;
  /** Where the mapping photos were taken, in the map's order. */
  images(ref: string, first: number, count: number, signal?: AbortSignal): Promise<MapImages>;
  /** The options of a query, by name. */
  options(): Promise<Record<string, OptionSchema>>;
}

/** Speak with the service at an address, such as `http://127.0.0.1:8000`. Nothing is sent yet. */
export function connect(server: string | URL, settings: Settings = {}): Client {
  const base = new URL(server);
  if (!base.pathname.endsWith("/")) base.pathname += "/";
  const { apiKey = null, timeoutSeconds = DEFAULT_TIMEOUT_S } = settings;

  /** Ask once more where another server may answer: all that is asked here changes nothing. */
  async function ask(path: string, request: Asking): Promise<Response> {
    const first = await once(path, request);
    if (first instanceof Response && first.ok) return first;
    const error = first instanceof Response ? await serviceError(first) : first;
    if (!mayResend(error)) throw error;
    await new Promise((resolve) => setTimeout(resolve, RESEND_PAUSE_MS));
    request.signal?.throwIfAborted();
    const second = await once(path, request);
    if (!(second instanceof Response)) throw (await keptFrom(second, request)) ?? second;
    if (!second.ok) throw await serviceError(second);
    return second;
  }

  /**
   * A browser says the same of a service that is not there and of one that does not allow the page.
   * What it may not read it can still ask for: an answer tells that somebody is there.
   */
  async function keptFrom({ code }: ServiceError, request: Asking): Promise<ServiceError | null> {
    const page = (globalThis as { location?: Location }).location?.origin ?? base.origin;
    if (code !== "server.unreachable" || page === base.origin) return null;
    const limits = [AbortSignal.timeout(PROBE_MS), ...(request.limit ? [request.limit] : [])];
    const signal = AbortSignal.any(limits);
    try {
      await fetch(new URL("healthz", base), { mode: "no-cors", credentials: "omit", signal });
    } catch {
      request.signal?.throwIfAborted();
      return null;
    }
    const detail =
      "the service is there, but it does not allow pages of this origin to read its answers";
    return ownError("access.origin", "Not allowed", detail, {
      expected: "an origin that the service's operator allows (--cors-origins)",
      got: page,
    });
  }

  async function once(path: string, request: Asking): Promise<Response | ServiceError> {
    const headers = new Headers();
    const given = typeof apiKey === "function" ? apiKey() : apiKey;
    if (given !== null) headers.set("Authorization", `Bearer ${given}`);
    // A balancer sends the requests of a map to the server that has it open.
    const first = typeof request.map === "string" ? request.map : request.map?.[0];
    if (first !== undefined) headers.set("X-Visloc-Map", first.split("@")[0] ?? "");
    if (timeoutSeconds !== null) headers.set("X-Request-Timeout", String(timeoutSeconds));
    if (request.accept !== undefined) headers.set("Accept", request.accept);
    const form = request.form?.();
    try {
      return await fetch(new URL(path, base), {
        ...(form === undefined ? {} : { method: "POST", body: form }),
        ...(request.limit === null ? {} : { signal: request.limit }),
        headers,
      });
    } catch (error) {
      if (request.signal?.aborted) throw error;
      return brokenOff(error, request, "server.unreachable", "the service cannot be reached");
    }
  }

  /** Read a body; one that breaks off or is of another kind is no answer of the service. */
  async function whole<Body>(request: Asking, read: () => Promise<Body>): Promise<Body> {
    try {
      return await read();
    } catch (error) {
      if (request.signal?.aborted) throw error;
      throw brokenOff(error, request, "server.answer", "the answer is not one of the service");
    }
  }

  function brokenOff(error: unknown, request: Asking, code: string, detail: string): ServiceError {
    const late = request.timedOut ?? request.limit;
    if (late?.aborted !== true) return noAnswer(code, detail, String(error));
    const seconds = `${timeoutSeconds} s`;
    return ownError("server.timeout", "No answer", "the service did not answer in time", {
      expected: `an answer within ${seconds}`,
    });
  }

  /** Ask for JSON that has `members`, those that everything else is read after. */
  async function readJson<Answer>(
    path: string,
    what: string,
    members: readonly (keyof Answer)[],
    request: Asking,
  ): Promise<Answer> {
    const response = await ask(path, request);
    const answer = await whole(request, () => response.json() as Promise<Answer | null>);
    return checked(answer, what, members);
  }

  /** Ask for one answer to each instant, and pass each on when it comes. */
  async function* sequence(
    call: SequenceCall,
    signal: AbortSignal | undefined,
  ): AsyncGenerator<RigResponse, void> {
    const patience = new AbortController();
    const ended = new AbortController();
    let clock: ReturnType<typeof setTimeout> | undefined;
    /** Wait for the next answer as long as for another one; the caller may take its time. */
    async function inTime<Next>(wait: () => Promise<Next>): Promise<Next> {
      if (timeoutSeconds !== null) {
        clock = setTimeout(() => patience.abort(), 1000 * timeoutSeconds);
      }
      try {
        return await wait();
      } finally {
        clearTimeout(clock);
      }
    }
    const given = signal === undefined ? [] : [signal];
    const request: Asking = {
      map: call.map,
      form: () => sequenceForm(call),
      accept: NDJSON,
      signal: signal ?? null,
      limit: AbortSignal.any([...given, patience.signal, ended.signal]),
      timedOut: patience.signal,
    };
    let answers = 0;
    try {
      const response = await inTime(() => ask("localize/sequence", request));
      if (!(response.headers.get("Content-Type") ?? "").startsWith(NDJSON)) {
        const kind = response.headers.get("Content-Type") ?? "nothing";
        throw noAnswer("server.answer", "the answer is not one of the service", kind);
      }
      const come = lines(response);
      for (;;) {
        const next = await inTime(() => whole(request, () => come.next()));
        if (next.done === true) break;
        const said = await whole(request, async () => JSON.parse(next.value) as RigOrProblem);
        if (said?.problem != null) throw lineError(said.problem, response);
        yield checked<RigResponse>(said, "the answer to an instant", RIG_MEMBERS);
        answers += 1;
      }
    } finally {
      ended.abort(); // after the caller left the loop, nobody reads the rest
    }
    if (answers !== call.instants.length) {
      const got = `${answers} answers to ${call.instants.length} instants`;
      throw noAnswer("server.answer", "the answer breaks off", got);
    }
  }

  function asking(
    signal: AbortSignal | undefined,
    more: Pick<Asking, "map" | "form"> = {},
  ): Asking {
    const limits = signal === undefined ? [] : [signal];
    if (timeoutSeconds !== null) limits.push(AbortSignal.timeout(1000 * timeoutSeconds));
    const limit = limits.length > 1 ? AbortSignal.any(limits) : (limits[0] ?? null);
    return { ...more, signal: signal ?? null, limit };
  }

  const mapPath = (ref: string): string => `maps/${encodeURIComponent(ref)}`;

  return {
    localize: (call, signal) =>
      readJson(
        "localize",
        "the answer to a photo",
        ["status", "camera", "orientation", "retrieved", "map", "seconds"],
        asking(signal, { map: call.map, form: () => localizeForm(call) }),
      ),
    localizeRig: (call, signal) =>
      readJson(
        "localize/rig",
        "the answer to the photos of a rig",
        RIG_MEMBERS,
        asking(signal, { map: call.map, form: () => rigForm(call) }),
      ),
    localizeSequence: sequence,
    async maps(signal) {
      type Listed = { maps: MapInfo[] };
      return (await readJson<Listed>("maps", "the list of maps", ["maps"], asking(signal))).maps;
    },
    map: (ref, signal) =>
      readJson(
        mapPath(ref),
        "a map",
        ["id", "version", "extent", "down", "versions", "global_features", "tiles"],
        asking(signal, { map: ref }),
      ),
    async points(ref, first, count, signal) {
      const request = asking(signal, { map: ref });
      const response = await ask(`${mapPath(ref)}/points?first=${first}&count=${count}`, request);
      const body = await whole(request, () => response.arrayBuffer());
      try {
        return parsePoints(body);
      } catch (error) {
        if (!(error instanceof PointsError)) throw error;
        throw noAnswer("server.answer", error.message, "");
      }
    },
    images: (ref, first, count, signal) =>
      readJson(
        `${mapPath(ref)}/images?first=${first}&count=${count}`,
        "the list of a map's photos",
        ["images", "cameras", "total"],
        asking(signal, { map: ref }),
      ),
    async options() {
      type Described = { components: { schemas?: Record<string, { properties?: unknown }> } };
      const what = "the description of the API";
      const request = asking(undefined);
      const said = await readJson<Described>("openapi.json", what, ["components"], request);
      const options = said.components.schemas?.["LocalizeOptions"]?.properties;
      if (options == null) throw noAnswer("server.answer", `this is not ${what}`, "");
      return options as Record<string, OptionSchema>;
    },
  };
}

/** One request, which may be sent twice: a form is made for each time. */
interface Asking {
  map?: string | string[];
  form?: () => FormData;
  /** The caller's. */
  signal: AbortSignal | null;
  /** The caller's, and the time that is left. */
  limit: AbortSignal | null;
  /** Where `limit` may also end for another reason: aborted when the time is over. */
  timedOut?: AbortSignal;
  accept?: string;
}

type RigOrProblem = (RigResponse & { problem?: Record<string, unknown> }) | null;

/** An answer that has `members`, those that everything else is read after. */
function checked<Answer>(
  answer: Answer | null,
  what: string,
  members: readonly (keyof Answer)[],
): Answer {
  const known = typeof answer === "object" && answer !== null;
  if (!known || members.some((member) => answer[member] == null)) {
    throw noAnswer("server.answer", `this is not ${what}`, JSON.stringify(answer));
  }
  return answer;
}

function mayResend({ problem }: ServiceError): boolean {
  return (
    problem.code === "server.unreachable" ||
    problem.code === "server.stopping" ||
    problem.status === 502
  );
}
