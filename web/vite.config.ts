// The page that the service serves at `/`.
import { defineConfig } from "vite";

export default defineConfig({
  base: "./",
  build: {
    outDir: "../visloc_web/built/page",
    emptyOutDir: true,
    assetsInlineLimit: 0, // the page's Content-Security-Policy allows no data: scripts or styles
    modulePreload: { polyfill: false },
    chunkSizeWarningLimit: 1500, // three.js; kilobytes, before compression
  },
});
