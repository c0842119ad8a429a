// The landmarks: one buffer as it came, drawn by slices into a picture of their own.
//
// Their order is one of level of detail. While the view moves, each picture shows a beginning of
// it; while it rests, each adds the next slice to what is there, without clearing. What else is
// shown is drawn on top of a copy, with the points' depth. Where the processor draws, the copy is
// left out while the view moves.
import {
  BufferGeometry,
  Camera,
  DepthTexture,
  DynamicDrawUsage,
  GLSL3,
  InterleavedBuffer,
  InterleavedBufferAttribute,
  Mesh,
  NearestFilter,
  NormalBlending,
  Object3D,
  PerspectiveCamera,
  PlaneGeometry,
  Points,
  RawShaderMaterial,
  Scene,
  UnsignedIntType,
  Vector3 as Vector,
  WebGLRenderTarget,
  type WebGLRenderer,
} from "three";
import { ROW_BYTES, type PointBlock, type Vector3 } from "visloc-client";
import { subtract } from "../geometry";
import { MAX_POINTS } from "../points";
import { SEEN_BY_MOST, rgb, type Palette } from "./themes";
import type { PointColours } from "./types";

const WORDS = ROW_BYTES / 4;

// A row is read as four integers: as floats, the bytes in the last one might be no number and
// would not arrive as they are.
const POINT_VERTEX = `
precision highp float;
precision highp int;
in uvec4 position;
uniform mat4 modelViewMatrix;
uniform mat4 projectionMatrix;
uniform vec3 ramp[4];
uniform bool photo;
uniform float size;
uniform float middle;
flat out vec3 colour;
flat out float round_;
void main() {
  vec4 seen = modelViewMatrix * vec4(uintBitsToFloat(position.xyz), 1.0);
  gl_Position = projectionMatrix * seen;
  // Nearer points are larger, but less so than they would be as discs.
  float points = size * clamp(sqrt(middle / max(-seen.z, 1e-9)), 0.75, 3.0);
  gl_PointSize = points;
  round_ = points > 3.5 ? 1.0 : 0.0;
  uint bytes = position.w;
  if (photo) {
    colour = vec3(bytes & 255u, (bytes >> 8) & 255u, (bytes >> 16) & 255u) / 255.0;
  } else {
    float at = log2(float(max(bytes >> 24, 1u))) / log2(${SEEN_BY_MOST}.0);
    at = clamp(at, 0.0, 1.0) * 3.0;
    colour = mix(mix(ramp[0], ramp[1], min(at, 1.0)), ramp[2], clamp(at - 1.0, 0.0, 1.0));
    colour = mix(colour, ramp[3], clamp(at - 2.0, 0.0, 1.0));
  }
}`;

const POINT_FRAGMENT = `
precision mediump float;
flat in vec3 colour;
flat in float round_;
out vec4 pixel;
void main() {
  vec2 off = gl_PointCoord - 0.5;
  if (round_ * dot(off, off) > 0.25) discard;
  pixel = vec4(colour, 1.0);
}`;

const COPY_VERTEX = `
in vec3 position;
out vec2 at;
void main() {
  at = position.xy * 0.5 + 0.5;
  gl_Position = vec4(position.xy, 0.0, 1.0);
}`;

// Pixels behind the edge of something nearer are darker: Boucheny's eye-dome lighting (2009), with
// four neighbours, which makes shapes of points legible without normals.
const COPY_FRAGMENT = `
precision highp float;
uniform sampler2D colours;
uniform highp sampler2D depths;
uniform vec2 step_;
uniform vec2 range;
uniform float shade;
in vec2 at;
out vec4 pixel;
float far_(float depth) {
  return log2(range.x * range.y / (range.y - depth * (range.y - range.x)));
}
void main() {
  float depth = texture(depths, at).r;
  float drop = 0.0;
  if (shade > 0.0) {
    float here = far_(depth);
    vec4 around = vec4(
      texture(depths, at + vec2(step_.x, 0.0)).r,
      texture(depths, at - vec2(step_.x, 0.0)).r,
      texture(depths, at + vec2(0.0, step_.y)).r,
      texture(depths, at - vec2(0.0, step_.y)).r);
    for (int i = 0; i < 4; i++) drop += clamp(here - far_(around[i]), 0.0, 0.3);
    if (depth == 1.0) drop *= 0.4; // around what stands before the ground, a fine line
  }
  pixel = vec4(texture(colours, at).rgb * exp2(-shade * drop), 1.0);
  gl_FragDepth = depth;
}`;

/** What the size of points goes by. */
export interface View {
  pixelRatio: number;
  /** From the eye to where the view turns about. */
  middle: number;
}

export class Cloud {
  /** To be put where the world is. */
  readonly object = new Object3D();
  loaded = 0;
  /** On the canvas as it is now. */
  drawn = 0;
  /** In the picture of the points as it is now. */
  private kept = 0;
  private shade = 1;
  coloured = false;
  by: PointColours = "photo";
  pixels = 2;
  private points: Points<BufferGeometry, RawShaderMaterial> | null = null;
  private capacity = 0;
  private bytes = new Uint8Array(0);
  private buffer: InterleavedBuffer | null = null;
  private readonly scene = new Scene();
  private readonly picture = new WebGLRenderTarget(1, 1, {
    minFilter: NearestFilter,
    magFilter: NearestFilter,
    depthTexture: new DepthTexture(1, 1, UnsignedIntType),
  });
  private readonly material = new RawShaderMaterial({
    glslVersion: GLSL3,
    vertexShader: POINT_VERTEX,
    fragmentShader: POINT_FRAGMENT,
    blending: NormalBlending,
    uniforms: {
      ramp: { value: [] },
      photo: { value: false },
      size: { value: 2 },
      middle: { value: 1 },
    },
  });
  private readonly copy: Mesh<PlaneGeometry, RawShaderMaterial>;

