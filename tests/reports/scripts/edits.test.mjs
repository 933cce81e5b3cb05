import assert from "node:assert/strict";
import { test } from "node:test";
import { awayFrom, pairsFile, pointOf, pointsFile, saidOf, seenFrom, sortedBy, withVerdict } from "../../../lslam/reports/scripts/edits.mjs";

test("a pair is the same whichever scan comes first, and has one verdict", () => {
  let pairs = withVerdict([], 3, 90, "known");
  assert.equal(saidOf(pairs, 90, 3), "known");
  pairs = withVerdict(withVerdict(pairs, 7, 8, "known"), 90, 3, "forbidden");
  assert.deepEqual(pairs.map((pair) => [pair.scan_a, pair.scan_b, pair.verdict]), [[7, 8, "known"], [90, 3, "forbidden"]]);
  assert.deepEqual(withVerdict(pairs, 3, 90, ""), [pairs[0]]);
  assert.equal(saidOf(pairs, 1, 2), "");
});

test("files have the columns that lslam graph needs, and others only where they say something", () => {
  assert.equal(pairsFile([{ scan_a: 3, scan_b: 90, verdict: "known", within_m: null }]), "scan_a,scan_b,verdict\n3,90,known\n");
  assert.equal(pairsFile([{ scan_a: 3, scan_b: 90, verdict: "known", within_m: 5 }]), "scan_a,scan_b,verdict,x_m,y_m,within_m\n3,90,known,0,0,5\n");
  const point = { scan: 3, x: 458000.5, y: 5430000, z: -1, sigma: 0.02, crs: "EPSG:25832" };
  assert.equal(pointsFile([point]), "scan,x,y,z,sigma,crs\n3,458000.5,5430000,-1,0.02,EPSG:25832\n");
  assert.equal(pointsFile([point, { ...point, lidar_x: 1.5 }]).split("\n")[2], "3,458000.5,5430000,-1,0.02,EPSG:25832,,1.5,0,0");
});

test("a point is seen from a LiDAR as its pose says: R = Rz(yaw) Ry(pitch) Rx(roll)", () => {
  const near = (found, wanted) => found.forEach((value, k) => assert.ok(Math.abs(value - wanted[k]) < 1e-9, `${found}`));
  near(seenFrom([3, 4, 5], [1, 1, 1], [0, 0, 0]), [2, 3, 4]);
  near(seenFrom([0, 1, 0], [0, 0, 0], [0, 0, 90]), [1, 0, 0]);
  near(seenFrom([0, 0, -1], [0, 0, 0], [0, 90, 0]), [1, 0, 0]);
  near(seenFrom([0, 0, 1], [0, 0, 0], [90, 0, 0]), [0, 1, 0]);
  // Of scipy: Rotation.from_euler("ZYX", [30, -20, 50], degrees=True).inv().apply([1, 2, 3]).
  near(seenFrom([1, 2, 3], [0, 0, 0], [50, -20, 30]), [2.7795507321122876, 2.4625823609220583, 0.4580238457652419]);
});

test("what is typed becomes a point, or is said to be none", () => {
  const words = { scan: "12", x: "458000,5", y: "5430000", z: "115", sigma: "0.02", crs: " epsg:25832+7837 " };
  assert.deepEqual(pointOf(words), { scan: 12, x: 458000.5, y: 5430000, z: 115, sigma: 0.02, crs: "EPSG:25832+7837" });
  for (const [name, text] of [["x", ""], ["y", "east"], ["scan", "1.5"], ["scan", "-1"], ["sigma", "0"], ["crs", "25832"], ["crs", "EPSG:1,2"], ["z", "Infinity"]]) {
    assert.throws(() => pointOf({ ...words, [name]: text }), new RegExp(name));
  }
});

test("candidates are sorted both ways, unknown values last", () => {
  const of = (name, falling) => sortedBy([{ k: 0, overlap: 0.5, reason: "b", poses: [4, 9] }, { k: 1, overlap: null, reason: "a", poses: [1, 9] }, { k: 2, overlap: 0.9, reason: "c", poses: [7, 9] }], name, falling).map((one) => one.k);
  assert.deepEqual([of("overlap", true), of("overlap", false)], [[2, 0, 1], [0, 2, 1]]);
  assert.deepEqual([of("reason", false), of("poses", true)], [[1, 0, 2], [2, 0, 1]]);
});

test("away from a line is away from its nearest place", () => {
  assert.equal(awayFrom(5, 3, [0, 0, 10, 0]), 3);
  assert.equal(awayFrom(13, 4, [0, 0, 10, 0]), 5);
  assert.equal(awayFrom(3, 4, [0, 0, 0, 0]), 5);
  assert.ok(Number.isNaN(awayFrom(3, 4, [NaN, NaN, 0, 0])));
});
