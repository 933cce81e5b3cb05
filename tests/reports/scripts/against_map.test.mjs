import assert from "node:assert/strict";
import { test } from "node:test";
import { partsOf } from "../../../lslam/reports/scripts/against_map.mjs";
import { kindsOf } from "../../../lslam/reports/scripts/categories.mjs";
import { BY } from "../../../lslam/reports/scripts/colours.mjs";

const STATES = [["held", "s2"], ["doubted", "s4"], ["changed", "carried"], ["beyond", "carried"]];

test("every scan is in the part of its style, and each part reaches to the next scan", () => {
  const way = Float32Array.from([0, 0, 9, 1, 1, 9, 2, 2, 9, 3, 3, 9, 4, 4, 9]);
  const parts = Object.fromEntries(partsOf(way, [0, 0, 2, 3, 0], STATES).map(({ style, points }) => [style, points]));
  const none = [NaN, NaN, NaN];
  assert.deepEqual(parts.s2, Float32Array.from([0, 0, 9, 1, 1, 9, 2, 2, 9, ...none, 4, 4, 9]));
  assert.deepEqual(parts.carried, Float32Array.from([...none, ...none, 2, 2, 9, 3, 3, 9, 4, 4, 9]));
  assert.equal(parts.s4, undefined);
});

test("what changed has colours of its own, and the rest is grey by height", () => {
  const points = Int16Array.from([0, 0, -32768, 0, 0, 32767, 0, 0, 0, 0, 0, 0]);
  const cloud = { points, low: [0, 0, 0], step: [1, 1, 1 / 65535], height: [0, 1], count: 4, change: Int8Array.from([0, 0, -1, 1]) };
  const { changes, session } = kindsOf(cloud);
  assert.equal(session, undefined);
  assert.equal(changes.by, BY.rgb);
  const [low, high, gone, added] = [0, 3, 6, 9].map((i) => [...changes.bytes.slice(i, i + 3)]);
  assert.ok(low[0] < high[0] && Math.max(...low) - Math.min(...low) < 16);
  assert.deepEqual([gone, added], [[214, 69, 65], [46, 134, 193]]);
  assert.deepEqual(changes.kinds, [["not in the map", "2e86c1"], ["gone", "d64541"]]);
});

test("points have the colour of their session, darker the lower they are", () => {
  const points = Int16Array.from([0, 0, 32767, 0, 0, 32767, 0, 0, -32768]);
  const cloud = { points, low: [0, 0, 0], step: [1, 1, 1 / 65535], height: [0, 1], count: 3, session: Uint8Array.from([1, 0, 1]) };
  const { session } = kindsOf(cloud, [{ style: "a" }, { style: "b" }], ({ style }) => (style === "a" ? "rgb(1, 2, 3)" : "rgb(40, 50, 60)"));
  assert.deepEqual([...session.bytes], [40, 50, 60, 1, 2, 3, 20, 25, 30]);
});
