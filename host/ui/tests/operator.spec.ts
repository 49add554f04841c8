// What an operator does beside the loops: alarms, forces, jobs, hosts that are emptied, reports of the lab.
import { spawn } from "node:child_process";
import { mkdirSync, mkdtempSync, rmSync, writeFileSync } from "node:fs";
import { tmpdir } from "node:os";
import { join } from "node:path";
import { expect, type Page, test } from "@playwright/test";
import { ask, figure, loop, open, serious, undo } from "./steps";

test.beforeEach(({ page }) => {
  page.on("pageerror", (error) => {
    throw error;
  });
});

interface Alarm {
  name: string;
  state: string;
  quiet: boolean;
  acknowledged_by: string | null;
  note: string | null;
  shelf: { by: string; reason: string } | null;
}
const alarm = async (of: string, name: string): Promise<Alarm | undefined> =>
  (await ask<{ alarms: Alarm[] }>(`/v1/alarms?all=true&loop=${of}`)).alarms.find((one) => one.name === name);

/** Defines an alarm beside the page. */
const define = (of: string, name: string, definition: object): Promise<unknown> => ask(`/v1/loops/${of}/alarms/${name}`, "PUT", definition);
const undefine = (of: string, name: string): Promise<unknown> => ask(`/v1/loops/${of}/alarms/${name}`, "DELETE");

test("an alarm is defined, comes, is acknowledged, shelved, told again and goes", async ({ page }) => {
  await open(page, "loop/tank-1");
  // Off unless somebody turned it on.
  await page.keyboard.press("a");
  await expect(page.getByRole("heading", { name: "Alarms", level: 1 })).toBeVisible();
  await expect(page.getByRole("checkbox", { name: "sound" })).not.toBeChecked();

  await open(page, "loop/tank-1");
  const panel = page.getByRole("region", { name: "Alarms of tank-1" });
  await panel.getByRole("button", { name: "New alarm…" }).click();
  const form = page.getByRole("dialog");
  await expect(form.getByRole("button", { name: "Define" })).toBeDisabled();
  await form.getByLabel("Name", { exact: true }).fill("high");
  await form.getByLabel("Priority").selectOption("high");
  await form.getByLabel(/^Limit/).fill("5");
  await form.getByLabel(/^Dead band/).fill("0.5");
  await form.getByLabel("What the operator is to do").fill("close the inlet");
  await form.getByRole("button", { name: "Define" }).click();

  // It comes at once, for the level is above 5: said in the header of every view, on the card, on the bars, in the trend's panel.
  const bell = page.locator(".bell");
  await expect(bell).toHaveAccessibleName(/not acknowledged: .*\d high/);
  await expect(panel.getByRole("button", { name: "high, high priority, stands, not seen" })).toBeVisible();
  await expect(page.getByRole("region", { name: "Operation" }).locator(".bar u.on.high")).toHaveCount(1);
  await figure(page, "loop-alarm");
  await open(page, "");
  await expect(page.locator(".card", { hasText: "tank-1" }).getByRole("img", { name: "high alarm high" })).toBeVisible();
  await expect(page).toHaveTitle(/^▲\d/);

  await bell.click();
  const row = page.getByRole("row").filter({ hasText: "tank-1 high" });
  await expect(row).toContainText("limit 5.0");
  await expect(row).toContainText("close the inlet");
  await row.getByRole("button", { name: "More about tank-1 high" }).click();
  const dialog = page.getByRole("dialog");
  await dialog.getByLabel("Your name, for the record").fill("ann");
  await dialog.getByLabel("Note").fill("on my way");
  await dialog.getByRole("button", { name: "Acknowledge" }).click();
  await expect.poll(async () => (await alarm("tank-1", "high"))?.state).toBe("acknowledged");
  expect(await alarm("tank-1", "high")).toMatchObject({ acknowledged_by: "ann", note: "on my way" });

  // Shelving needs a reason, and an end.
  await expect(dialog.getByRole("button", { name: "Shelve" })).toBeDisabled();
  await dialog.getByLabel("Reason").fill("the tank is being filled");
  await dialog.getByRole("combobox", { name: "For", exact: true }).selectOption("1 hour");
  await dialog.getByRole("button", { name: "Shelve", exact: true }).click();
  await expect(dialog.getByText(/until .* by ann: the tank is being filled/)).toBeVisible();
  await dialog.getByRole("button", { name: "Close" }).click();
  await expect(row).toHaveCount(0);
  await page.getByRole("link", { name: "Kept quiet" }).click();
  await expect(page.getByRole("row").filter({ hasText: "tank-1 high" })).toContainText("shelved: the tank is being filled");
  await page.getByRole("button", { name: "Unshelve tank-1 high" }).click();
  await expect.poll(async () => (await alarm("tank-1", "high"))?.quiet).toBe(false);
  // What is taken back can be taken back.
  await undo(page, "tank-1 high: told again");
  await expect.poll(async () => (await alarm("tank-1", "high"))?.shelf?.reason).toBe("the tank is being filled");
  await page.getByRole("button", { name: "Unshelve tank-1 high" }).click();
  await expect.poll(async () => (await alarm("tank-1", "high"))?.quiet).toBe(false);

  await page.getByRole("link", { name: "History" }).click();
  const past = page.getByRole("region", { name: "Table of what happened" });
  for (const what of ["defined", "came", "acknowledged", "shelved", "unshelved"]) {
    await expect(past.getByRole("row").filter({ hasText: "tank-1 high" }).filter({ has: page.getByRole("cell", { name: new RegExp(`^${what}`) }) }).first()).toBeVisible();
  }
  await page.getByRole("link", { name: "Defined", exact: true }).click();
  await page.getByLabel("Filter alarms").fill("tank-1 high");
  await page.getByRole("button", { name: "tank-1 high" }).click();
  await page.getByRole("button", { name: "Definition…" }).click();
  await page.getByRole("dialog").getByRole("button", { name: "Remove" }).click();
  await expect.poll(async () => alarm("tank-1", "high")).toBeUndefined();
});

