// The part of the service's HTTP API that the page speaks (docs/api.md).
//
// What the service answers is taken for what it says it is; what is no answer of the service, such
// as a proxy's page, is told apart here, so that callers meet one kind of error: ServiceError.

export type Vector3 = [number, number, number];
/** Unit quaternion: w, x, y, z. */
export type Quaternion = [number, number, number, number];

export interface MapInfo {
  id: string;
  version: string;
  created: string;
  metric: boolean;
  /** Null for a set. */
  method: string | null;
  local_features: string;
  global_features: string[];
  images: number;
  landmarks: number;
  /** Null for a set. */
  observations: number | null;
  extent: { min: number[]; max: number[] };
  size_bytes: number;
  /** Unit vector; empty when not known. */
  down: number[];
  /** Whether this version is current. */
  current: boolean;
  /** All published ones, oldest first. */
  versions: { version: string; current: boolean }[];
  kind: "map" | "set";
  /** Of a set that was asked for alone. */
  tiles: Tile[];
}

/** One map of a set. */
export interface Tile {
  map: string;
  version: string;
  /** `x_set = scale R x + translation` */
  set_from_tile: { rotation_wxyz: Quaternion; translation: Vector3; scale: number };
}

export interface Camera {
  model: string;
  width: number;
  height: number;
  params: number[];
}

/** A mapping photo: where it was taken, and world_from_cam as a rotation. */
export interface MapImage {
  name: string;
  /** Key of MapImages.cameras. */
  camera: string;
  position: Vector3;
  orientation: Quaternion;
}

/** GET /maps/{ref}/images?first=&count= */
export interface MapImages {
  map: { id: string; version: string };
  total: number;
  first: number;
  cameras: Record<string, Camera>;
  images: MapImage[];
}

export interface PoseEstimate {
  cam_from_world: { rotation_wxyz: number[]; translation: number[] };
  position: number[];
  orientation: number[];
  /** 6 x 6, row by row: rotation (rad) then translation, of cam_from_world. */
  covariance: number[];
  position_std: number[];
  orientation_std_deg: number[];
  /** The part of covariance that the scatter of the matches alone leaves open. */
  photo_covariance: number[];
  /** What covariance covers. */
  uncertainty: "whole" | "photo only";
  /** That the pose is right, 0 to 1; null when it was not judged. */
  probability: number | null;
}

/** One of the two places between which an ambiguous photo leaves the choice. */
export interface Candidate {
  /** In whose frame the pose is: a map, or a set of maps. */
  map: { id: string; version: string };
  /** Of a set: `id@version` of the map in it. */
  tile: string | null;
  position: number[];
  orientation: number[];
  inliers: number;
  /** The mapping photo that speaks most for this place. */
  image: string | null;
  /** How surely the keypoints speak for this place, in standard deviations; null if not compared. */
  preference: number | null;
}

export interface LocalizeResponse {
  request_id: string;
  /** Of status coarse, `pose` is null: the page shows such a photo as not localized. */
  status: "localized" | "coarse" | "not_localized";
  pose: PoseEstimate | null;
  refusal: { stage: string; reason: string; message: string; candidates: Candidate[] } | null;
  keypoints: number;
  correspondences: number;
  inliers: number;
  inlier_ratio: number;
  retrieved: { image: string; score: number; similarities: Record<string, number> }[];
  camera: Camera & { source: "given" | "given_scaled" | "exif" | "estimated" | "guess" };
  orientation: { exif: number; read_as: string; turned: number };
  map: { id: string; version: string };
  /** Of a set: `id@version` of the map in it that the answer rests on. */
  tile: string | null;
  seconds: Record<string, number>;
  debug: { keypoints: number[]; points: number[]; inliers: boolean[]; overlay: string } | null;
}

/** RFC 9457, as every refusal of the service has it. */
export interface Problem {
  title: string;
  status: number;
  detail: string;
  code: string;
  field: string | null;
  expected: string | null;
  got: string | null;
  request_id: string;
}

