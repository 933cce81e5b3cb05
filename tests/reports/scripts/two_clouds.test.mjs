import assert from "node:assert/strict";
import { test } from "node:test";
import { moved, unpackCloud } from "../../../lslam/reports/scripts/two_clouds.mjs";

test("a packed cloud comes back in metres", () => {
  const q = Buffer.from(Int16Array.from([-32768, 0, 32767, 32767, -32768, -32768]).buffer).toString("base64");
  const points = unpackCloud({ points: q, low: [1, 2, 3], step: [0.5, 0.25, 0.125], count: 2 });
  assert.deepEqual(Array.from(points), [1, 2 + 0.25 * 32768, 3 + 0.125 * 65535, 1 + 0.5 * 65535, 2, 3]);
});

test("points are moved by the rows of a transform", () => {
  assert.deepEqual(Array.from(moved([1, 2, 3, 0, 0, 0], [[0, -1, 0, 10], [1, 0, 0, 20], [0, 0, 1, 30]])), [8, 21, 33, 10, 20, 30]);
});
