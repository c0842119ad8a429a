import { describe, expect, test } from "vitest";
import conventions from "../../docs/conventions.md?raw";
import { cameraText, ServiceError } from "visloc-client";
import { CAMERA_MODELS, cameraFaults, cameraOf, typedCamera } from "../src/page/camera_models";

const TYPED = {
  model: "PINHOLE",
  width: "640",
  height: "480",
  params: ["525", "525.5", "320", "240"],
};

test("the models are those of the documentation, with its parameters in its order", () => {
  const rows = conventions.matchAll(/^\| ([A-Z][A-Z_, ]+) \| ([^|]+) \|$/gm);
  const documented = Object.fromEntries(
    [...rows].flatMap(([, models, names]) =>
      models!.split(", ").map((model) => [model, names!.split(", ")]),
    ),
  );
  expect(CAMERA_MODELS).toEqual(documented);
});

describe("a typed camera", () => {
  test("is read with its numbers", () => {
    expect(cameraOf(TYPED)).toEqual({
      model: "PINHOLE",
      width: 640,
      height: 480,
      params: [525, 525.5, 320, 240],
    });
  });

  test("may have a comma for the decimals", () => {
    expect(cameraOf({ ...TYPED, params: ["525,5", "525", "320", "240"] }).params[0]).toBe(525.5);
  });

  test.each(["", " ", "abc", "NaN", "Infinity", "0x10", "1e", "1 2", "1,2,3"])(
    "is refused, and never read as something else, with %j for a parameter",
    (value) => {
      const typed = { ...TYPED, params: [value, "525", "320", "240"] };
      expect(cameraFaults(typed).map(({ field }) => field)).toEqual(["fx"]);
      expect(() => cameraOf(typed)).toThrow(ServiceError);
    },
  );

  test.each(["0", "-1", "640.5", "", "x"])("is refused with a width of %j", (width) => {
    expect(cameraFaults({ ...TYPED, width }).map(({ field }) => field)).toEqual(["width"]);
  });

  test("has focal lengths above zero, and any principal point", () => {
    expect(cameraFaults({ ...TYPED, params: ["0", "-1", "-3", "0"] })).toEqual([
      { field: "fx", fault: "more than 0" },
      { field: "fy", fault: "more than 0" },
    ]);
  });

  test("names every field that is missing", () => {
    expect(cameraFaults({ ...TYPED, params: [] }).map(({ field }) => field)).toEqual([
      ...["fx", "fy", "cx", "cy"],
    ]);
  });
});

describe("a camera as text", () => {
  test("comes back as it was", () => {
    const typed = typedCamera("PINHOLE,640,480,525,525.5,320,240")!;
    expect(typed).toEqual(TYPED);
    expect(cameraText(cameraOf(typed))).toBe("PINHOLE,640,480,525,525.5,320,240");
  });

  test("may be of a line of a list, with blanks", () => {
    expect(typedCamera(" simple_radial 640 480 500 320 240 0.01\n")!.model).toBe("SIMPLE_RADIAL");
  });

  test.each([
    "",
    "PINHOLE",
    "PINHOLE,640,480,525,525,320",
    "PINHOLE,640,480,525,525,320,240,1",
    "PINHOLE,640,480,525,525,320,x",
    "constructor,640,480,1",
    "BOX,640,480,1,2,3,4",
  ])("%j is none", (text) => {
    expect(typedCamera(text)).toBeNull();
  });
});
