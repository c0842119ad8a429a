// What the tests use of Node.js; its own types are a large package, and the page must not see them.
declare module "node:child_process" {
  interface Ended {
    stdout: string;
    stderr: string;
    error?: Error;
  }
  interface Options {
    encoding?: "utf8";
    input?: string;
    cwd?: string | undefined;
    env?: Record<string, string | undefined>;
    stdio?: "ignore";
  }
  export function spawnSync(command: string, args: string[], options?: Options): Ended;
  export function spawn(
    command: string,
    args: string[],
    options?: Options,
  ): { on(event: "close", listener: () => void): void };
}
declare module "node:fs" {
  export function mkdtempSync(prefix: string): string;
  export function rmSync(path: string, options?: { recursive?: boolean }): void;
  export function writeFileSync(path: string, text: string): void;
}
declare module "node:http" {
  interface Request {
    headers: Record<string, string | undefined>;
    on(event: "data", listener: (part: Uint8Array) => void): void;
    on(event: "end", listener: () => void): void;
  }
  interface Server {
    listen(port: number, host: string, listening: () => void): void;
    address(): { port: number };
    close(): void;
  }
  export function createServer(
    listener: (request: Request, response: { end(): void }) => void,
  ): Server;
}
declare module "node:os" {
  export function tmpdir(): string;
}
declare module "node:path" {
  export function join(...parts: string[]): string;
}
declare const process: { env: Record<string, string | undefined> };
