// A host that wants to know who one is: the first administrator, signing in and out, what a viewer cannot do, and what a script could.
import { type ChildProcess, spawn } from "node:child_process";
import { mkdirSync, mkdtempSync, readFileSync, rmSync, writeFileSync } from "node:fs";
import { tmpdir } from "node:os";
import { join } from "node:path";
import { expect, test } from "@playwright/test";

const PASSWORD = "correct horse battery";
let folder = "";
let api = "";
let host: ChildProcess;

test.beforeAll(async () => {
  folder = mkdtempSync(join(tmpdir(), "bumpless-access-"));
  mkdirSync(join(folder, "one"));
  const file = join(folder, "one", "host.toml");
  writeFileSync(file, 'host = "one"\n[cell]\nname = "test-page"\n[api]\nlisten = "127.0.0.1:0"\n[security]\n');
  const program = process.env.BUMPLESS_BIN ?? new URL("../../../target/debug/bumpless", import.meta.url).pathname;
  host = spawn(program, ["host", "--config", file, "--until-stdin-closes"], { stdio: ["pipe", "pipe", "ignore"] });
  api = await new Promise<string>((resolve, reject) => {
    host.stdout?.once("data", (line: Buffer) => resolve((JSON.parse(line.toString()) as { api: string }).api));
    host.once("exit", (code) => reject(new Error(`the host ended with ${code}`)));
  });
});

test.afterAll(async () => {
  const ended = new Promise<void>((resolve) => host.once("exit", () => resolve()));
  host.stdin?.end();
  await ended;
  rmSync(folder, { recursive: true, force: true });
});

test("nobody sees the plant before he signed in, and a viewer only looks", async ({ page }) => {
  page.on("pageerror", (error) => {
    throw error;
  });
  await page.goto(api);
  await expect(page.getByText("This cell has no administrator yet")).toBeVisible();
  await expect(page.getByRole("navigation")).toHaveCount(0);
  await page.getByLabel("First-boot token").fill("a guess");
  await page.getByLabel("Name").fill("root");
  await page.getByLabel(/Password/).fill(PASSWORD);
  await page.getByRole("button", { name: "Make the administrator" }).click();
  await expect(page.getByRole("alert")).toContainText("wrong");
  await page.getByLabel("First-boot token").fill(readFileSync(join(folder, "one", "data", "first-token"), "utf8"));
  await page.getByLabel(/Password/).fill(PASSWORD);
  await page.getByRole("button", { name: "Make the administrator" }).click();
  await expect(page.getByRole("button", { name: /root admin/ })).toBeVisible();
  await expect(page.getByText("one", { exact: true }).first()).toBeVisible();

  // A change goes with the session's second secret: the page's own does, one that leaves it out does not.
  const made = await page.evaluate(async (password) => {
    const { csrf } = (await (await fetch("/v1/access/me")).json()) as { csrf: string };
    const add = (headers: Record<string, string>): Promise<number> =>
      fetch("/v1/access/users", {
        method: "POST",
        headers: { "content-type": "application/json", ...headers },
        body: JSON.stringify({ name: "vera", role: "viewer", password }),
      }).then((response) => response.status);
    return [await add({}), await add({ "x-csrf-token": csrf }), document.cookie];
  }, PASSWORD);
  expect(made).toEqual([403, 201, ""]);

  await page.getByRole("button", { name: /root admin/ }).click();
  await page.getByRole("button", { name: "Sign out" }).click();
  await expect(page.getByText("This host wants to know who you are")).toBeVisible();
  await page.getByLabel("Name").fill("vera");
  await page.getByLabel("Password").fill("not her password");
  await page.getByRole("button", { name: "Sign in" }).click();
  await expect(page.getByRole("alert")).toContainText("wrong");
  await page.getByLabel("Password").fill(PASSWORD);
  await page.getByRole("button", { name: "Sign in" }).click();
  await expect(page.getByRole("button", { name: /vera viewer/ })).toBeVisible();
  await page.goto(`${api}/#/hosts`);
  const drain = page.getByRole("button", { name: /^Drain/ }).first();
  await expect(drain).toBeDisabled();
  await expect(drain).toHaveAttribute("title", /needs the role engineer/);

  // The policy stops what a page that was tampered with would do.
  const blocked = await page.evaluate(async () => {
    const told = new Promise<string>((resolve) => document.addEventListener("securitypolicyviolation", (event) => resolve(event.violatedDirective), { once: true }));
    const script = document.createElement("script");
    script.textContent = "document.title = 'taken over'";
    document.head.append(script);
    return [await told, document.title.includes("taken over")];
  });
  expect(blocked).toEqual(["script-src-elem", false]);
});
