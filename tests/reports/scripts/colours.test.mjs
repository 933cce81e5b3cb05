import assert from "node:assert/strict";
import { test } from "node:test";
import { cloudFrom } from "../../../lslam/reports/scripts/clouds.mjs";
import { BY, colourings, percentile, ramp, sample } from "../../../lslam/reports/scripts/colours.mjs";

test("a palette runs from its first to its last colour", () => {
  const colours = ramp(["000000", "ff8000", "ffffff"]);
  assert.deepEqual([...colours.slice(0, 4)], [0, 0, 0, 255]);
  assert.deepEqual([...colours.slice(-4)], [255, 255, 255, 255]);
  assert.ok(Math.abs(colours[4 * 64] - 128) <= 2 && Math.abs(colours[4 * 64 + 1] - 64) <= 2);
});

test("percentiles lie between neighbours, and leave out what is not known", () => {
  const ordered = sample(5, (i) => [4, NaN, 1, 3, 2][i]);
  assert.deepEqual([...ordered], [1, 2, 3, 4]);
  assert.deepEqual([0, 50, 100].map((p) => percentile(ordered, p)), [1, 2.5, 4]);
  assert.equal(percentile(Float64Array.of(7), 98), 7);
});

test("a map is coloured by what it has", () => {
  const cloud = cloudFrom(Float32Array.from([0, 0, -1, 5, 5, 3, 9, 9, 11]));
  assert.deepEqual(Object.keys(colourings(cloud, null)), ["height"]);
  const more = { ...cloud, rgb: new Uint8Array(9), kind: Uint8Array.of(1, 0, 1), kinds: ["40", "10"], intensity: Uint8Array.of(0, 128, 255), values: [10, 20], nearest: Uint16Array.of(0, 1, 1) };
  const scans = { count: 2, by: { time: Float64Array.of(0, 8) }, error: Float32Array.of(NaN, 0.5), alignment: "se3" };
  const known = colourings(more, scans);
  assert.deepEqual(Object.keys(known), ["height", "camera colours", "class", "intensity", "time", "error"]);
  assert.deepEqual([...known.class.bytes.slice(0, 3)], [...known.class.bytes.slice(6, 9)]);
  assert.notDeepEqual([...known.class.bytes.slice(0, 3)], [...known.class.bytes.slice(3, 6)]);
  assert.equal(known.intensity.text(0.5), "15.0");
  assert.deepEqual([...known.time.bytes], [0, 255, 255]);
  assert.equal(known.height.by, BY.height);
  assert.ok(Math.abs(percentile(known.height.ordered, 50) - 3) < 0.01);
});
