// Questions to the host that served the page. A failure is a Problem with its cure, never a bare status.
// Never: another host; a page speaks to its own origin only.

import { csrf, unknown } from "./access";
import { by } from "./who";

/** Why a question failed, in the host's own words. */
export class Problem extends Error {
  constructor(
    readonly status: number,
    readonly title: string,
    readonly detail: string,
    readonly cure: string,
  ) {
    super(detail || title);
  }
}

/** Longest wait for an answer, in ms: that of the slowest route, an upload. */
const TIME_MAX_MS = 240_000;
/** Entries of a list that a page reads at most: nobody looks at more. */
const LIST_MAX = 20_000;

async function ask<T>(method: string, path: string, body?: BodyInit, headers: Record<string, string> = {}): Promise<T> {
  let response: Response;
  try {
    // Who asks goes with what changes something. A header carries bytes; the name's are UTF-8.
    const named: Record<string, string> = method === "GET" ? headers : { ...headers, "x-by": String.fromCharCode(...new TextEncoder().encode(by())) };
    if (method !== "GET" && csrf()) named["x-csrf-token"] = csrf();
    response = await fetch(path, { method, body, headers: named, signal: AbortSignal.timeout(TIME_MAX_MS) });
  } catch (error) {
    throw new Problem(0, "The host does not answer", String(error instanceof Error ? error.message : error), "look at the connection");
  }
  if (response.status === 401) unknown();
  if (!response.ok) {
    const text = await response.text();
    try {
      const said = JSON.parse(text) as { title?: string; detail?: string; cure?: string };
      throw new Problem(response.status, said.title ?? response.statusText, said.detail ?? "", said.cure ?? "");
    } catch (error) {
      if (error instanceof Problem) throw error;
      throw new Problem(response.status, response.statusText, text.slice(0, 300), "");
    }
  }
  const type = response.headers.get("content-type") ?? "";
  return (type.includes("json") ? await response.json() : undefined) as T;
}

export const get = <T>(path: string): Promise<T> => ask("GET", path);

/** A list in all its parts. `rows` is the key of its rows. */
export async function list<T>(path: string, rows: string): Promise<T[]> {
  const all: T[] = [];
  let after = "";
  do {
    const from = after && `${path.includes("?") ? "&" : "?"}after=${encodeURIComponent(after)}`;
    const part = await get<Record<string, unknown>>(path + from);
    all.push(...((part[rows] as T[] | undefined) ?? []));
    after = (part["next"] as string | null | undefined) ?? "";
  } while (after);
  return all;
}

/** The same, with the last part, for lists that tell more than their rows. */
export async function get_list<Part extends { next?: string | null }, One>(path: string, of: (part: Part) => One[]): Promise<{ all: One[]; last: Part }> {
  const all: One[] = [];
  let last: Part;
  let after = "";
  do {
    const query = after ? `${path.includes("?") ? "&" : "?"}after=${encodeURIComponent(after)}` : "";
    last = await get<Part>(`${path}${query}`);
    all.push(...of(last));
    after = last.next ?? "";
  } while (after && all.length < LIST_MAX);
  return { all, last };
}

/** Also what has no body to send says that it is JSON: a page of another origin could not. */
export const send = <T>(method: string, path: string, body: unknown, headers: Record<string, string> = {}): Promise<T> =>
  ask(method, path, JSON.stringify(body), { "content-type": "application/json", ...headers });

export const remove = <T>(path: string): Promise<T> => ask("DELETE", path);

/** A command acts once, however often it is sent: its key is made here. */
export function command<T>(loop: string, what: "setpoint" | "mode" | "output", body: unknown): Promise<T> {
  return send("POST", `/v1/loops/${encodeURIComponent(loop)}/${what}`, body, { "idempotency-key": key() });
}

/** 32 hexadecimal digits. `crypto.randomUUID` is not there on plain HTTP. */
function key(): string {
  const bytes = crypto.getRandomValues(new Uint8Array(16));
  return Array.from(bytes, (byte) => byte.toString(16).padStart(2, "0")).join("");
}

/** Uploads a component. */
export function upload<T>(file: Blob, options: { note?: string; by?: string; force?: boolean; dryRun?: boolean }): Promise<T> {
  const query = new URLSearchParams();
  if (options.note) query.set("note", options.note);
  query.set("by", options.by || by());
  if (options.force) query.set("force", "true");
  if (options.dryRun) query.set("dry_run", "true");
  return ask("POST", `/v1/components?${query}`, file, { "content-type": "application/wasm" });
}

/** A failure in one line for people. */
export function words(error: unknown): string {
  if (error instanceof Problem) return [error.detail || error.title, error.cure].filter(Boolean).join(" — ");
  return error instanceof Error ? error.message : String(error);
}
