// Opens the page in a browser and watches it for a while: `node watch.mjs BASE SECONDS BROWSER`. For `cargo xtask bench page`.
// The last line of output is what was seen, as JSON. Never: touches the cell; it only looks.
import { readdirSync, readFileSync } from "node:fs";
import { chromium } from "@playwright/test";

const [base, seconds, browser_path] = process.argv.slice(2);
/** Ticks of processor time per second: sysconf(_SC_CLK_TCK) is 100 on Linux. */
const TICKS = 100;

/** Processor time in s and resident memory in MB of a process and all below it. */
function used(root) {
  const parents = new Map();
  const own = new Map();
  for (const name of readdirSync("/proc")) {
    if (!/^\d+$/.test(name)) continue;
    try {
      const stat = readFileSync(`/proc/${name}/stat`, "utf8");
      const fields = stat.slice(stat.lastIndexOf(")") + 2).split(" ");
      parents.set(Number(name), Number(fields[1]));
      own.set(Number(name), { ticks: Number(fields[11]) + Number(fields[12]), pages: Number(fields[21]) });
    } catch {
      // It ended in between.
    }
  }
  let [ticks, pages] = [0, 0];
  for (const [pid, mine] of own) {
    let at = pid;
    while (at && at !== root) at = parents.get(at) ?? 0;
    if (at === root) {
      ticks += mine.ticks;
      pages += mine.pages;
    }
  }
  return { s: ticks / TICKS, mb: (pages * 4096) / 1e6 };
}

const server = await chromium.launchServer({
  executablePath: browser_path,
  args: ["--no-sandbox", "--disable-dev-shm-usage", "--enable-precise-memory-info"],
});
const root = server.process().pid;
const browser = await chromium.connect(server.wsEndpoint());
try {
  const page = await browser.newPage({ viewport: { width: 1920, height: 1080 } });
  const session = await page.context().newCDPSession(page);
  await page.goto(`${base}/#/`, { waitUntil: "load" });
  await page.waitForSelector(".card");
  const opened = await page.evaluate(() => ({
    first_paint_ms: performance.getEntriesByName("first-contentful-paint")[0]?.startTime ?? Number.NaN,
    bytes: [...performance.getEntriesByType("navigation"), ...performance.getEntriesByType("resource")]
      .filter((entry) => !entry.name.includes("/v1/"))
      .reduce((sum, entry) => sum + entry.transferSize, 0),
  }));
  await page.evaluate(() => {
    window.frames_seen = [];
    let [count, second] = [0, performance.now()];
    const frame = (now) => {
      count += 1;
      if (now - second >= 1_000) {
        window.frames_seen.push((count * 1_000) / (now - second));
        [count, second] = [0, now];
      }
      requestAnimationFrame(frame);
    };
    requestAnimationFrame(frame);
  });
  const heap = async () => {
    await session.send("HeapProfiler.collectGarbage");
    const { usedSize } = await session.send("Runtime.getHeapUsage");
    return usedSize / 1e6;
  };
  // The spark lines fill for a minute; a longer watch begins after that.
  const warm = Math.min(60, Number(seconds) / 3);
  await page.waitForTimeout(warm * 1_000);
  const heap_start_mb = await heap();
  const before = used(root);
  const started = performance.now();
  await page.waitForTimeout((Number(seconds) - warm) * 1_000);
  const after = used(root);
  const cores = (after.s - before.s) / ((performance.now() - started) / 1_000);
  const frames = (await page.evaluate(() => window.frames_seen)).slice(1).sort((a, b) => a - b);
  const seen = {
    ...opened,
    frames_per_s: frames[frames.length >> 1] ?? 0,
    frames_p1_per_s: frames[0] ?? 0,
    cores,
    heap_start_mb,
    heap_end_mb: await heap(),
    resident_mb: after.mb,
  };
  console.log(JSON.stringify(seen));
} finally {
  await browser.close();
  await server.close();
}
