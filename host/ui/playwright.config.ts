// The page's tests: one browser, one demonstration for all of them, one after the other, for they share its hosts.
import { defineConfig } from "@playwright/test";

export default defineConfig({
  testDir: "tests",
  globalSetup: "./tests/demonstration.ts",
  outputDir: "../../target/page-tests",
  // Generous: unoptimised hosts and a browser share a machine that may have other work. Nothing waits longer than it must.
  timeout: 180_000,
  expect: { timeout: 40_000 },
  workers: 1,
  fullyParallel: false,
  forbidOnly: true,
  reporter: [["list"]],
  use: {
    viewport: { width: 1440, height: 900 },
    colorScheme: "light",
    locale: "en-GB",
    timezoneId: "Europe/Berlin",
    trace: "retain-on-failure",
    launchOptions: {
      executablePath: process.env.BUMPLESS_CHROMIUM ?? "/usr/bin/chromium",
      // The tests may run as root, where the browser has no sandbox of its own; it sees nothing but this page.
      args: ["--no-sandbox", "--disable-dev-shm-usage"],
    },
  },
});
