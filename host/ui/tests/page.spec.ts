// What an operator and an engineer do with the page, in a real browser, on a real cell.
import { readFileSync } from "node:fs";
import { expect, test } from "@playwright/test";
import { ask, component, figure, loop, open, serious } from "./steps";

/** Nothing on the page may go wrong unseen. */
test.beforeEach(({ page }) => {
  page.on("pageerror", (error) => {
    throw error;
  });
});

test("the overview shows all loops as they move", async ({ page }) => {
  const refused: string[] = [];
  page.on("console", (message) => {
    if (message.text().includes("Content Security Policy")) refused.push(message.text());
  });
  await open(page, "");
  await expect(page.getByRole("link", { name: "pressure", exact: true })).toBeVisible();
  await expect(page.locator(".card")).toHaveCount(6);
  const seq = (await loop("pressure")).seq;
  await expect.poll(async () => (await loop("pressure")).seq).toBeGreaterThan(seq + 5);
  await expect(page.locator(".card", { hasText: "pressure" }).locator(".big")).toContainText("bar");
  await page.getByLabel("Filter loops by name").fill("tank-3");
  await expect(page.locator(".card")).toHaveCount(1);
  expect(refused).toEqual([]);
});

test("setpoint, mode and output, each taken back", async ({ page }) => {
  await open(page, "loop/tank-1");
  const before = await loop("tank-1");
  await page.getByLabel("New setpoint").fill("33.5");
  await page.getByRole("button", { name: "Set", exact: true }).click();
  await expect.poll(async () => (await loop("tank-1")).setpoint).toBe(33.5);
  await page.getByRole("button", { name: "Undo" }).last().click();
  await expect.poll(async () => (await loop("tank-1")).setpoint).toBe(before.setpoint);

  await page.getByRole("button", { name: "Manual", exact: true }).click();
  await expect.poll(async () => (await loop("tank-1")).mode).toBe("manual");
  await page.getByLabel("New output out").fill("41");
  await page.getByLabel("New output out").press("Enter");
  await expect.poll(async () => (await loop("tank-1")).outputs.out).toBe(41);
  await page.getByRole("button", { name: "Automatic", exact: true }).click();
  await expect.poll(async () => (await loop("tank-1")).mode).toBe("automatic");
  // Outside of the range nothing can be sent.
  await page.getByLabel("New setpoint").fill("1000");
  await expect(page.getByRole("button", { name: "Set", exact: true })).toBeDisabled();
});

test("tuning, strategy and owner", async ({ page }) => {
  await open(page, "loop/tank-2");
  await page.getByLabel("New k", { exact: true }).fill("2.5");
  await page.getByRole("button", { name: "Put 1 in force" }).click();
  await expect(page.getByText("k = 2.5")).toBeVisible();
  await page.keyboard.press("Escape");
  await page.getByLabel("Strategy").selectOption("local");
  await expect.poll(async () => (await ask<{ spec: { strategy: string } }>("/v1/loops/tank-2")).spec.strategy).toBe("local");
  const owner = (await loop("tank-2")).owner;
  const other = ["a", "b", "c"].find((name) => name !== owner) as string;
  await page.getByLabel("Give the ownership to").selectOption(other);
  await page.getByRole("button", { name: "Move" }).click();
  await expect.poll(async () => (await loop("tank-2")).owner).toBe(other);
});

test("the trend pans back into the log and comes back to now", async ({ page }) => {
  await open(page, "loop/pressure");
  const readout = page.locator(".readout");
  await expect(readout).toContainText("cycle");
  const cycle = async (): Promise<number> => Number(/cycle (\d+)/.exec(await readout.innerText())?.[1] ?? Number.NaN);
  await page.getByRole("button", { name: "30 s" }).click();
  // By how many cycles the readout is behind the loop.
  const behind = async (): Promise<number> => (await loop("pressure")).seq - (await cycle());
  // A demonstration that has just begun has nothing to look back to yet.
  await expect.poll(async () => (await loop("pressure")).seq, { timeout: 60_000 }).toBeGreaterThan(400);
  await page.locator(".plot").focus();
  await page.keyboard.press("PageUp");
  await expect(page.getByRole("button", { name: "Now", exact: true })).toHaveAttribute("aria-pressed", "false");
  await expect.poll(behind).toBeGreaterThan(250);
  // From cycle to cycle.
  await page.keyboard.press("Shift+ArrowLeft");
  const there = await cycle();
  await page.keyboard.press("Shift+ArrowLeft");
  await expect.poll(cycle).toBeLessThan(there);
  await page.keyboard.press("End");
  await expect(page.getByRole("button", { name: "Now", exact: true })).toHaveAttribute("aria-pressed", "true");
  await page.mouse.move(0, 0);
  await expect.poll(behind).toBeLessThan(200);
  await expect(page.locator(".shares")).toContainText("%");
});

