import assert from "node:assert/strict";
import { test } from "node:test";
import { orderOf, valueOf } from "../../../lslam/reports/scripts/sortable.mjs";

test("a cell's number is its first one", () => {
  assert.equal(valueOf("0.120 ± 0.03"), 0.12);
  assert.equal(valueOf("~12.1"), 12.1);
  assert.equal(valueOf("−3"), -3);
  assert.equal(valueOf("2/2, 1 degraded"), 2);
  assert.ok([valueOf("failed"), valueOf("-"), valueOf("icp 2")].every(Number.isNaN));
});

test("numbers are sorted by size, and what has none is last both ways", () => {
  const texts = ["10.5", "failed", "9", "~0.5 ± 0.1", "-"];
  assert.deepEqual(orderOf(texts, false), [3, 2, 0, 1, 4]);
  assert.deepEqual(orderOf(texts, true), [0, 2, 3, 1, 4]);
});

test("words are sorted by letter, and equal ones stay in order", () => {
  assert.deepEqual(orderOf(["loam", "icp", "kiss-icp", "icp"], false), [1, 3, 2, 0]);
  assert.deepEqual(orderOf(["b", "a", "a"], true), [0, 1, 2]);
});
