// The photo with what was matched in it, upright. The service counts pixels as stored: what it found
// is turned as the photo is.
import type { LocalizeResponse } from "visloc-client";
import { button, element } from "../dom";
import { countText } from "../words";

/** a, b, c, d, e, f: (x, y) goes to (a x + c y + e, b x + d y + f). */
type Affine = [number, number, number, number, number, number];

const MAX_ZOOM = 40;
const INLIER = "#3ddc84";
const OUTLIER = "#ff6b5e";

/** Pixels as stored to pixels upright, by the EXIF orientation, 1 to 8; other values turn nothing. */
export function uprightFromStored(exif: number, width: number, height: number): Affine {
  switch (exif) {
    case 2:
      return [-1, 0, 0, 1, width, 0];
    case 3:
      return [-1, 0, 0, -1, width, height];
    case 4:
      return [1, 0, 0, -1, 0, height];
    case 5:
      return [0, 1, 1, 0, 0, 0];
    case 6:
      return [0, 1, -1, 0, height, 0];
    case 7:
      return [0, -1, -1, 0, height, width];
    case 8:
      return [0, -1, 1, 0, 0, width];
    default:
      return [1, 0, 0, 1, 0, 0];
  }
}

/**
 * Decode a photo; null for a kind that this browser does not read. Browsers turn it upright by its
 * EXIF orientation, and can no longer be asked not to.
 */
async function decodePhoto(photo: Blob): Promise<ImageBitmap | null> {
  try {
    return await createImageBitmap(photo);
  } catch (error) {
    if (!(error instanceof DOMException)) throw error;
    return null;
  }
}

