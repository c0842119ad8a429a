// The pages that the service serves at `/`, `/docs` and `/redoc`.
import { defineConfig, type Plugin } from "vite";

// ReDoc shows its maker's logo from another host, which the page's Content-Security-Policy forbids.
// Outside of a browser, its bundle would also require a module called "null".
const redocForBrowsers: Plugin = {
  name: "redoc-for-browsers",
  resolveId: (id) => (id === "null" ? "\0null" : null),
  load: (id) => (id === "\0null" ? "export default null" : null),
  transform(code, id) {
    if (!id.includes("redoc.standalone.js")) return null;
    const logo = "https://cdn.redoc.ly/redoc/logo-mini.svg";
    if (!code.includes(logo)) throw new Error(`ReDoc no longer shows ${logo}: remove this plugin`);
    return { code: code.replaceAll(logo, "data:,"), map: null };
  },
};

export default defineConfig({
  base: "./",
  plugins: [redocForBrowsers],
  resolve: { tsconfigPaths: true },
  build: {
    outDir: "../service/page/built/page",
    emptyOutDir: true,
    assetsInlineLimit: 0, // the page's Content-Security-Policy allows no data: scripts or styles
    modulePreload: { polyfill: false },
    chunkSizeWarningLimit: 2000, // Swagger UI; kilobytes, before compression
    rolldownOptions: {
      input: ["index.html", "docs.html", "redoc.html"],
      checks: { bundlerTimings: false },
    },
  },
});
