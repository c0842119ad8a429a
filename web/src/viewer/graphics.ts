// The way to the graphics hardware, or to what stands in for it.
import { ColorManagement, LinearSRGBColorSpace, WebGLRenderer } from "three";

// Colours are used as they are written, in the scene as in the style sheets.
ColorManagement.enabled = false;

/** Names of renderers that draw on the processor: ANGLE's, Mesa's, and that of Windows. */
const SOFTWARE = /swiftshader|llvmpipe|softpipe|basic render|software/i;

export interface Graphics {
  renderer: WebGLRenderer;
  /** Drawn by the processor: what costs by the pixel or the point is then to be spared. */
  software: boolean;
}

/** This browser cannot draw in 3D; the message says it to people. */
export class NoGraphics extends Error {
  constructor() {
    super(
      "This browser cannot draw in 3D: WebGL 2 is missing or switched off. " +
        "Try a current browser, or switch hardware acceleration on in its settings.",
    );
    this.name = "NoGraphics";
  }
}

/** Throws NoGraphics where there is no WebGL 2. */
export function openGraphics(canvas: HTMLCanvasElement): Graphics {
  const software = drawsInSoftware();
  if (software === null) throw new NoGraphics();
  const renderer = new WebGLRenderer({
    canvas,
    antialias: !software,
    powerPreference: "high-performance",
  });
  renderer.outputColorSpace = LinearSRGBColorSpace;
  renderer.autoClear = false;
  return { renderer, software };
}

/** Asked of a canvas of its own, as smooth edges must be chosen before; null without WebGL 2. */
function drawsInSoftware(): boolean | null {
  const context = document.createElement("canvas").getContext("webgl2");
  if (context === null) return null;
  const named = context.getExtension("WEBGL_debug_renderer_info");
  const name = context.getParameter(named?.UNMASKED_RENDERER_WEBGL ?? context.RENDERER);
  context.getExtension("WEBGL_lose_context")?.loseContext();
  return SOFTWARE.test(String(name));
}
