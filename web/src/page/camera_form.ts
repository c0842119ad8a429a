// The camera of a photo: told by its EXIF, one of the map's own, or typed.
import { cameraText, type Camera } from "visloc-client";
import { element, field } from "../dom";
import {
  CAMERA_MODELS,
  cameraFaults,
  cameraOf,
  textFaultOf,
  typedCamera,
  type TypedCamera,
} from "./camera_models";

export interface CameraForm {
  readonly element: HTMLElement;
  /** Null: as the photo's EXIF says. Throws ServiceError for what is no camera. */
  camera(): Camera | null;
  /** Take over a camera, as of an answer. */
  set(camera: Camera): void;
  /** Those that the mapping photos were taken by, by id: of the map that is shown now. */
  offer(cameras: Readonly<Record<string, Camera>>): void;
  /** Photos were sent: unless it is to be kept, the next ones speak for themselves. */
  sent(): void;
  /** The size of the photo, for fields that nobody filled. */
  suggestSize(width: number, height: number): void;
  open(): void;
}

export function createCameraForm(): CameraForm {
  const fromExif = element("input", { type: "radio", name: "camera", checked: true });
  const typing = element("input", { type: "radio", name: "camera" });
  const ofMap = element("input", { type: "radio", name: "camera" });
  const ofMapLabel = element("label", { class: "check" }, ofMap, "Of the map");
  const choice = element("select", { id: "camera-of-map" });
  const choiceField = field("A camera that took mapping photos", choice);
  let offered: Readonly<Record<string, Camera>> = {};
  const model = element("select", { id: "camera-model" });
  model.append(...Object.keys(CAMERA_MODELS).map((name) => element("option", {}, name)));
  model.value = "PINHOLE";
  const width = numberField("width", "numeric");
  const height = numberField("height", "numeric");
  const params = element("div", { class: "fields" });
  const text = element("input", {
    ...{ id: "camera-text", type: "text", spellcheck: "false", autocomplete: "off" },
    placeholder: "PINHOLE,640,480,525,525,320,240",
  });
  const textFault = element("p", { id: "camera-text-fault", class: "small", role: "alert" });
  text.setAttribute("aria-describedby", textFault.id);
  const keep = element("input", { type: "checkbox", checked: true });
  const summary = element("span", { class: "quiet" });
  let fields: { field: HTMLElement; input: HTMLInputElement }[] = [];

  const form = element(
    "div",
    { class: "stack", hidden: true },
    field("As text, if you have it so", text),
    textFault,
    field("Model", model),
    element("div", { class: "fields" }, width.field, height.field),
    params,
    element("label", { class: "check" }, keep, "Keep for the next photos"),
  );
  const details = element(
    "details",
    {},
    element("summary", {}, "Camera", summary),
    element(
      "div",
      { class: "stack near inset" },
      element(
        "fieldset",
        { class: "row" },
        element("legend", { class: "unseen" }, "Where the camera’s parameters come from"),
        element("label", { class: "check" }, fromExif, "From the photo’s EXIF"),
        ofMapLabel,
        element("label", { class: "check" }, typing, "Typed"),
      ),
      choiceField,
      form,
    ),
  );

  function typed(): TypedCamera {
    return {
      model: model.value,
      width: width.input.value,
      height: height.input.value,
      params: fields.map(({ input }) => input.value),
    };
  }

  /** Fields of the chosen model; values stay with their names. */
  function fillParams(): void {
    const before = new Map(fields.map(({ input }) => [input.name, input.value]));
    fields = (CAMERA_MODELS[model.value] ?? []).map((name) => {
      const made = numberField(name, "decimal");
      // Distortion that nobody typed is none.
      made.input.value = before.get(name) ?? (/^(f|fx|fy|cx|cy)$/.test(name) ? "" : "0");
      return made;
    });
    params.replaceChildren(...fields.map(({ field }) => field));
  }

  function show(camera: TypedCamera): void {
    model.value = camera.model;
    fillParams();
    width.input.value = camera.width;
    height.input.value = camera.height;
    fields.forEach(({ input }, i) => (input.value = camera.params[i] ?? ""));
  }

  /** Say what will be sent, and mark what is wrong of what was typed already. */
  function changed(): void {
    form.hidden = !typing.checked;
    choiceField.hidden = !ofMap.checked;
    const faults = cameraFaults(typed());
    for (const { input } of [width, height, ...fields]) {
      const wrong = input.value.trim() !== "" && faults.some(({ field }) => field === input.name);
      input.setAttribute("aria-invalid", String(wrong));
    }
    if (ofMap.checked) summary.textContent = `of the map: ${choice.value}`;
    else if (!typing.checked) summary.textContent = "from the photo’s EXIF";
    else if (faults.length > 0) summary.textContent = `typed, ${faults[0]!.field} is missing`;
    else summary.textContent = cameraText(cameraOf(typed()));
    if (faults.length === 0 && document.activeElement !== text) {
      text.value = cameraText(cameraOf(typed()));
      sayTextFault("");
    }
  }

  function sayTextFault(fault: string): void {
    text.setAttribute("aria-invalid", String(fault !== ""));
    textFault.textContent = fault;
    textFault.hidden = fault === "";
  }

  text.addEventListener("input", () => {
    const read = typedCamera(text.value);
    sayTextFault(read === null ? textFaultOf(text.value) : "");
    if (read !== null) show(read);
    changed();
  });
  model.addEventListener("change", () => {
    fillParams();
    changed();
  });
  details.addEventListener("input", changed);
  details.addEventListener("change", changed);
  fillParams();
  changed();

  return {
    element: details,
    camera: () => {
      if (ofMap.checked) return offered[choice.value] ?? null;
      return typing.checked ? cameraOf(typed()) : null;
    },
    set(camera) {
      typing.checked = true;
      const { width: w, height: h, params: numbers } = camera;
      show({ model: camera.model, width: `${w}`, height: `${h}`, params: numbers.map(String) });
      details.open = true;
      changed();
    },
    offer(cameras) {
      const before = choice.value;
      offered = cameras;
      const ids = Object.keys(cameras).sort();
      choice.replaceChildren(
        ...ids.map((id) => {
          const { model, width, height } = cameras[id]!;
          return element("option", { value: id }, `${id}: ${model} ${width} × ${height}`);
        }),
      );
      ofMapLabel.hidden = ids.length === 0;
      if (ids.includes(before)) choice.value = before;
      // A camera of another map is none of this one.
      else if (ofMap.checked) fromExif.checked = true;
      changed();
    },
    sent() {
      if (!keep.checked) fromExif.checked = true;
      changed();
    },
    suggestSize(w, h) {
      if (width.input.value !== "" || height.input.value !== "") return;
      width.input.value = String(w);
      height.input.value = String(h);
      changed();
    },
    open() {
      details.open = true;
    },
  };
}

function numberField(name: string, inputmode: "numeric" | "decimal") {
  const id = `camera-${name}`;
  const input = element("input", { id, name, type: "text", inputmode, autocomplete: "off" });
  return { field: field(name, input), input };
}
