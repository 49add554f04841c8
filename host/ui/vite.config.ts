// How the page is built: one script and one style, named by their content, without anything from elsewhere.
import { defineConfig } from "vite";

export default defineConfig({
  build: {
    outDir: "dist",
    // pack.mjs empties it; the file that keeps the folder in the repository stays.
    emptyOutDir: false,
    target: "es2022",
    modulePreload: { polyfill: false },
    assetsInlineLimit: 0,
    rollupOptions: {
      output: {
        entryFileNames: "assets/page-[hash].js",
        chunkFileNames: "assets/part-[hash].js",
        assetFileNames: "assets/[name]-[hash][extname]",
      },
    },
  },
  // For work on the page: the API of a host that runs.
  server: { proxy: Object.fromEntries(["/v1", "/openapi.json", "/addresses"].map((path) => [path, process.env.BUMPLESS_API ?? "http://127.0.0.1:8480"])) },
});
