import assert from "node:assert/strict";
import { test } from "node:test";
import { moved } from "../../../lslam/reports/scripts/two_clouds.mjs";

test("points are moved by the rows of a transform", () => {
  assert.deepEqual(Array.from(moved([1, 2, 3, 0, 0, 0], [[0, -1, 0, 10], [1, 0, 0, 20], [0, 0, 1, 30]])), [8, 21, 33, 10, 20, 30]);
});