/** What the service refused, or why no usable answer came (codes server.*, status 0). */
export class ServiceError extends Error {
  constructor(
    readonly problem: Problem,
    /** What the service asks to wait before asking again; null when it does not say. */
    readonly retryAfterSeconds: number | null = null,
  ) {
    super(problem.detail);
    this.name = "ServiceError";
  }
}

/** An error that the page itself found, or why no answer of the service came: status 0. */
export function ownError(
  code: string,
  title: string,
  detail: string,
  more: Partial<Pick<Problem, "field" | "expected" | "got">> = {},
): ServiceError {
  const nothing = { field: null, expected: null, got: null, request_id: "" };
  return new ServiceError({ ...nothing, title, status: 0, detail, code, ...more });
}

/** A photo to localize. `name` is the file's, for people; `map` is an id or `id@version`. */
export interface LocalizeCall {
  map: string;
  image: Blob;
  name: string;
  camera: Camera | null;
  options: Record<string, string | number>;
  priors?: unknown;
  debug?: boolean;
}

/** An option of a query, as /openapi.json describes it. */
export interface OptionSchema {
  title: string;
  /** Null, which stands for the default, is among them. */
  enum?: (string | null)[];
  minimum?: number;
  maximum?: number;
  /** Null where the map or the preset has one of its own. */
  default: string | number | null;
}

/** Every method throws ServiceError, or what `signal` was aborted with. */
export interface Service {
  maps(signal?: AbortSignal): Promise<MapInfo[]>;
  /** Describe one map: an id or `id@version`. */
  map(ref: string, signal?: AbortSignal): Promise<MapInfo>;
  points(ref: string, first: number, count: number, signal?: AbortSignal): Promise<ArrayBuffer>;
  images(ref: string, first: number, count: number, signal?: AbortSignal): Promise<MapImages>;
  localize(request: LocalizeCall, signal?: AbortSignal): Promise<LocalizeResponse>;
  /** The options of a query, by name. */
  options(): Promise<Record<string, OptionSchema>>;
}

/** `MODEL,width,height,params...`, as the service, the command line and curl take a camera. */
export function cameraText(camera: Camera): string {
  return [camera.model, camera.width, camera.height, ...camera.params].join(",");
}

/** As people name it: with the version only where that is not the current one. */
export function shortRef(map: { id: string; version: string; current: boolean }): string {
  return map.current ? map.id : mapRef(map);
}

/** The version that is meant, so that what is shown and what is answered are of one map. */
export function mapRef(map: { id: string; version: string }): string {
  return `${map.id}@${map.version}`;
}