/** The picture, with buttons to zoom and boxes to choose what is drawn. */
export function photoPicture(photo: Blob, answer: LocalizeResponse): HTMLElement {
  const { width, height } = answer.camera;
  const matrix = uprightFromStored(answer.orientation.exif, width, height);
  const turned = answer.orientation.exif >= 5;
  const size = turned ? { width: height, height: width } : { width, height };
  const { keypoints = [], inliers = [] } = answer.debug ?? {};

  const canvas = element("canvas", { tabindex: 0, role: "img" });
  canvas.setAttribute(
    "aria-label",
    answer.debug === null
      ? "The photo; plus, minus and arrows move in it"
      : `The photo with its ${answer.inliers} inliers; plus, minus and arrows move in it`,
  );
  canvas.style.aspectRatio = `${size.width} / ${size.height}`;
  let bitmap: ImageBitmap | null = null;
  // Where the middle of the picture is, in pixels upright, and how much larger than fitting.
  const view = { x: size.width / 2, y: size.height / 2, zoom: 1 };
  let requested = 0;

  const showInliers = checkbox(true);
  const showOutliers = checkbox(false);
  const note = element("p", { class: "quiet small", hidden: true });
  note.textContent = "This browser does not show photos of this kind.";

  /** Pixels of the canvas for a pixel of the photo. */
  const scale = (): number => (canvas.width / size.width) * view.zoom;

  function draw(): void {
    requested = 0;
    const density = devicePixelRatio;
    canvas.width = Math.max(1, Math.round(canvas.clientWidth * density));
    canvas.height = Math.max(1, Math.round(canvas.clientHeight * density));
    const context = canvas.getContext("2d")!;
    const by = scale();
    const half = { x: size.width / view.zoom / 2, y: size.height / view.zoom / 2 };
    view.x = Math.min(Math.max(view.x, half.x), size.width - half.x);
    view.y = Math.min(Math.max(view.y, half.y), size.height - half.y);
    const left = canvas.width / 2 - by * view.x;
    const top = canvas.height / 2 - by * view.y;
    const [a, b, c, d, e, f] = matrix;
    if (bitmap !== null) {
      context.imageSmoothingEnabled = by < 4;
      // Of kinds other than JPEG some browsers do not read the orientation.
      const asStored = turned && bitmap.width === width && width !== height;
      if (asStored) {
        context.setTransform(by * a, by * b, by * c, by * d, by * e + left, by * f + top);
        context.drawImage(bitmap, 0, 0, width, height);
        context.resetTransform();
      } else {
        context.drawImage(bitmap, left, top, by * size.width, by * size.height);
      }
    }
    const mark = density * Math.min(1.5 * Math.sqrt(view.zoom), 5);
    const place = (i: number): [number, number] => {
      const [x, y] = [keypoints[2 * i]!, keypoints[2 * i + 1]!];
      return [by * (a * x + c * y + e) + left, by * (b * x + d * y + f) + top];
    };
    const marks = (wanted: boolean, path: (x: number, y: number) => void): void => {
      context.beginPath();
      inliers.forEach((inlier, i) => {
        if (inlier === wanted) path(...place(i));
      });
    };
    // A dark edge below tells them from any photo.
    const stroke = (colour: string): void => {
      for (const [style, line] of [
        ["rgb(0 0 0 / 55%)", 2.6],
        [colour, 1.3],
      ] as const) {
        context.strokeStyle = style;
        context.lineWidth = line * density;
        context.stroke();
      }
    };
    if (showOutliers.checked) {
      marks(false, (x, y) => {
        context.moveTo(x - mark, y - mark);
        context.lineTo(x + mark, y + mark);
        context.moveTo(x - mark, y + mark);
        context.lineTo(x + mark, y - mark);
      });
      stroke(OUTLIER);
    }
    if (showInliers.checked) {
      marks(true, (x, y) => {
        context.moveTo(x + mark, y);
        context.arc(x, y, mark, 0, 2 * Math.PI);
      });
      stroke(INLIER);
    }
  }

  function request(): void {
    requested ||= requestAnimationFrame(draw);
  }

  /** Zoom about a place of the canvas, in CSS pixels from its middle. */
  function zoom(factor: number, dx = 0, dy = 0): void {
    const before = scale() / devicePixelRatio;
    view.zoom = Math.min(Math.max(view.zoom * factor, 1), MAX_ZOOM);
    const after = scale() / devicePixelRatio;
    view.x += dx / before - dx / after;
    view.y += dy / before - dy / after;
    // Where nothing is hidden, a finger scrolls the page.
    canvas.classList.toggle("zoomed", view.zoom > 1);
    request();
  }

  function pan(dx: number, dy: number): void {
    const by = scale() / devicePixelRatio;
    view.x -= dx / by;
    view.y -= dy / by;
    request();
  }

  canvas.addEventListener(
    "wheel",
    (event) => {
      // A wheel that passes over the photo scrolls the page, unless the photo is meant.
      if (view.zoom === 1 && !event.ctrlKey && !dialog.open) return;
      event.preventDefault();
      const box = canvas.getBoundingClientRect();
      const dx = event.clientX - box.x - box.width / 2;
      const dy = event.clientY - box.y - box.height / 2;
      zoom(Math.exp(-event.deltaY / 300), dx, dy);
    },
    { passive: false },
  );
  // One finger, or the mouse, moves the photo; two fingers zoom.
  const fingers = new Map<number, { x: number; y: number }>();
  const apart = (): number => {
    const [one, other] = [...fingers.values()];
    return one && other ? Math.hypot(one.x - other.x, one.y - other.y) : 0;
  };
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    fingers.set(event.pointerId, event);
  });
  canvas.addEventListener("pointermove", (event) => {
    const before = fingers.get(event.pointerId);
    if (before === undefined) return;
    const was = apart();
    fingers.set(event.pointerId, event);
    if (fingers.size === 1) pan(event.x - before.x, event.y - before.y);
    else if (was > 0) zoom(apart() / was);
  });
  canvas.addEventListener("lostpointercapture", (event) => fingers.delete(event.pointerId));
  canvas.addEventListener("keydown", (event) => {
    const does: Record<string, () => void> = {
      "+": () => zoom(1.5),
      "=": () => zoom(1.5),
      "-": () => zoom(1 / 1.5),
      "0": () => zoom(0),
      ArrowLeft: () => pan(40, 0),
      ArrowRight: () => pan(-40, 0),
      ArrowUp: () => pan(0, 40),
      ArrowDown: () => pan(0, -40),
    };
    const act = does[event.key];
    if (act === undefined || event.ctrlKey || event.metaKey || event.altKey) return;
    event.preventDefault();
    act();
  });
  showInliers.addEventListener("change", request);
  showOutliers.addEventListener("change", request);

  const outliers = inliers.length - answer.inliers;
  const enlarge = button("Enlarge", () => (dialog.open ? dialog.close() : open()));
  const tools = element(
    "div",
    { class: "canvas-tools" },
    button("−", () => zoom(1 / 1.5), { class: "square", "aria-label": "Zoom out" }),
    button("+", () => zoom(1.5), { class: "square", "aria-label": "Zoom in" }),
    enlarge,
  );
  const figure = element(
    "figure",
    { class: "photo stack near" },
    element("div", { class: "canvas-place" }, canvas, tools),
    element(
      "div",
      { class: "row", hidden: answer.debug === null },
      element(
        "label",
        { class: "check inliers" },
        showInliers,
        `${countText(answer.inliers)} inliers`,
      ),
      element("label", { class: "check outliers" }, showOutliers, `${countText(outliers)} others`),
    ),
    note,
  );
  const place = element("div", {}, figure);
  const dialog = element("dialog", { class: "large-dialog", "aria-label": "The photo" });
  place.append(dialog);
  function open(): void {
    dialog.append(figure);
    enlarge.textContent = "Close";
    dialog.showModal();
    enlarge.focus();
  }
  dialog.addEventListener("close", () => {
    place.prepend(figure);
    enlarge.textContent = "Enlarge";
    zoom(0);
    enlarge.focus();
  });

  // It is part of the page for as long as its answer is shown.
  const observer = new ResizeObserver(() => {
    if (canvas.isConnected) return request();
    observer.disconnect();
    bitmap?.close();
    bitmap = null;
  });
  observer.observe(canvas);
  void decodePhoto(photo).then((decoded) => {
    bitmap = decoded;
    note.hidden = decoded !== null;
    request();
  });
  return place;
}

function checkbox(checked: boolean): HTMLInputElement {
  return element("input", { type: "checkbox", checked });
}
