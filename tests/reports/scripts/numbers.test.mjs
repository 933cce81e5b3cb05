import assert from "node:assert/strict";
import { test } from "node:test";
import { fixed, nearestBy, number, ticks, unpack } from "../../../lslam/reports/scripts/numbers.mjs";

test("packed numbers come back", () => {
  const values = Float32Array.from([1.5, -2, NaN, 3e7]);
  assert.deepEqual(unpack(Buffer.from(values.buffer).toString("base64"), Float32Array), values);
});

test("numbers are written with a minus sign, never as minus nought", () => {
  assert.equal(fixed(-1.25, 1), "−1.3");
  assert.equal(fixed(-0.001, 2), "0.00");
  assert.equal(fixed(NaN, 2), "n/a");
  assert.equal(number(-2.5, 10), "−2.5");
  assert.equal(number(1e-12, 10), "0");
});

test("ticks are round, within the limits, and about as many as wanted", () => {
  for (const [low, high] of [[0, 1], [-3.7, 912.4], [1e-4, 3e-4], [1e6, 1e6 + 7]]) {
    const found = ticks(low, high, 6);
    assert.ok(found.length >= 3 && found.length <= 12, `${found}`);
    assert.ok(found.every((value) => value >= low - 1e-9 * (high - low) && value <= high + 1e-9 * (high - low)));
    const steps = found.slice(1).map((value, i) => value - found[i]);
    const mantissa = steps[0] / 10 ** Math.floor(Math.log10(steps[0]) + 1e-9);
    assert.ok([1, 2, 2.5, 5].some((m) => Math.abs(mantissa - m) < 1e-6), `${mantissa}`);
  }
});

test("the nearest value skips what is not known", () => {
  assert.equal(nearestBy([NaN, 5, 2.9, 4], 3), 2);
  assert.equal(nearestBy([NaN], 3), -1);
});
