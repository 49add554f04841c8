// Light, dark, or as the system has it; and the colours that canvases need, read from the style sheet.

import { signal } from "@preact/signals";

export type Theme = "system" | "light" | "dark";
const KEY = "bumpless.theme";

function stored(): Theme {
  try {
    const text = localStorage.getItem(KEY);
    return text === "light" || text === "dark" ? text : "system";
  } catch {
    return "system";
  }
}

export const theme = signal<Theme>(stored());
/** Grows when colours change, so that canvases draw anew. */
export const colours = signal(0);

export function set_theme(next: Theme): void {
  theme.value = next;
  try {
    if (next === "system") localStorage.removeItem(KEY);
    else localStorage.setItem(KEY, next);
  } catch {
    // Storage may be forbidden; the choice then lasts as long as the page.
  }
  show();
}

export function show(): void {
  if (theme.value === "system") delete document.documentElement.dataset.theme;
  else document.documentElement.dataset.theme = theme.value;
  colours.value += 1;
}

matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => (colours.value += 1));

/** A colour of the style sheet. */
export function colour(name: string): string {
  return getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();
}

/** A host's colour in lanes: calm, and the same as long as the cell has the same hosts. */
export function host_colour(name: string, all: string[]): string {
  const n = all.indexOf(name);
  return colour(`host-${(n < 0 ? 7 : n) % 8}`);
}