test("many are acknowledged at once, in their order; a latched one wants a reset; one is taken out of service", async ({ page }) => {
  const level = { kind: "hi", limit: 4, off_delay_s: 0 };
  await define("tank-2", "low-one", { ...level, priority: "low", group: "tank", latching: true });
  await expect.poll(async () => (await alarm("tank-2", "low-one"))?.state).toBe("active");
  await define("tank-2", "high-one", { ...level, priority: "high", group: "tank" });
  await define("tank-2", "medium-one", { ...level, priority: "medium", group: "tank" });
  await open(page, "alarms");
  const rows = page.getByRole("region", { name: "Table of alarms" }).getByRole("row").filter({ hasText: "tank-2" });
  await expect(rows).toHaveCount(3);
  await expect(rows.nth(0)).toContainText("high-one");
  await expect(rows.nth(1)).toContainText("medium-one");
  await expect(rows.nth(2)).toContainText("low-one");
  await expect(rows.nth(2)).toContainText("first out");
  await figure(page, "alarms");
  // Only what is shown is acknowledged.
  await page.getByLabel("from priority").selectOption("medium");
  await page.getByRole("button", { name: "Acknowledge all 2 shown" }).click();
  for (const name of ["high-one", "medium-one"]) await expect.poll(async () => (await alarm("tank-2", name))?.state).toBe("acknowledged");
  expect((await alarm("tank-2", "low-one"))?.state).toBe("active");
  await page.getByLabel("from priority").selectOption("low");
  await page.getByRole("button", { name: "Acknowledge tank-2 low-one" }).click();
  await expect.poll(async () => (await alarm("tank-2", "low-one"))?.state).toBe("acknowledged");
  // It goes, and waits for a person.
  await define("tank-2", "low-one", { ...level, limit: 99, priority: "low", group: "tank", latching: true });
  await expect(rows.filter({ hasText: "low-one" })).toContainText("gone, wants a reset");
  await page.getByRole("button", { name: "Reset tank-2 low-one" }).click();
  await expect(rows.filter({ hasText: "low-one" })).toHaveCount(0);

  await page.getByRole("button", { name: "More about tank-2 high-one" }).click();
  await page.getByRole("dialog").getByLabel("Reason").fill("sensor in repair");
  await page.getByRole("dialog").getByRole("button", { name: "Take out of service" }).click();
  await expect.poll(async () => (await alarm("tank-2", "high-one"))?.quiet).toBe(true);
  await page.getByRole("dialog").getByRole("button", { name: "Put back into service" }).click();
  await expect.poll(async () => (await alarm("tank-2", "high-one"))?.quiet).toBe(false);
  for (const name of ["low-one", "medium-one", "high-one"]) await undefine("tank-2", name);
});

