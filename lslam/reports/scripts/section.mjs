// A section: what lies beside a line on the ground, drawn over the distance along it.

/** Distance of each corner of a line (x, y, z, x, ...) from its start, m on the ground. */
export function lengths(line) {
  const found = new Float64Array(line.length / 3);
  for (let k = 1; k < found.length; k += 1) {
    const step = Math.hypot(line[3 * k] - line[3 * k - 3], line[3 * k + 1] - line[3 * k - 2]);
    found[k] = found[k - 1] + (Number.isFinite(step) ? step : 0);
  }
  return found;
}

/** Along leg k of a line and to its left, m; null before the line begins and after it ends. */
function onLeg(line, k, x, y) {
  const [px, py] = [x - line[3 * k], y - line[3 * k + 1]];
  const [dx, dy] = [line[3 * k + 3] - line[3 * k], line[3 * k + 4] - line[3 * k + 1]];
  const length = Math.hypot(dx, dy);
  if (!(length > 0)) return null;
  const along = (px * dx + py * dy) / length;
  const left = (py * dx - px * dy) / length;
  if (along >= 0 && along <= length) return [along, left];
  const isWithin = along < 0 ? k > 0 : k < line.length / 3 - 2;
  if (!isWithin) return null;
  // Outside of a bend: what is nearest is the corner.
  const at = along < 0 ? 0 : length;
  return [at, Math.hypot(along - at, left) * (left < 0 ? -1 : 1)];
}

/**
 * Points within `half` m of a line on the ground: `xyz` (along, to the left, z), m, and `rows`, which of the points they are.
 * `corner` gives a corner of the line near each point; without it every leg is looked at.
 */
export function unroll(points, line, half, corner = null) {
  const legs = line.length / 3 - 1;
  const way = lengths(line);
  const [xyz, rows] = [[], []];
  for (let i = 0; i < points.length / 3; i += 1) {
    const [x, y] = [points[3 * i], points[3 * i + 1]];
    const [first, last] = corner ? [Math.max(corner[i] - 2, 0), Math.min(corner[i] + 1, legs - 1)] : [0, legs - 1];
    let best = null;
    for (let k = first; k <= last; k += 1) {
      const found = onLeg(line, k, x, y);
      if (found && Math.abs(found[1]) <= half && !(best && Math.abs(best[1]) <= Math.abs(found[1]))) best = [way[k] + found[0], found[1]];
    }
    if (!best) continue;
    xyz.push(best[0], best[1], points[3 * i + 2]);
    rows.push(i);
  }
  return { xyz: Float32Array.from(xyz), rows: Uint32Array.from(rows) };
}