test("a component dropped on a loop goes all the way: trial, backtest, shadow, switch, probation", async ({ page }) => {
  await open(page, "loop/pressure");
  const before = await loop("pressure");
  const bytes = readFileSync(component("pid")).toString("base64");
  const transfer = await page.evaluateHandle((text) => {
    const data = new DataTransfer();
    const raw = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
    data.items.add(new File([raw], "pid.wasm", { type: "application/wasm" }));
    return data;
  }, bytes);
  await page.dispatchEvent("main", "dragover", { dataTransfer: transfer });
  await expect(page.locator(".dropping")).toBeVisible();
  await page.dispatchEvent("main", "drop", { dataTransfer: transfer });
  await expect(page.getByRole("heading", { name: "Change pressure" })).toBeVisible();
  await expect(page.locator(".admission")).toContainText("Trial");
  await page.getByRole("button", { name: "Backtest", exact: true }).click();
  await expect(page.getByRole("region", { name: "Backtest" })).toContainText("Verdict");
  await expect(page.getByRole("region", { name: "Backtest" }).locator("canvas")).toBeVisible();
  await page.getByLabel("for cycles").fill("30");
  await page.getByRole("button", { name: "Start shadow" }).click();
  await expect(page.getByRole("region", { name: "Shadow" })).toContainText("30 of 30 cycles");
  // What a cycle leaves while nobody has switched: the old one.
  expect((await loop("pressure")).component).toBe(before.component);
  await figure(page, "change");
  await page.getByRole("button", { name: "Switch to pid" }).click();
  await expect(page.getByRole("region", { name: "Switch" })).toContainText("State came over by");
  await expect.poll(async () => (await loop("pressure")).component).toContain("pid@");
  await expect(page.getByRole("region", { name: "Probation" })).toContainText("In service.");
  await page.getByRole("button", { name: "Go back to what ran before" }).click();
  await expect.poll(async () => (await loop("pressure")).component).toBe(before.component);
  expect((await loop("pressure")).tally.lost).toBe(before.tally.lost);
});

test("a component that is not sound stays outside, and says why", async ({ page }) => {
  await open(page, "library");
  await page.getByLabel("Component file").setInputFiles(component("guests/traps"));
  await expect(page.getByRole("alert").filter({ hasText: "was not taken in" })).toContainText("trial");
  await expect(page.getByRole("button", { name: "Take it in anyway" })).toBeEnabled();
});

test("a rollout begins with one loop and goes on to the others", async ({ page }) => {
  test.slow();
  await open(page, "rollouts");
  const form = page.getByRole("region", { name: "New rollout" });
  await form.getByLabel("Component").selectOption({ label: "pidplus@0.1.0" });
  await form.getByLabel("tank-4").check();
  await form.getByLabel("tank-3").check();
  await form.getByLabel("Cycles to watch").fill("15");
  await form.getByLabel("Greatest error, × before").fill("100");
  await form.getByRole("button", { name: "Begin with tank-4" }).click();
  const rows = page.getByRole("region", { name: /^Rollout / }).getByRole("row");
  await expect(rows).toHaveCount(3);
  await expect(rows.nth(1)).toContainText("tank-4");
  await expect(rows.filter({ hasText: /done/ })).toHaveCount(2, { timeout: 60_000 });
  expect((await loop("tank-3")).component).toContain("pidplus@");
});