test("a flood is said in every view, and judged by ISA-18.2", async ({ page }) => {
  for (let n = 0; n < 12; n++) await define("tank-3", `flood-${n}`, { kind: "hi", limit: 1, priority: "low" });
  await open(page, "hosts");
  await expect(page.getByRole("alert").filter({ hasText: "Alarm flood." })).toContainText(/1[2-9] alarms in ten minutes|[2-9]\d alarms in ten minutes/);
  await open(page, "alarms/load");
  const judged = page.getByRole("region", { name: "Table of figures" }).getByRole("row");
  await expect(judged.filter({ hasText: "– the most" })).toContainText("exceeded");
  await expect(judged.filter({ hasText: "more than a day" })).not.toContainText("exceeded");
  await expect(page.getByRole("img", { name: /Comings in each ten minutes of the last day, at most (1[2-9]|[2-9]\d)/ })).toBeVisible();
  await figure(page, "alarm-figures");
  await page.getByRole("region", { name: "Table of frequent alarms" }).getByRole("button", { name: /tank-/ }).first().click();
  await expect(page.getByRole("dialog")).toBeVisible();
  for (let n = 0; n < 12; n++) await undefine("tank-3", `flood-${n}`);
});

test("a forced point is said wherever it or its loop is shown, and freed", async ({ page }) => {
  const ports = (await ask<{ spec: { ports: Record<string, string> } }>("/v1/loops/tank-4")).spec.ports;
  const [pv, out] = [ports.pv as string, ports.out as string];
  await open(page, "points");
  await page.getByRole("button", { name: `Force ${pv}`, exact: true }).click();
  const dialog = page.getByRole("dialog");
  await dialog.getByLabel("Value to hold").fill("55.5");
  await expect(dialog.getByRole("button", { name: "Force", exact: true })).toBeDisabled();
  await dialog.getByLabel("Why").fill("loop check");
  await dialog.getByLabel("Your name, for the record").fill("bob");
  await dialog.getByLabel("For how long; it ends by itself").selectOption("1 h");
  await dialog.getByRole("button", { name: "Force", exact: true }).click();
  const row = page.getByRole("row").filter({ hasText: pv });
  await expect(row).toContainText("by bob: loop check");
  await expect(page.getByRole("navigation", { name: "Places" }).getByLabel("1 forced")).toBeVisible();
  await figure(page, "points");
  await open(page, "");
  await expect(page.locator(".card", { hasText: "tank-4" })).toContainText("FORCED");
  await page.getByRole("link", { name: "tank-4", exact: true }).click();
  await expect(page.locator(".forced-banner").filter({ hasText: "pv is forced to 55.5" })).toContainText("by bob: loop check");
  await expect(page.getByRole("region", { name: "Operation" })).toContainText("FORCED");
  await page.getByRole("button", { name: `Free ${pv}` }).click();
  await expect(page.locator(".forced-banner")).toHaveCount(0);
  await expect.poll(async () => (await ask<{ force: unknown }>(`/v1/points/${pv}`)).force).toBeNull();

  // An output that a loop writes wants its name typed. It is heard of on a page that does not ask again.
  await open(page, "points");
  await page.getByRole("button", { name: `Force ${out}`, exact: true }).click();
  await dialog.getByLabel("Value to hold").fill("20");
  await dialog.getByLabel("Why").fill("stroke test");
  await expect(dialog.getByRole("button", { name: "Force", exact: true })).toBeDisabled();
  await dialog.getByLabel(/It overrides the loop tank-4/).fill(out);
  await dialog.getByRole("button", { name: "Force", exact: true }).click();
  await expect(page.getByRole("row").filter({ hasText: out })).toContainText("stroke test");
  await open(page, "loop/tank-4");
  await expect(page.locator(".forced-banner")).toContainText("stroke test");
  await ask(`/v1/points/${out}/unforce`, "POST", { by: "somebody else" });
  await expect(page.locator(".forced-banner")).toHaveCount(0);
});

test("a point that no loop writes is written, and taken back", async ({ page }) => {
  const { points } = await ask<{ points: { name: string; writable: boolean; written_by: string | null; range: [number, number]; value: number | null }[] }>("/v1/points");
  const point = points.find((one) => one.writable && !one.written_by && one.value !== null && one.range[1] - one.range[0] > 1);
  expect(point).toBeDefined();
  const { name, range, value } = point as { name: string; range: [number, number]; value: number };
  const next = Math.round((range[0] + 0.25 * (range[1] - range[0])) * 10) / 10;
  await open(page, "points");
  await page.getByLabel("Filter points").fill(name);
  await page.getByRole("button", { name: `Write ${name}`, exact: true }).click();
  await page.getByLabel("Value to write").fill(String(next));
  await page.getByRole("dialog").getByRole("button", { name: "Write", exact: true }).click();
  await expect.poll(async () => (await ask<{ value: number }>(`/v1/points/${name}`)).value).toBeCloseTo(next, 3);
  await undo(page, `${name}: `);
  await expect.poll(async () => (await ask<{ value: number }>(`/v1/points/${name}`)).value).toBeCloseTo(value, 3);
});

