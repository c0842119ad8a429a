import { describe, expect, test } from "vitest";
import { bytesText, countText, counted, secondsText } from "../src/words";

describe("numbers in words", () => {
  test("are grouped by threes", () => {
    expect([0, 999, 1000, 1234567].map(countText)).toEqual([
      ...["0", "999", "1\u202f000", "1\u202f234\u202f567"],
    ]);
    expect([1, 2, 1000].map((count) => counted(count, "photo"))).toEqual([
      ...["1 photo", "2 photos", "1\u202f000 photos"],
    ]);
  });

  test("have two digits at least where they are bytes", () => {
    expect([0, 512, 1024, 10 * 2 ** 20, 99.7 * 2 ** 20, 300 * 2 ** 30].map(bytesText)).toEqual([
      ...["0 B", "512 B", "1.0 KiB", "10 MiB", "100 MiB", "300 GiB"],
    ]);
  });

  test("are milliseconds below a second", () => {
    expect([0, 0.0123, 0.34, 1.236, 12.34].map(secondsText)).toEqual([
      ...["0 ms", "12 ms", "340 ms", "1.24 s", "12.3 s"],
    ]);
  });
});
