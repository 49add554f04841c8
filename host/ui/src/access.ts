// Who one is to the host, and what he may do there; signing in and out.
//
//   asked at the start ─► nobody is asked (loopback): everything may be done
//                      └► signed in ─► the page ── session over, account changed ─► sign in again
//                      └► nobody: sign in, or make the first administrator
//
// Never: keeps a password; the session's secret is in a cookie that no script can read.

import { computed, signal } from "@preact/signals";

export type Role = "viewer" | "operator" | "engineer" | "admin";
const RANK: Record<Role, number> = { viewer: 0, operator: 1, engineer: 2, admin: 3 };

/** Who one is, as the host says. */
export interface Me {
  secured: boolean;
  first: boolean;
  name: string | null;
  role: Role | null;
  loops: string[];
  csrf: string | null;
}

/** Pause between two looks: a role that was changed, a session that is over. */
const LOOK_MS = 60_000;

/** Null until the host was asked. */
export const me = signal<Me | null>(null);
/** Does the host want to know who one is, and does not know it? */
export const must_sign_in = computed(() => me.value !== null && me.value.secured && !me.value.name);

/** What a change must show besides the cookie. */
export const csrf = (): string => me.peek()?.csrf ?? "";

/** Asks who one is. */
export async function look(): Promise<void> {
  const response = await fetch("/v1/access/me", { signal: AbortSignal.timeout(20_000) });
  // A host of an earlier version does not know the question, and asks nobody.
  me.value = response.ok ? ((await response.json()) as Me) : { secured: false, first: false, name: null, role: "admin", loops: ["*"], csrf: null };
}

/** Looks again and again. A host that is away is not asked in vain: the feed tells of that. */
export function keep_looking(): void {
  setInterval(() => void look().catch(() => undefined), LOOK_MS);
}

/** The host did not know who asked. */
export function unknown(): void {
  if (me.peek()?.secured) void look().catch(() => undefined);
}

async function enter(path: string, body: unknown): Promise<void> {
  const response = await fetch(path, {
    method: "POST",
    headers: { "content-type": "application/json" },
    body: JSON.stringify(body),
    signal: AbortSignal.timeout(20_000),
  });
  const said = (await response.json()) as Me & { detail?: string; cure?: string };
  if (!response.ok) throw new Error([said.detail, said.cure].filter(Boolean).join(" — "));
  me.value = said;
}

export const sign_in = (name: string, password: string): Promise<void> => enter("/v1/access/sign-in", { name, password });
export const make_first = (token: string, name: string, password: string): Promise<void> => enter("/v1/access/first", { token: token.trim(), name, password });

export async function sign_out(): Promise<void> {
  await fetch("/v1/access/sign-out", { method: "POST", headers: { "content-type": "application/json", "x-csrf-token": csrf() }, body: "{}" });
  // What was shown belongs to somebody who has left.
  location.reload();
}

/** Is the loop among those that may be changed? */
const has = (loops: string[], name: string): boolean =>
  loops.some((known) => (known.endsWith("*") ? name.startsWith(known.slice(0, -1)) : known === name));

/** May it be done: with this role, to this loop (an empty name: to some loop), or beyond single loops where none is named? The host decides; this only shows it. */
export function may(role: Role, loop?: string): boolean {
  const now = me.value;
  if (!now || !now.secured) return true;
  if (!now.role || RANK[now.role] < RANK[role]) return false;
  return role === "viewer" || loop === "" || now.loops.includes("*") || (loop !== undefined && has(now.loops, loop));
}