test("a host is drained, stays empty, and takes loops again", async ({ page }) => {
  interface Host {
    name: string;
    draining: boolean;
    drain_kept: boolean;
    loops_owned: number;
  }
  const host = async (): Promise<Host> => (await ask<{ hosts: Host[] }>("/v1/hosts")).hosts.find((one) => one.name === "c") as Host;
  await open(page, "hosts");
  const card = page.getByRole("article", { name: "Host c" });
  await card.getByLabel("c stays empty over restarts").check();
  await card.getByRole("button", { name: "Drain c" }).click();
  await expect(card).toContainText("being emptied");
  await expect(card).toContainText("stays so over restarts");
  await expect.poll(async () => (await host()).loops_owned).toBe(0);
  expect(await host()).toMatchObject({ draining: true, drain_kept: true });
  await expect(card).toContainText("it may be switched off");
  await card.getByRole("button", { name: "Take loops again, c" }).click();
  await expect.poll(async () => (await host()).draining).toBe(false);
  // Loops went on meanwhile, and go on; what a drain costs in cycles is a bench's to say.
  const { seq } = await loop("pressure");
  await expect.poll(async () => (await loop("pressure")).seq).toBeGreaterThan(seq + 10);
});

test("preferred hosts, a fallback and votes are put in force as one revision, and taken back", async ({ page }) => {
  interface Spec {
    revision: number;
    spec: { strategy: string; replicas: number; prefer?: string[]; fallback?: string | null; policy: { on_fewer: string } };
  }
  const spec = (): Promise<Spec> => ask<Spec>("/v1/loops/tank-5");
  await open(page, "loop/tank-5");
  await page.getByLabel("Strategy").selectOption("vote(3)");
  await expect.poll(async () => (await spec()).spec.strategy).toBe("vote(3)");
  await expect(page.getByRole("region", { name: "Running" })).toContainText("agree");
  const before = await spec();
  await page.getByRole("heading", { name: "Redundancy and faults" }).click();
  const panel = page.locator("details", { hasText: "Redundancy and faults" });
  await panel.getByLabel("Prefer a host or a label").selectOption("b");
  await panel.getByLabel("Prefer a host or a label").selectOption("a");
  await panel.getByRole("button", { name: "Prefer a more" }).click();
  await panel.getByLabel(/^Fallback/).selectOption({ label: "on-off@0.1.0" });
  await panel.getByLabel("With fewer left").selectOption("fault");
  await panel.getByRole("button", { name: "Put in force" }).click();
  await expect.poll(async () => (await spec()).spec.prefer).toEqual(["a", "b"]);
  const after = await spec();
  expect(after.revision).toBe(before.revision + 1);
  expect(after.spec.policy.on_fewer).toBe("fault");
  expect(after.spec.fallback).toBeTruthy();
  await undo(page, `revision ${after.revision} is in force`);
  await expect.poll(async () => (await spec()).spec.prefer ?? []).toEqual([]);
  await page.getByLabel("Strategy").selectOption("round-robin");
  await expect.poll(async () => (await spec()).spec.strategy).toBe("round-robin");
});

test("a report of the lab is shown, and can do nothing but draw", async ({ page }) => {
  test.skip(!process.env.BUMPLESS_PAGE_FOLDER, "the demonstration's folder is not known");
  const folder = join(process.env.BUMPLESS_PAGE_FOLDER ?? "", "reports");
  await open(page, "lab");
  await expect(page.getByText("No reports yet")).toBeVisible();
  mkdirSync(folder, { recursive: true });
  writeFileSync(
    join(folder, "flow.html"),
    `<!doctype html><html lang="en"><title>flow</title><style>h1 { color: rgb(1, 2, 3) }</style><h1 id="a">IAE of two laws</h1>
     <script>document.getElementById("a").textContent = "a script ran"; parent.document.title = "taken over";</script></html>`,
  );
  writeFileSync(join(folder, "flow.csv"), "case,iae\n");
  await open(page, "hosts");
  await open(page, "lab");
  await page.getByRole("link", { name: "flow", exact: true }).click();
  const frame = page.frameLocator("iframe.report");
  await expect(frame.getByRole("heading")).toHaveText("IAE of two laws");
  expect(await frame.getByRole("heading").evaluate((element) => getComputedStyle(element).color)).toBe("rgb(1, 2, 3)");
  expect(await page.title()).not.toContain("taken over");
  await expect(page.getByRole("link", { name: "flow.csv" })).toHaveAttribute("href", "/v1/lab/reports/flow.csv");
});

