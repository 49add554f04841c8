// Who operates this page: a name for records and for the next shift. It proves nothing; whoever reaches the page may give any.

import { signal } from "@preact/signals";

const KEY = "bumpless.who";
/** Longest name, in characters. */
export const WHO_CHARS_MAX = 64;

function stored(): string {
  try {
    return (localStorage.getItem(KEY) ?? "").slice(0, WHO_CHARS_MAX);
  } catch {
    return "";
  }
}

/** The name; empty where nobody gave one. */
export const who = signal(stored());

export function set_who(name: string): void {
  who.value = name.slice(0, WHO_CHARS_MAX);
  try {
    if (who.value.trim()) localStorage.setItem(KEY, who.value.trim());
    else localStorage.removeItem(KEY);
  } catch {
    // Storage may be forbidden; the name then lasts as long as the page.
  }
}

/** The name for a record. */
export const by = (): string => who.peek().trim() || "page";
