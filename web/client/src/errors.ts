// What goes wrong, as one kind of error.

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

  /** A stable word, such as `camera.param_count`: docs/api.md lists them. */
  get code(): string {
    return this.problem.code;
  }

  /** The part of the request that is wrong; null where it is no part of it. */
  get field(): string | null {
    return this.problem.field;
  }

  get expected(): string | null {
    return this.problem.expected;
  }

  get got(): string | null {
    return this.problem.got;
  }
}

/** An error that was found on this side, or why no answer of the service came: status 0. */
export function ownError(
  code: string,
  title: string,
  detail: string,
  more: Partial<Pick<Problem, "field" | "expected" | "got">> = {},
): ServiceError {
  const nothing = { field: null, expected: null, got: null, request_id: "" };
  return new ServiceError({ ...nothing, title, status: 0, detail, code, ...more });
}

/** What came is no answer of the service, or none came. */
export function noAnswer(code: string, detail: string, got: string): ServiceError {
  return ownError(code, "No answer", detail, { got: got.slice(0, 200) });
}

/** The error that a response tells. */
export async function serviceError(response: Response): Promise<ServiceError> {
  const retryAfter = Number.parseFloat(response.headers.get("Retry-After") ?? "");
  // A service that says "at once" is not to be flooded, and timers hold no more than some weeks.
  const seconds = Number.isFinite(retryAfter) ? Math.min(Math.max(retryAfter, 0.5), 3600) : null;
  const said: unknown = await response.json().catch(() => null);
  return new ServiceError(problemOf(said, response, response.status), seconds);
}

/** The error that the last line of an answer in lines tells, under status 200. */
export function lineError(said: Record<string, unknown>, response: Response): ServiceError {
  const status = typeof said["status"] === "number" ? said["status"] : 500;
  return new ServiceError(problemOf(said, response, status));
}

function problemOf(said: unknown, response: Response, status: number): Problem {
  const words = (typeof said === "object" && said !== null ? said : {}) as Record<string, unknown>;
  const text = (name: string): string | null => (words[name] == null ? null : String(words[name]));
  return {
    title: text("title") ?? response.statusText,
    status,
    detail: text("detail") ?? "something other than the service answered, such as a proxy",
    code: text("code") ?? "server.answer",
    field: text("field"),
    expected: text("expected"),
    got: text("got"),
    request_id: text("request_id") ?? response.headers.get("X-Request-Id") ?? "",
  };
}