/** Speak with the service at `base`, which ends in a slash; `key` is asked before each request. */
export function connect(base: URL, key: () => string | null): Service {
  async function ask(path: string, init: RequestInit = {}): Promise<Response> {
    const headers = new Headers();
    const given = key();
    if (given !== null) headers.set("Authorization", `Bearer ${given}`);
    let response: Response;
    try {
      response = await fetch(new URL(path, base), { ...init, headers });
    } catch (error) {
      if (init.signal?.aborted) throw error;
      throw noAnswer("server.unreachable", "the service cannot be reached", String(error));
    }
    if (!response.ok) throw await serviceError(response);
    return response;
  }

  /** Ask for JSON that has `members`, those that everything else is read after. */
  async function readJson<Answer>(
    path: string,
    what: string,
    members: (keyof Answer)[],
    init: RequestInit,
  ): Promise<Answer> {
    const response = await ask(path, init);
    const answer = await whole(init.signal, () => response.json() as Promise<Answer | null>);
    const known = typeof answer === "object" && answer !== null;
    if (!known || members.some((member) => answer[member] == null)) {
      throw noAnswer("server.answer", `this is not ${what}`, JSON.stringify(answer));
    }
    return answer;
  }

  const withSignal = (signal?: AbortSignal): RequestInit =>
    signal === undefined ? {} : { signal };
  const mapPath = (ref: string): string => `maps/${encodeURIComponent(ref)}`;

  return {
    maps: async (signal) =>
      (
        await readJson<{ maps: MapInfo[] }>(
          "maps",
          "the list of maps",
          ["maps"],
          withSignal(signal),
        )
      ).maps,
    map: (ref, signal) =>
      readJson(
        mapPath(ref),
        "a map",
        ["id", "version", "extent", "down", "versions", "global_features", "tiles"],
        withSignal(signal),
      ),
    async points(ref, first, count, signal) {
      const path = `${mapPath(ref)}/points?first=${first}&count=${count}`;
      const response = await ask(path, withSignal(signal));
      return whole(signal, () => response.arrayBuffer());
    },
    images: (ref, first, count, signal) =>
      readJson(
        `${mapPath(ref)}/images?first=${first}&count=${count}`,
        "the list of a map's photos",
        ["images", "cameras", "total"],
        withSignal(signal),
      ),
    localize: (call, signal) =>
      readJson(
        "localize",
        "the answer to a photo",
        ["status", "camera", "orientation", "retrieved", "map", "seconds"],
        { ...withSignal(signal), method: "POST", body: localizeForm(call) },
      ),
    async options() {
      type Described = { components: { schemas?: Record<string, { properties?: unknown }> } };
      const what = "the description of the API";
      const said = await readJson<Described>("openapi.json", what, ["components"], {});
      const options = said.components.schemas?.["LocalizeOptions"]?.properties;
      if (options == null) throw noAnswer("server.answer", `this is not ${what}`, "");
      return options as Record<string, OptionSchema>;
    },
  };
}

/** The form of POST /localize. What was not chosen is not sent: the service has defaults. */
export function localizeForm(call: LocalizeCall): FormData {
  const form = new FormData();
  form.set("map", call.map);
  form.set("image", call.image, call.name || "photo");
  if (call.camera !== null) form.set("camera", cameraText(call.camera));
  if (Object.keys(call.options).length > 0) form.set("options", JSON.stringify(call.options));
  if (call.priors !== undefined) form.set("priors", JSON.stringify(call.priors));
  if (call.debug === true) form.set("debug", "true");
  return form;
}

/** Read a body; one that breaks off or is of another kind is no answer of the service. */
async function whole<Body>(
  signal: AbortSignal | null | undefined,
  read: () => Promise<Body>,
): Promise<Body> {
  try {
    return await read();
  } catch (error) {
    if (signal?.aborted) throw error;
    throw noAnswer("server.answer", "the answer is not one of the service", String(error));
  }
}

async function serviceError(response: Response): Promise<ServiceError> {
  const retryAfter = Number.parseFloat(response.headers.get("Retry-After") ?? "");
  // A service that says "at once" is not to be flooded, and timers hold no more than some weeks.
  const seconds = Number.isFinite(retryAfter) ? Math.min(Math.max(retryAfter, 0.5), 3600) : null;
  const said: unknown = await response.json().catch(() => null);
  return new ServiceError(problemOf(said, response), seconds);
}

function problemOf(said: unknown, response: Response): Problem {
  const words = (typeof said === "object" && said !== null ? said : {}) as Record<string, unknown>;
  const text = (name: string): string | null => (words[name] == null ? null : String(words[name]));
  return {
    title: text("title") ?? response.statusText,
    status: response.status,
    detail: text("detail") ?? "something other than the service answered, such as a proxy",
    code: text("code") ?? "server.answer",
    field: text("field"),
    expected: text("expected"),
    got: text("got"),
    request_id: text("request_id") ?? response.headers.get("X-Request-Id") ?? "",
  };
}

function noAnswer(code: string, detail: string, got: string): ServiceError {
  return ownError(code, "No answer", detail, { got: got.slice(0, 200) });
}
