// Draws the landmarks of a map over the photo that was taken there, with three.js.
//
// Put content of your own into `origin`, at the map's coordinates: it appears at its place.
import * as THREE from "three";
import { cameraMatrix, connect, ServiceError } from "visloc-client";

const LANDMARKS = 30_000;
const NEAR = 0.05;
const FAR = 1000;

const by = (id) => document.getElementById(id);
const status = by("status");
const picture = by("picture");

const renderer = new THREE.WebGLRenderer({ alpha: true, antialias: true });
by("drawing").append(renderer.domElement);
const camera = new THREE.PerspectiveCamera();
camera.matrixAutoUpdate = false; // its matrix is the answer's
const scene = new THREE.Scene();
let origin = new THREE.Group();
scene.add(origin);
let shown = "";

by("map").value = new URLSearchParams(location.search).get("map") ?? "sample";
by("photo").addEventListener("change", async ({ target }) => {
  const [photo] = target.files;
  if (photo) await overlay(photo).catch(tell);
});
by("live").addEventListener("click", () => live().catch(tell));

/** Ask where a photo was taken, and draw the map over it as the camera saw it. */
async function overlay(photo) {
  const client = connect(by("server").value, { apiKey: by("key").value || (() => null) });
  const map = by("map").value;
  // As stored: the answer's pose and pixels are those of the stored picture.
  const bitmap = await createImageBitmap(photo, { imageOrientation: "none" });
  const answer = await client.localize({ map, image: photo, debug: true });
  picture.width = bitmap.width;
  picture.height = bitmap.height;
  picture.getContext("2d").drawImage(bitmap, 0, 0);
  if (answer.pose === null) {
    renderer.clear();
    status.textContent = `Refused: ${answer.refusal.message}`;
    return;
  }
  await showLandmarks(client, `${answer.map.id}@${answer.map.version}`);
  const { width, height } = answer.camera;
  renderer.setSize(width, height, false);
  camera.projectionMatrix.copy(projection(answer.camera));
  camera.projectionMatrixInverse.copy(camera.projectionMatrix).invert();
  camera.matrix.fromArray(cameraMatrix(answer.pose, "opengl"));
  camera.updateMatrixWorld(true);
  renderer.render(scene, camera);
  const errors = errorsInPixels(answer);
  const [x, y, z] = answer.pose.position.map((value) => value.toFixed(2));
  status.textContent =
    `At ${x}, ${y}, ${z}. Landmarks lie ${errors[errors.length >> 1].toFixed(1)} pixels from ` +
    `where the photo shows them (median of ${errors.length}).`;
  window.overlay = { position: answer.pose.position, errors };
}

/** Follow the device's camera: each frame is asked about when the answer to the one before came. */
async function live() {
  const video = by("video");
  video.srcObject = await navigator.mediaDevices.getUserMedia({
    video: { facingMode: "environment", width: 1280 },
  });
  await video.play();
  const frame = document.createElement("canvas");
  while (video.srcObject.active) {
    frame.width = video.videoWidth;
    frame.height = video.videoHeight;
    frame.getContext("2d").drawImage(video, 0, 0);
    await overlay(await new Promise((done) => frame.toBlob(done, "image/jpeg", 0.9)));
  }
}

/** Put the landmarks of a map into the scene, in place of those before. */
async function showLandmarks(client, map) {
  if (map === shown) return;
  const block = await client.points(map, 0, LANDMARKS);
  // Rows of 16 bytes: x, y, z, then red, green, blue and how many photos see the landmark.
  const rows = new THREE.InterleavedBuffer(new Float32Array(block.rows), 4);
  const geometry = new THREE.BufferGeometry();
  geometry.setAttribute("position", new THREE.InterleavedBufferAttribute(rows, 3, 0));
  const material = new THREE.PointsMaterial({ color: 0x00e08a, size: 2, sizeAttenuation: false });
  scene.remove(origin);
  origin = new THREE.Group();
  const points = new THREE.Points(geometry, material);
  points.position.fromArray(block.origin);
  points.frustumCulled = false;
  origin.add(points);
  scene.add(origin);
  shown = map;
}

/** What a camera without distortion shows, as WebGL has it; pixels span 0 to width and height. */
function projection({ model, width, height, params }) {
  const single = model.startsWith("SIMPLE_") || model.startsWith("RADIAL");
  const [fx, fy, cx, cy] = single ? [params[0], ...params] : params;
  return new THREE.Matrix4().set(
    ...[(2 * fx) / width, 0, 1 - (2 * cx) / width, 0],
    ...[0, (2 * fy) / height, (2 * cy) / height - 1, 0],
    ...[0, 0, (FAR + NEAR) / (NEAR - FAR), (2 * FAR * NEAR) / (NEAR - FAR)],
    ...[0, 0, -1, 0],
  );
}

/** How far the drawing has landmarks from where the photo shows them, least first. */
function errorsInPixels({ debug, camera: { width, height } }) {
  return debug.inliers
    .flatMap((inlier, i) => (inlier ? [i] : []))
    .map((i) => {
      const at = new THREE.Vector3(...debug.points.slice(3 * i, 3 * i + 3)).project(camera);
      const [u, v] = [((at.x + 1) * width) / 2, ((1 - at.y) * height) / 2];
      return Math.hypot(u - debug.keypoints[2 * i], v - debug.keypoints[2 * i + 1]);
    })
    .sort((a, b) => a - b);
}

function tell(error) {
  status.textContent =
    error instanceof ServiceError ? `${error.message} (${error.code})` : String(error);
}