test("a component's note and labels, taken back", async ({ page }) => {
  await open(page, "library");
  await page.getByRole("link", { name: /^on-off@/ }).click();
  await page.getByLabel("Note").fill("for the oven");
  await page.getByRole("button", { name: "Keep" }).click();
  await expect(page.getByText("Note kept.")).toBeVisible();
  await page.getByRole("button", { name: "Undo" }).last().click();
  await expect(page.getByLabel("Note")).toHaveValue("stock controller");
  await page.getByLabel("New label, key=value").fill("stage=pilot");
  await page.getByRole("button", { name: "Add" }).click();
  await expect(page.getByRole("button", { name: "Remove label stage" })).toBeVisible();
});

test("what cannot be taken back wants its name typed", async ({ page }) => {
  const spec = (await ask<{ spec: object }>("/v1/loops/tank-5")).spec;
  await open(page, "loop/tank-5");
  await page.getByRole("heading", { name: "Revisions" }).click();
  await page.getByRole("button", { name: "Delete the loop" }).click();
  const dialog = page.getByRole("dialog");
  await expect(dialog.getByRole("button", { name: "Delete the loop" })).toBeDisabled();
  await dialog.getByRole("textbox").fill("tank-4");
  await expect(dialog.getByRole("button", { name: "Delete the loop" })).toBeDisabled();
  await dialog.getByRole("textbox").fill("tank-5");
  await dialog.getByRole("button", { name: "Delete the loop" }).click();
  await expect(page.getByRole("heading", { name: "Loops" })).toBeVisible();
  await expect(page.locator(".card")).toHaveCount(5);
  // A new one from its specification.
  await page.getByRole("link", { name: "New loop" }).click();
  await page.getByLabel("Loop as JSON").fill(JSON.stringify(spec));
  await page.getByRole("button", { name: "Create" }).click();
  await expect(page.getByRole("heading", { name: "tank-5" })).toBeVisible();
});

test("everything can be done with the keyboard alone", async ({ page }) => {
  test.slow();
  await open(page, "");
  await page.keyboard.press("3");
  await expect(page.getByRole("heading", { name: "Hosts", exact: true })).toBeVisible();
  await page.keyboard.press("1");
  await expect(page.locator(".card").first()).toBeVisible();
  // By Tab to a loop, into it, to its setpoint.
  const reach = async (there: () => Promise<boolean>): Promise<void> => {
    for (let presses = 0; presses < 60; presses++) {
      if (await there()) return;
      await page.keyboard.press("Tab");
    }
    throw new Error("the keyboard does not lead there");
  };
  const active = (): Promise<string> => page.evaluate(() => document.activeElement?.getAttribute("aria-label") ?? document.activeElement?.textContent ?? "");
  await reach(async () => (await active()) === "tank-3");
  await page.keyboard.press("Enter");
  await expect(page.getByRole("heading", { name: "tank-3" })).toBeVisible();
  await reach(async () => (await active()) === "New setpoint");
  const before = (await loop("tank-3")).setpoint;
  await page.keyboard.type(String(before - 2.5));
  await page.keyboard.press("Enter");
  await expect.poll(async () => (await loop("tank-3")).setpoint).toBe(before - 2.5);
  // The cell may have it before the page offers to take it back.
  await expect(page.locator(".message").filter({ hasText: "tank-3: setpoint" })).toBeVisible();
  // Within a field a letter is a letter.
  await page.keyboard.press("Shift+Tab");
  await page.keyboard.press("u");
  await expect.poll(async () => (await loop("tank-3")).setpoint).toBe(before);
  await page.keyboard.press("?");
  await expect(page.getByRole("dialog")).toBeVisible();
  await page.keyboard.press("Escape");
  await expect(page.getByRole("dialog")).toHaveCount(0);
});

test("a lost connection greys everything at once, and comes back without a reload", async ({ page, context }) => {
  await open(page, "loop/pressure");
  await page.evaluate(() => ((window as unknown as { same: boolean }).same = true));
  const lost = page.waitForSelector("main.stale");
  await context.setOffline(true);
  await lost;
  await expect(page.getByRole("alert").filter({ hasText: "Connection lost" })).toBeVisible();
  await expect(page.getByRole("button", { name: "Manual", exact: true })).toBeDisabled();
  await context.setOffline(false);
  await expect(page.locator("main.stale")).toHaveCount(0);
  expect(await page.evaluate(() => (window as unknown as { same: boolean }).same)).toBe(true);
  const seq = /cycle (\d+)/.exec(await page.locator(".readout").innerText())?.[1];
  await expect(page.locator(".readout")).not.toContainText(`cycle ${seq} `);
});

