import assert from "node:assert/strict";
import { test } from "node:test";
import { cubeOf, nodeOf, nodesFor, spacingOf } from "../../../lslam/reports/scripts/octree.mjs";

/** A full octree of three levels over a cube of 64 m, and a camera that looks straight down on its middle. */
const tree = { low: [0, 0, 0], edge: 64, cells: 128, columns: {}, nodes: { r: 1000 } };
for (let a = 0; a < 8; a += 1) {
  tree.nodes[`r${a}`] = 1000;
  for (let b = 0; b < 8; b += 1) tree.nodes[`r${a}${b}`] = 1000;
}
const camera = (metres, centre = [32, 32, 0], isFlat = true) => ({
  metres, centre, isFlat, width: 800, height: 600, axes: () => ({ right: [1, 0, 0], up: [0, 1, 0], back: [0, 0, 1], away: 600 * metres }),
});

test("a name says where the cube is", () => {
  assert.deepEqual(cubeOf("r", tree), { low: [0, 0, 0], edge: 64 });
  assert.deepEqual(cubeOf("r4", tree), { low: [32, 0, 0], edge: 32 });
  assert.deepEqual(cubeOf("r61", tree), { low: [32, 32, 16], edge: 16 });
});

test("spacing halves with a level, and is nothing outside of the view", () => {
  assert.equal(spacingOf("r", tree, camera(0.1)), 64 / 128 / 0.1);
  assert.equal(spacingOf("r0", tree, camera(0.1)), 32 / 128 / 0.1);
  assert.equal(spacingOf("r0", tree, camera(0.001, [63, 63, 0])), 0);
  const near = spacingOf("r71", tree, { ...camera(0.1, [32, 32, 0], false) });
  assert.ok(near > spacingOf("r70", tree, { ...camera(0.1, [32, 32, 0], false) }), "what is nearer to the viewer is seen larger");
});

test("from afar the root is enough; near by only what is seen is asked for, parents first", () => {
  assert.deepEqual(nodesFor(tree, camera(1), 1e9, 1), ["r"]);
  const near = nodesFor(tree, camera(0.01, [4, 4, 0]), 1e9, 1);
  assert.equal(near[0], "r");
  for (const name of near.slice(1)) assert.ok(near.indexOf(name.slice(0, -1)) < near.indexOf(name) && near.includes(name.slice(0, -1)));
  assert.ok(near.includes("r00") && !near.includes("r7") && near.length < 30, near.join(" "));
  assert.equal(nodesFor(tree, camera(0.05), 1e9, 1).length, 73);
});

test("the budget of points is kept", () => {
  assert.equal(nodesFor(tree, camera(0.05), 20_500, 1).length, 20);
});

test("the bytes of a node are points, columns and nearest poses", () => {
  const own = { ...tree, columns: { intensity: 1, class: 1 }, nodes: { r4: 3 }, values: [0, 100] };
  const bytes = new Uint8Array(18 + 3 + 3 + 12);
  new Int16Array(bytes.buffer, 0, 9).set([-32768, 0, 32767, 1, 2, 3, 4, 5, 6]);
  bytes.set([0, 255, 128], 18);
  bytes.set([7, 9, 2], 21);
  new DataView(bytes.buffer).setUint32(24, 70_000, true);
  const cloud = nodeOf("r4", bytes.buffer, own, { values: [50, 100], kinds: ["9", "7", "others"] });
  assert.deepEqual(cloud.low, [32, 0, 0]);
  assert.deepEqual(Array.from(cloud.points.slice(0, 3)), [-32768, 0, 32767]);
  // 0, 100 and 50.2 of an intensity, over the page's range from 50 to 100.
  assert.deepEqual(Array.from(cloud.intensity), [0, 255, 1]);
  assert.deepEqual(Array.from(cloud.kind), [1, 0, 2]);
  assert.deepEqual(Array.from(cloud.nearest), [70_000, 0, 0]);
  const merged = nodeOf("r4", bytes.buffer, own, { session: new Uint8Array(9), height: [0, 3] });
  assert.deepEqual([Array.from(merged.session), merged.nearest, merged.height], [[70_000, 0, 0], undefined, [0, 3]]);
});
