import assert from "node:assert/strict";
import { test } from "node:test";
import { Camera } from "../../../lslam/reports/scripts/camera.mjs";

const POINTS = [[3, -2, 1], [-40, 25, 6], [0, 0, 0], [17, 90, -3]];

function looking(yaw, tilt, isFlat) {
  const camera = new Camera();
  camera.fit(800, 500, [-60, 60, -40, 40]);
  Object.assign(camera, { yaw, tilt, isFlat, centre: [4, -7, 2], metres: 0.2 });
  return camera;
}

for (const [name, yaw, tilt, isFlat] of [["from above", 0, 0, true], ["in perspective", 0.6, 0.95, false], ["at a section", 0, Math.PI / 2, true]]) {
  test(`what is drawn over the points lies where the drawer puts them, ${name}`, () => {
    const camera = looking(yaw, tilt, isFlat);
    const { M, depth, rest, perspective } = camera.matrix(200);
    const { back } = camera.axes();
    const seen = camera.project(POINTS.flat());
    POINTS.forEach((point, i) => {
      const off = point.map((value, k) => value - camera.centre[k]);
      const clip = [0, 1, 2, 3].map((row) => M[row] * off[0] + M[4 + row] * off[1] + M[8 + row] * off[2] + M[12 + row]);
      assert.ok(Math.abs((clip[0] / clip[3] / 2 + 0.5) * 800 - seen[2 * i]) < 0.02);
      assert.ok(Math.abs((0.5 - clip[1] / clip[3] / 2) * 500 - seen[2 * i + 1]) < 0.02);
      const ndc = clip[2] / clip[3];
      const towards = off.reduce((sum, value, k) => sum + value * back[k], 0);
      assert.ok(Math.abs((ndc - rest) / (depth + perspective * ndc) - towards) < 0.01, "depth of the screen comes back in m");
    });
  });
}

test("the nearer of two points on one ray is picked, and none where none is", () => {
  const camera = looking(0, 0, true);
  const [x, y] = camera.project([10, 5, 0]);
  assert.equal(camera.pick([10, 5, 0, 10, 5, 8, 30, 5, 20], x, y), 1);
  assert.equal(camera.pick([10, 5, 0], x + 20, y), -1);
});

test("zooming keeps what is under the pointer, and a drag moves it along", () => {
  const camera = looking(0.3, 0, true);
  const point = [12, 9, 2];
  const [x, y] = camera.project(point);
  camera.zoom(3, x, y);
  let seen = camera.project(point);
  assert.ok(Math.hypot(seen[0] - x, seen[1] - y) < 0.01);
  camera.shift(-30 * camera.metres, 20 * camera.metres);
  seen = camera.project(point);
  assert.ok(Math.hypot(seen[0] - x - 30, seen[1] - y - 20) < 0.01);
});

test("a section is dragged up as well as along", () => {
  const camera = looking(0, Math.PI / 2, true);
  const before = camera.project([5, 0, 3]);
  camera.shift(-2, 1.5);
  const after = camera.project([5, 0, 3]);
  assert.ok(Math.abs(after[0] - before[0] - 10) < 0.01 && Math.abs(after[1] - before[1] - 7.5) < 0.01);
});