for (const scheme of ["light", "dark"] as const) {
  test(`nothing serious for other senses, ${scheme}`, async ({ page }) => {
    test.slow();
    await page.emulateMedia({ colorScheme: scheme });
    const found: string[] = [];
    for (const place of ["", "loop/pressure", "change/pressure", "library", "hosts", "points", "events", "rollouts", "lab", "new"]) {
      await open(page, place);
      await expect(page.getByRole("heading", { level: 1 })).toBeVisible();
      found.push(...(await serious(page, place || "overview")));
    }
    await page.setViewportSize({ width: 390, height: 844 });
    await open(page, "loop/pressure");
    found.push(...(await serious(page, "phone")));
    expect(found).toEqual([]);
    const wider = await page.evaluate(() => document.documentElement.scrollWidth - innerWidth);
    expect(wider, "nothing sticks out on a phone").toBeLessThanOrEqual(0);
  });
}

test("pictures for the documentation", async ({ page }) => {
  await page.setViewportSize({ width: 1280, height: 720 });
  await open(page, "");
  await expect(page.locator(".card .spark").first()).toBeVisible();
  await figure(page, "overview");
  await open(page, "loop/pressure");
  await page.getByRole("button", { name: "1 min" }).click();
  await expect(page.locator(".shares")).toContainText("%");
  await figure(page, "loop");
  await page.emulateMedia({ colorScheme: "dark" });
  await open(page, "hosts");
  await expect(page.locator(".matrix")).toBeVisible();
  await figure(page, "hosts-dark");
  await page.setViewportSize({ width: 390, height: 844 });
  await open(page, "loop/pressure");
  await expect(page.locator(".plot canvas")).toBeVisible();
  await figure(page, "phone-dark");
});

test("a way to the plant is made slow and lossy for a while", async ({ page }) => {
  interface Last {
    owner: string;
    seq: number;
    last: { committed_after_us: number };
  }
  const last = (): Promise<Last> => ask<Last>("/v1/loops/pressure");
  if ((await loop("pressure")).owner !== "b") await ask("/v1/loops/pressure/move", "POST", { host: "b" });
  await open(page, "hosts");
  await expect(page.getByRole("button", { name: "Delay 10 s, plant" })).toHaveCount(0);
  await page.getByRole("button", { name: "Delay 10 s, b" }).click();
  await expect(page.getByText("delay b: asked for")).toBeVisible();
  // 30 ms to the owner and 30 ms back; or another one took over meanwhile.
  await expect.poll(async () => { const now = await last(); return now.owner !== "b" || now.last.committed_after_us >= 60_000; }, { intervals: [50] }).toBe(true);
  await page.getByRole("button", { name: "Lose 10 s, c" }).click();
  await expect(page.getByText("lose c: asked for")).toBeVisible();
  const { seq } = await last();
  await expect.poll(async () => (await last()).seq).toBeGreaterThan(seq + 20);
});

// The last one: it kills.
test("an owner is killed: the loop goes on, the page tells who took over, and the host comes back", async ({ page }) => {
  await open(page, "loop/pressure");
  const before = await loop("pressure");
  await open(page, "hosts");
  await page.getByRole("button", { name: `Kill ${before.owner}` }).click();
  await expect(page.getByRole("article", { name: `Host ${before.owner}` })).toContainText("not alive");
  await open(page, "loop/pressure");
  await expect(page.getByRole("region", { name: "Events of pressure" })).toContainText(`took over from ${before.owner}`);
  // The event may be one of an earlier test; what the loop says is of now.
  await expect.poll(async () => (await loop("pressure")).owner).not.toBe(before.owner);
  expect((await loop("pressure")).seq).toBeGreaterThan(before.seq);
  await page.getByRole("link", { name: "Back to all loops" }).click();
  await expect(page.locator(".card.odd, .card.grave").first()).toContainText("replicas");
  await open(page, "hosts");
  await page.getByRole("button", { name: `Start again ${before.owner}` }).click();
  await expect(page.getByRole("article", { name: `Host ${before.owner}` })).not.toContainText("not alive", { timeout: 60_000 });
});
