// The octree of a map: which of its nodes a view needs, and what their bytes mean.

const NEAREST = 0.02; // of the viewer's distance to the centre

/** Lowest corner and edge of a node's cube, m; the digits of its name are 4 x + 2 y + z. */
export function cubeOf(name, tree) {
  let edge = tree.edge;
  const low = [...tree.low];
  for (const digit of name.slice(1)) {
    edge /= 2;
    [4, 2, 1].forEach((bit, k) => {
      if (Number(digit) & bit) low[k] += edge;
    });
  }
  return { low, edge };
}

/** px between the points of a node where it is nearest to the viewer; 0 where it is not seen. */
export function spacingOf(name, tree, camera) {
  const { low, edge } = cubeOf(name, tree);
  const [radius, { right, up, back, away }] = [0.87 * edge, camera.axes()];
  const d = low.map((value, k) => value + edge / 2 - camera.centre[k]);
  const along = (axis) => axis[0] * d[0] + axis[1] * d[1] + axis[2] * d[2];
  const depth = (extra) => (camera.isFlat ? 1 : 1 + (extra - along(back)) / away);
  const far = camera.metres * depth(radius);
  if (far <= 0 || Math.abs(along(right)) > (far * camera.width) / 2 + radius || Math.abs(along(up)) > (far * camera.height) / 2 + radius) return 0;
  return edge / tree.cells / (camera.metres * Math.max(depth(-radius), NEAREST));
}

/**
 * Nodes that a view needs, the coarsest as seen first: children of nodes whose points are more than `finest` px apart, as long as
 * all have not more points than `budget`.
 */
export function nodesFor(tree, camera, budget, finest) {
  const found = [];
  const waiting = [["r", spacingOf("r", tree, camera)]];
  let points = 0;
  while (waiting.length) {
    const at = waiting.reduce((best, one, i) => (one[1] > waiting[best][1] ? i : best), 0);
    const [[name, spacing]] = waiting.splice(at, 1);
    if (!spacing || !(name in tree.nodes)) continue;
    points += tree.nodes[name];
    if (points > budget) break;
    found.push(name);
    if (spacing <= finest) continue;
    for (let k = 0; k < 8; k += 1) if (`${name}${k}` in tree.nodes) waiting.push([`${name}${k}`, spacingOf(`${name}${k}`, tree, camera)]);
  }
  return found;
}

/** A node as a cloud that is coloured as the page's `like`: its bytes are points, columns, and the nearest pose, or session, of each. */
export function nodeOf(name, buffer, tree, like) {
  const { low, edge } = cubeOf(name, tree);
  const count = tree.nodes[name];
  const cloud = { low, step: [0, 1, 2].map(() => edge / 65535), count, height: like.height, points: new Int16Array(buffer, 0, 3 * count) };
  let at = 6 * count;
  for (const [column, size] of Object.entries(tree.columns)) {
    cloud[column] = new Uint8Array(buffer, at, size * count);
    at += size * count;
  }
  cloud[like.session ? "session" : "nearest"] = new Uint32Array(buffer.slice(at));
  if (cloud.intensity && like.values) {
    const [[a, b], [c, d]] = [tree.values, like.values];
    const table = Uint8ClampedArray.from({ length: 256 }, (_, k) => (255 * (a + (k / 255) * (b - a) - c)) / (d - c));
    cloud.intensity = cloud.intensity.map((value) => table[value]);
    cloud.values = like.values;
  }
  if (cloud.class && like.kinds) {
    const last = like.kinds.length - 1;
    const table = Uint8Array.from({ length: 256 }, (_, k) => (like.kinds.includes(String(k)) ? like.kinds.indexOf(String(k)) : last));
    [cloud.kind, cloud.kinds] = [cloud.class.map((value) => table[value]), like.kinds];
  }
  return cloud;
}
