import assert from "node:assert/strict";
import { test } from "node:test";
import { cloudFrom, coordinates } from "../../../lslam/reports/scripts/clouds.mjs";
import { between } from "../../../lslam/reports/scripts/measure.mjs";
import { lengths, unroll } from "../../../lslam/reports/scripts/section.mjs";

const near = (found, wanted) => assert.ok(found.every((value, i) => Math.abs(value - wanted[i]) < 1e-4), `${[...found]} is not ${wanted}`);

test("a section along x is the points beside it, with their side and height", () => {
  const line = [10, 5, 0, 30, 5, 0];
  const { xyz, rows } = unroll([12, 6, 3, 25, 4, 8, 25, 9, 8, 9, 5, 1, 31, 5, 1], line, 2);
  assert.deepEqual([...rows], [0, 1]);
  near(xyz, [2, 1, 3, 15, -1, 8]);
});

test("beyond a corner it goes on along the next leg, and the outside of the bend is the corner", () => {
  const line = [0, 0, 0, 10, 0, 0, 10, 20, 0];
  near(lengths(line), [0, 10, 30]);
  const { xyz } = unroll([9, 15, 1, 11, -1, 2, 4, 1, 3], line, 2);
  near(xyz, [25, 1, 1, 10, -Math.SQRT2, 2, 4, 1, 3]);
});

test("a pose that is not known leaves the others", () => {
  const line = [0, 0, 0, NaN, NaN, NaN, 10, 0, 0, 20, 0, 0];
  near(lengths(line), [0, 0, 0, 10]);
  near(unroll([15, 1, 4], line, 2).xyz, [5, 1, 4]);
});

test("given the corner near each point, only legs about it are looked at", () => {
  // There and back on one street, 1 m apart: each point belongs to the leg it was seen from.
  const line = [0, 0, 0, 50, 0, 0, 100, 0, 0, 100, 1, 0, 50, 1, 0, 0, 1, 0];
  const { xyz } = unroll([49, 0.9, 2, 49, 0.1, 2], line, 3, [1, 5]);
  near(xyz, [49, 0.9, 2, 152, 0.9, 2]);
});

test("a packed cloud comes back within a step of its whole numbers", () => {
  const given = Float32Array.from([0, -3, 2, 700, 4, 2, 12.5, 0.25, 9]);
  const cloud = cloudFrom(given);
  coordinates(cloud).forEach((value, i) => assert.ok(Math.abs(value - given[i]) <= 0.51 * cloud.step[i % 3] + 1e-4));
});

test("a measured distance has its level part and its height", () => {
  assert.deepEqual(between([1, 1, 1], [4, 5, 13]), { distance: 13, level: 5, height: 12 });
});
