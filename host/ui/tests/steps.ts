// What all tests of the page do: open a place, ask the API beside the page, look with other senses, take a picture.
import { readFileSync } from "node:fs";
import { createRequire } from "node:module";
import { join } from "node:path";
import { expect, type Page } from "@playwright/test";

export const base = (): string => process.env.BUMPLESS_PAGE ?? "";
export const component = (name: string): string => join(process.env.BUMPLESS_COMPONENTS ?? "", `${name}.wasm`);
const axe_source = readFileSync(createRequire(import.meta.url).resolve("axe-core/axe.min.js"), "utf8");

/** Opens a place and waits until numbers come. */
export async function open(page: Page, place: string): Promise<void> {
  await page.goto(`${base()}/#/${place}`);
  await expect(page.locator(".link.live")).toBeVisible();
}

/** Asks the API beside the page. */
export async function ask<T>(path: string, method = "GET", body?: unknown): Promise<T> {
  const response = await fetch(`${base()}${path}`, {
    method,
    headers: body === undefined ? {} : { "content-type": "application/json" },
    body: body === undefined ? undefined : JSON.stringify(body),
  });
  expect(response.ok, `${method} ${path}: ${response.status} ${await response.clone().text()}`).toBe(true);
  const type = response.headers.get("content-type") ?? "";
  return (type.includes("json") ? await response.json() : undefined) as T;
}

export interface Loop {
  setpoint: number;
  mode: string;
  owner: string;
  component: string;
  seq: number;
  revision: number;
  outputs: Record<string, number>;
  tally: { lost: number; taken: number };
}
export const loop = (name: string): Promise<Loop> => ask<Loop>(`/v1/loops/${name}`);

/** Takes back what was said in these words: the cell may have it before the page has said it, and other words may still stand there. */
export const undo = (page: Page, said: string | RegExp): Promise<void> =>
  page.locator(".message").filter({ hasText: said }).last().getByRole("button", { name: "Undo" }).click();

/** Nothing serious for those who use the page with other senses. */
export async function serious(page: Page, what: string): Promise<string[]> {
  await page.evaluate(axe_source);
  const found = await page.evaluate(async () => {
    const axe = (window as unknown as { axe: { run: (context: Document, options: object) => Promise<{ violations: { id: string; impact: string; nodes: { target: string[]; failureSummary: string }[] }[] }> } }).axe;
    const result = await axe.run(document, { resultTypes: ["violations"] });
    return result.violations
      .filter((violation) => violation.impact === "serious" || violation.impact === "critical")
      .map((violation) => `${violation.id}: ${violation.nodes.map((node) => `${node.target.join(" ")} ${node.failureSummary}`).slice(0, 3).join("; ")}`);
  });
  return found.map((one) => `${what}: ${one}`);
}

/** A picture for the documentation; only where the caller wants them. */
export async function figure(page: Page, name: string): Promise<void> {
  const folder = process.env.BUMPLESS_FIGURES;
  if (folder) await page.screenshot({ path: join(folder, `page-${name}.png`), animations: "disabled" });
}
