// One script and one style sheet, which `mapping report` writes into its file.
import { defineConfig } from "vite";

export default defineConfig({
  resolve: { tsconfigPaths: true },
  build: {
    outDir: "../service/page/built/report",
    emptyOutDir: true,
    assetsInlineLimit: 1_000_000,
    chunkSizeWarningLimit: 1500,
    lib: {
      entry: "src/report/main.ts",
      formats: ["iife"],
      name: "vislocReport",
      fileName: () => "report.js",
      cssFileName: "report",
    },
  },
});