test("what is changed stands in the audit trail, with before and after, and the trail is whole", async ({ page }) => {
  interface Line {
    what: string;
    by: string;
    loop: string | null;
    changes: { field: string; before: unknown; after: unknown }[];
  }
  const { paths } = await ask<{ paths: Record<string, unknown> }>("/openapi.json");
  expect(paths["/v1/audit"], "a host keeps a trail").toBeDefined();
  await open(page, "loop/tank-3");
  await page.getByRole("button", { name: /your name, for the record/ }).click();
  await page.getByRole("dialog").getByLabel("Your name, for the record").fill("Łucja");
  await page.getByRole("button", { name: "Done" }).click();
  const before = (await loop("tank-3")).setpoint;
  await page.getByLabel("New setpoint").fill("61.5");
  await page.getByRole("button", { name: "Set", exact: true }).click();
  await expect.poll(async () => (await loop("tank-3")).setpoint).toBe(61.5);
  await undo(page, "setpoint");
  await expect.poll(async () => (await loop("tank-3")).setpoint).toBe(before);

  await page.keyboard.press("9");
  await expect(page.getByRole("heading", { name: "Audit", level: 1 })).toBeVisible();
  await expect(page.getByRole("region", { name: "Is the trail whole?" })).toContainText("The chains are whole");
  await page.getByRole("combobox", { name: "Loop", exact: true }).selectOption("tank-3");
  await page.getByRole("combobox", { name: "What", exact: true }).selectOption("loop");
  await page.getByLabel("By", { exact: true }).fill("Łucja");
  const rows = page.getByRole("region", { name: "Table of changes" }).getByRole("row").filter({ hasText: "loop.setpoint" });
  await expect(rows).toHaveCount(2);
  await expect(rows.nth(1)).toContainText(`${before} → 61.5`);
  await expect(rows.nth(0)).toContainText(`61.5 → ${before}`);
  await expect(rows.nth(1)).toContainText("Łucja");
  await expect(rows.nth(1)).toContainText("done");
  await rows.nth(1).getByRole("button", { name: /^loop\.setpoint, entry/ }).click();
  await expect(page.getByRole("dialog")).toContainText("Łucja, over api");
  await page.keyboard.press("Escape");
  await figure(page, "audit");
  const { entries } = await ask<{ entries: Line[] }>("/v1/audit?loop=tank-3&what=loop.setpoint");
  expect(entries[1]?.changes.map((change) => change.after)).toContain(61.5);
  // All of it as a file, for a spreadsheet and for a check elsewhere.
  const address = await page.getByRole("link", { name: "Export CSV" }).getAttribute("href");
  const table = await (await fetch(new URL(address ?? "", process.env.BUMPLESS_PAGE))).text();
  expect(table.split("\n")[0]).toContain("changes");
  expect(table).toContain("loop.setpoint");
});

/** A cell of one host whose device does not answer, for jobs that take their time. */
async function with_device(act: (base: string) => Promise<void>): Promise<void> {
  const folder = mkdtempSync(join(tmpdir(), "bumpless-jobs-"));
  writeFileSync(
    join(folder, "host.toml"),
    `host = "field"\ndata = "data"\n[cell]\nname = "jobs"\n[api]\nlisten = "127.0.0.1:0"\n[roles]\nio = true\ncontrol = true
     [[bus]]\nid = "line"\ndriver = "modbus-tcp"\naddress = "127.0.0.1:9"
     [[bus.job]]\nname = "set-range"\ntext = "0 to 150 °C"\nstep = [{ read = { table = "holding", address = 100, count = 2 } }]
     [[bus.point]]\nid = "line.level"\ntable = "input"\naddress = 0\nlow = 0.0\nhigh = 100.0\n`,
  );
  const child = spawn(process.env.BUMPLESS_BIN ?? "bumpless", ["host", "--until-stdin-closes", "--config", join(folder, "host.toml")], { stdio: ["pipe", "pipe", "inherit"] });
  const ended = new Promise<void>((resolve) => child.once("exit", () => resolve()));
  try {
    const api = await new Promise<string>((resolve, reject) => {
      let said = "";
      child.stdout.on("data", (piece: Buffer) => {
        said += piece.toString();
        const found = /"api":"(http:[^"]+)"/.exec(said);
        if (found) resolve(found[1] as string);
      });
      child.once("exit", (code) => reject(new Error(`the host ended with ${code}: ${said}`)));
    });
    await act(api);
  } finally {
    child.stdin.end();
    await ended;
    rmSync(folder, { recursive: true, force: true });
  }
}

