// Starts a demonstration for the tests and stops it after them. It stops by itself too, should this process be killed.
import { spawn } from "node:child_process";
import { mkdtempSync, rmSync } from "node:fs";
import { tmpdir } from "node:os";
import { join } from "node:path";

/** Longest wait for the cell, in ms: unoptimised programs on a machine that may be busy. */
const READY_MAX_MS = 240_000;

export default async function start(): Promise<() => Promise<void>> {
  // One that runs already, for work on the page itself.
  if (process.env.BUMPLESS_PAGE) return () => Promise.resolve();
  const root = new URL("../../../", import.meta.url).pathname;
  const program = process.env.BUMPLESS_BIN ?? join(root, "target/debug/bumpless");
  const components = process.env.BUMPLESS_COMPONENTS ?? join(root, "target/components");
  process.env.BUMPLESS_COMPONENTS = components;
  const folder = mkdtempSync(join(tmpdir(), "bumpless-page-"));
  process.env.BUMPLESS_BIN = program;
  process.env.BUMPLESS_PAGE_FOLDER = folder;
  const child = spawn(program, ["demo", "--for", "1500", "--tanks", "5", "--dir", folder, "--components", components], {
    stdio: ["ignore", "pipe", "pipe"],
  });
  const ended = new Promise<void>((resolve) => child.once("exit", () => resolve()));
  let said = "";
  await new Promise<void>((resolve, reject) => {
    const late = setTimeout(() => reject(new Error(`the demonstration was not ready in time:\n${said}`)), READY_MAX_MS);
    const hear = (piece: Buffer): void => {
      said += piece.toString();
      const found = /in a browser: (http:\S+)\//.exec(said);
      if (found) {
        process.env.BUMPLESS_PAGE = found[1];
        clearTimeout(late);
        resolve();
      }
    };
    child.stdout.on("data", hear);
    child.stderr.on("data", hear);
    child.once("exit", (code) => reject(new Error(`the demonstration ended with ${code}:\n${said}`)));
  });
  return async () => {
    child.kill("SIGINT");
    await ended;
    rmSync(folder, { recursive: true, force: true });
  };
}
