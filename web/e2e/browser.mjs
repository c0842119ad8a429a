// Chromium as the tests and the pictures of docs/ need it.
import { chromium } from "playwright-core";

/** Draws by the processor; its camera sees `video`, frames as concatenated JPEG files (.mjpeg). */
export function launch(executablePath, video) {
  return chromium.launch({
    executablePath,
    args: [
      "--no-sandbox", // they run as root in containers; only our own page is opened
      "--use-angle=swiftshader",
      "--enable-unsafe-swiftshader",
      "--ignore-gpu-blocklist",
      "--use-fake-device-for-media-stream",
      "--use-fake-ui-for-media-stream",
      `--use-file-for-fake-video-capture=${video}`,
    ],
  });
}