test("a job is taken in, waits, is cancelled, and tells its end", async ({ page }) => {
  await with_device(async (base) => {
    await page.goto(`${base}/#/points/jobs`);
    const bus = page.getByRole("article", { name: "Bus line" });
    await expect(bus).toContainText("does not answer");
    await bus.getByRole("button", { name: "Read or write registers…" }).click();
    await bus.getByRole("button", { name: "Read", exact: true }).click();
    const jobs = page.getByRole("region", { name: "Table of jobs" });
    await expect(jobs.getByRole("row").filter({ hasText: "read-block" })).toHaveCount(1);
    // A second one waits behind the first; a named one is asked for by its name.
    await bus.getByRole("button", { name: "Start set-range" }).click();
    const dialog = page.getByRole("dialog");
    await dialog.getByRole("textbox").fill("set-range");
    await dialog.getByRole("button", { name: "Start set-range" }).click();
    const named = jobs.getByRole("row").filter({ hasText: "set-range" });
    await expect(named).toHaveCount(1);
    await named.getByRole("button", { name: /^Cancel job/ }).click();
    await expect(named).toContainText("cancelled");
    await named.getByRole("button", { name: /^Result of job/ }).click();
    await expect(page.getByRole("dialog")).toContainText("It read nothing.");
    await page.getByRole("dialog").getByRole("button", { name: "Close" }).click();
    expect(await serious(page, "jobs")).toEqual([]);
  });
});

/** Nothing sticks out to the side. */
/** What makes the page wider than its window, innermost last; nothing where it fits. */
const sticks_out = (page: Page): Promise<string[]> =>
  page.evaluate(() => {
    if (document.documentElement.scrollWidth <= innerWidth) return [];
    const scrolls = (one: Element | null): boolean => one !== null && (getComputedStyle(one).overflowX !== "visible" || scrolls(one.parentElement));
    const beyond = [...document.querySelectorAll("body *")].filter((one) => one.getBoundingClientRect().right > innerWidth && !scrolls(one.parentElement));
    return beyond.map((one) => `${one.tagName} ${one.className} ${one.textContent?.slice(0, 30)}`);
  });

for (const [name, width, height, scheme] of [
  ["phone", 390, 844, "dark"],
  ["desktop", 1280, 720, "light"],
  ["wall", 3840, 2160, "dark"],
] as const) {
  test(`alarms, points, hosts, lab and audit on a ${name}`, async ({ page }) => {
    test.slow();
    await define("tank-1", "high", { kind: "hi", limit: 5, priority: "high", response: "close the inlet" });
    await define("tank-1", "watch", { kind: "hi", limit: 4, priority: "low" });
    await page.emulateMedia({ colorScheme: scheme });
    await page.setViewportSize({ width, height });
    const found: string[] = [];
    for (const place of ["alarms", "alarms/quiet", "alarms/history", "alarms/defined", "alarms/load", "points", "points/jobs", "hosts", "lab", "audit", "loop/tank-1"]) {
      await open(page, place);
      await expect(page.getByRole("heading", { level: 1 })).toBeVisible();
      await expect(page.locator(".bell.waiting.high")).toBeVisible();
      expect(await sticks_out(page), `${place} sticks out`).toEqual([]);
      found.push(...(await serious(page, `${name} ${place}`)));
    }
    await open(page, "alarms");
    await page.getByRole("button", { name: "More about tank-1 high" }).click();
    await expect(page.getByRole("dialog")).toBeVisible();
    found.push(...(await serious(page, `${name} dialog`)));
    await page.keyboard.press("Escape");
    await expect(page.getByRole("dialog")).toHaveCount(0);
    await figure(page, `alarms-${name}`);
    expect(found).toEqual([]);
    for (const alarm of ["high", "watch"]) await undefine("tank-1", alarm);
  });
}
