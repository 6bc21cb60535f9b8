import { defineConfig } from "vitest/config";

// The service that `npm run dev` hands requests to.
const SERVICE = "http://127.0.0.1:8000";

export default defineConfig({
  base: "./",
  build: {
    target: "es2022",
    assetsInlineLimit: 0, // the page's policy allows no data: addresses
    modulePreload: { polyfill: false },
    chunkSizeWarningLimit: 2000, // Swagger UI, on a page of its own
    rolldownOptions: { input: ["index.html", "docs/index.html"] },
  },
  server: {
    proxy: {
      "/api": { target: SERVICE, ws: true },
      "/openapi.json": { target: SERVICE },
    },
  },
  test: { include: ["tests/**/*.test.ts"], setupFiles: ["tests/setup.ts"] },
});
