// Lines and dots that several parts of the scene are made of.
import {
  BufferAttribute,
  BufferGeometry,
  GLSL3,
  InstancedMesh,
  LineBasicMaterial,
  LineSegments,
  Object3D,
  Points,
  RawShaderMaterial,
  Vector3 as Vector,
} from "three";
import { LineMaterial } from "three/examples/jsm/lines/LineMaterial.js";
import { LineSegments2 } from "three/examples/jsm/lines/LineSegments2.js";
import { LineSegmentsGeometry } from "three/examples/jsm/lines/LineSegmentsGeometry.js";
import type { Vector3 } from "visloc-client";
import { rgb } from "./themes";

/** Lines as thin as a pixel, from each second position to the next. */
export function thinLines(ends: Float32Array, colour: string, opacity: number): LineSegments {
  const geometry = new BufferGeometry();
  geometry.setAttribute("position", new BufferAttribute(ends, 3));
  const transparent = opacity < 1;
  const material = new LineBasicMaterial({ color: colour, opacity, transparent });
  material.depthWrite = !transparent;
  return new LineSegments(geometry, material);
}

/** Lines so many CSS pixels wide, from each second position to the next. */
export function boldLines(ends: Float32Array, colour: string, pixels: number): LineSegments2 {
  const geometry = new LineSegmentsGeometry().setPositions(ends);
  return new LineSegments2(geometry, new LineMaterial({ color: colour, linewidth: pixels }));
}

/** Ends of the edges of a pyramid: from its tip to four corners, and around these. */
export function pyramidEdges(tip: Vector3, corners: Vector3[]): number[] {
  return corners.flatMap((corner, i) => [...tip, ...corner, ...corner, ...corners[(i + 1) % 4]!]);
}

const DOT_VERTEX = `
precision highp float;
in vec3 position;
uniform mat4 modelViewMatrix;
uniform mat4 projectionMatrix;
uniform float size;
void main() {
  gl_Position = projectionMatrix * modelViewMatrix * vec4(position, 1.0);
  gl_PointSize = size;
}`;

const DOT_FRAGMENT = `
precision mediump float;
uniform vec3 colour;
uniform vec3 edge;
out vec4 pixel;
void main() {
  float radius = 2.0 * length(gl_PointCoord - 0.5);
  if (radius > 1.0) discard;
  pixel = vec4(radius > 0.68 ? edge : colour, 1.0);
}`;

/** Round dots of one size with an edge that sets them off. */
export function dots(positions: Float32Array, colour: string, edge: string, pixels: number) {
  const geometry = new BufferGeometry();
  geometry.setAttribute("position", new BufferAttribute(positions, 3));
  const material = new RawShaderMaterial({
    glslVersion: GLSL3,
    vertexShader: DOT_VERTEX,
    fragmentShader: DOT_FRAGMENT,
    uniforms: {
      size: { value: pixels },
      colour: { value: new Vector(...rgb(colour)) },
      edge: { value: new Vector(...rgb(edge)) },
    },
  });
  const made = new Points(geometry, material);
  made.frustumCulled = false;
  return made;
}

/** Take an object out of the scene and free what the graphics memory holds of it. */
export function discard(object: Object3D | null): void {
  object?.traverse((part) => {
    const { geometry, material } = part as Partial<LineSegments>;
    geometry?.dispose();
    for (const one of material === undefined ? [] : [material].flat()) one.dispose();
    if (part instanceof InstancedMesh) part.dispose(); // its places and colours
  });
  object?.removeFromParent();
}