  constructor() {
    const material = new RawShaderMaterial({
      glslVersion: GLSL3,
      vertexShader: COPY_VERTEX,
      fragmentShader: COPY_FRAGMENT,
      depthTest: true,
      depthWrite: true,
      uniforms: {
        colours: { value: this.picture.texture },
        depths: { value: this.picture.depthTexture },
        step_: { value: [0, 0] },
        range: { value: [0.1, 10] },
        shade: { value: 1 },
      },
    });
    this.copy = new Mesh(new PlaneGeometry(2, 2), material);
    this.copy.frustumCulled = false;
    this.scene.add(this.object);
    this.scene.matrixWorldAutoUpdate = true;
  }

  /** Put a block behind those before; what is beyond MAX_POINTS is left out. */
  add(block: PointBlock, origin: Vector3): void {
    if (block.first !== this.loaded) {
      throw new Error(`landmarks from ${this.loaded} on were expected, not from ${block.first}`);
    }
    if (this.points === null) this.allocate(Math.min(block.total, MAX_POINTS));
    const count = Math.min(block.count, this.capacity - this.loaded);
    if (count <= 0) return;
    this.bytes.set(new Uint8Array(block.rows, 0, count * ROW_BYTES), this.loaded * ROW_BYTES);
    this.buffer!.addUpdateRange(this.loaded * WORDS, count * WORDS);
    this.buffer!.needsUpdate = true;
    this.loaded += count;
    this.coloured = block.coloured;
    this.points!.position.set(...subtract(block.origin, origin));
  }

  private allocate(capacity: number): void {
    this.capacity = capacity;
    this.bytes = new Uint8Array(capacity * ROW_BYTES);
    this.buffer = new InterleavedBuffer(new Uint32Array(this.bytes.buffer), WORDS);
    this.buffer.setUsage(DynamicDrawUsage);
    const geometry = new BufferGeometry();
    geometry.setAttribute("position", new InterleavedBufferAttribute(this.buffer, WORDS, 0));
    this.points = new Points(geometry, this.material);
    this.points.frustumCulled = false;
    this.object.add(this.points);
  }

  /** The first landmarks, at most `most`, in the scene's coordinates: an even sample. */
  sample(most: number): Vector3[] {
    const floats = new Float32Array(this.bytes.buffer);
    const shift = this.points?.position ?? new Vector();
    return Array.from({ length: Math.min(most, this.loaded) }, (_, i) => [
      floats[WORDS * i]! + shift.x,
      floats[WORDS * i + 1]! + shift.y,
      floats[WORDS * i + 2]! + shift.z,
    ]);
  }

  resize(width: number, height: number, pixelRatio: number): void {
    this.picture.setSize(width, height);
    this.copy.material.uniforms.step_!.value = [pixelRatio / width, pixelRatio / height];
    this.kept = 0;
  }

  setPalette(palette: Palette): void {
    this.shade = palette.shade;
    this.material.uniforms.ramp!.value = palette.seenBy.map((hex) => new Vector(...rgb(hex)));
  }

  /** Draw up to `count` landmarks more into their picture; from the first on where `afresh`. */
  draw(renderer: WebGLRenderer, camera: Camera, view: View, count: number, afresh: boolean): void {
    const start = afresh ? 0 : this.kept;
    this.kept = this.drawn = Math.min(this.loaded, start + Math.ceil(count));
    renderer.setRenderTarget(this.picture);
    if (start === 0) renderer.clear();
    this.render(renderer, camera, view, start, this.drawn, 1);
    renderer.setRenderTarget(null);
  }

  /** Draw the first `count` landmarks to the canvas itself. */
  drawPlain(renderer: WebGLRenderer, camera: Camera, view: View, count: number): void {
    this.kept = 0;
    this.drawn = Math.min(this.loaded, Math.ceil(count));
    // Larger, as they stand for those that are left out; the size of a point costs little.
    const larger = Math.min((this.loaded / Math.max(this.drawn, 1)) ** 0.3, 2.5);
    this.render(renderer, camera, view, 0, this.drawn, larger);
  }

  private render(
    renderer: WebGLRenderer,
    camera: Camera,
    { pixelRatio, middle }: View,
    start: number,
    end: number,
    larger: number,
  ): void {
    if (this.points === null || end === start) return;
    const { photo, size, middle: distance } = this.material.uniforms;
    photo!.value = this.by === "photo" && this.coloured;
    // Fewer landmarks have more room each.
    const room = Math.min(Math.max((150_000 / this.capacity) ** 0.15, 0.8), 1.5);
    size!.value = this.pixels * room * pixelRatio * larger;
    distance!.value = middle;
    this.points.geometry.setDrawRange(start, end - start);
    renderer.render(this.scene, camera);
  }

  /** Copy the picture of the points to the canvas, with their depth; edges `shaded` or not. */
  present(renderer: WebGLRenderer, camera: PerspectiveCamera, shaded: boolean): void {
    this.copy.material.uniforms.range!.value = [camera.near, camera.far];
    this.copy.material.uniforms.shade!.value = shaded ? this.shade : 0;
    renderer.render(this.copy, camera);
  }

  clear(): void {
    this.points?.geometry.dispose();
    this.points?.removeFromParent();
    this.points = this.buffer = null;
    this.bytes = new Uint8Array(0);
    this.capacity = this.loaded = this.drawn = this.kept = 0;
    this.coloured = false;
  }

  dispose(): void {
    this.clear();
    this.material.dispose();
    this.picture.dispose();
    this.copy.geometry.dispose();
    this.copy.material.dispose();
  }
}
