// What a person says of pairs of scans and of points, and the two files of it that `lslam graph` reads.

const PAIR = [["scan_a", "scan_b", "verdict"], { x_m: 0, y_m: 0, within_m: null }];
const POINT = [["scan", "x", "y", "z", "sigma", "crs"], { sigma_z: null, lidar_x: 0, lidar_y: 0, lidar_z: 0 }];

const isOf = (a, b) => (pair) => (pair.scan_a === a && pair.scan_b === b) || (pair.scan_a === b && pair.scan_b === a);

/** What was said of two scans: known, forbidden, or nothing. */
export function saidOf(pairs, a, b) {
  return pairs.find(isOf(a, b))?.verdict || "";
}

/** The pairs with another verdict of two scans; none where it is empty. */
export function withVerdict(pairs, a, b, verdict) {
  const others = pairs.filter((pair) => !isOf(a, b)(pair));
  return verdict ? [...others, { scan_a: a, scan_b: b, verdict }] : others;
}

export const pairsFile = (pairs) => table(pairs, ...PAIR);
export const pointsFile = (points) => table(points, ...POINT);

/** Rows as CSV; columns that may be empty stand there only where one of them is not. */
function table(rows, needed, further) {
  const isGiven = rows.some((row) => Object.entries(further).some(([name, usual]) => (row[name] ?? usual) !== usual));
  const names = isGiven ? [...needed, ...Object.keys(further)] : needed;
  const cells = (row) => names.map((name) => row[name] ?? further[name] ?? "").join(",");
  return `${[names.join(","), ...rows.map(cells)].join("\n")}\n`;
}

/** A point of the world as a LiDAR at `position` saw it, m; `angles` : roll, pitch, yaw, deg. */
export function seenFrom(point, position, angles) {
  const [[cr, sr], [cp, sp], [cy, sy]] = angles.map((deg) => [Math.cos((deg * Math.PI) / 180), Math.sin((deg * Math.PI) / 180)]);
  const [x, y, z] = point.map((value, k) => value - position[k]);
  const ahead = cy * x + sy * y;
  const left = cy * y - sy * x;
  const down = sp * ahead + cp * z;
  return [cp * ahead - sp * z, cr * left + sr * down, cr * down - sr * left];
}

/** A row of points.csv from what was typed, by name. Raises Error with what is wrong. */
export function pointOf(words) {
  const numbers = ["scan", "x", "y", "z", "sigma"].map((name) => {
    const value = Number(words[name].replace(",", "."));
    if (!words[name].trim() || !Number.isFinite(value)) throw new Error(`${name} is no number`);
    return [name, value];
  });
  const point = Object.fromEntries(numbers);
  if (!Number.isInteger(point.scan) || point.scan < 0) throw new Error("scan is no number of a scan");
  if (!(point.sigma > 0)) throw new Error("sigma must be above 0");
  const crs = words.crs.trim().toUpperCase();
  if (!/^EPSG:\d+(\+\d+)?$/.test(crs)) throw new Error("crs: EPSG and a number, for example EPSG:25832");
  return { ...point, crs };
}

/** Candidates by one of their values, what is not known last; `poses` are sorted by the first. */
export function sortedBy(candidates, name, isFalling) {
  const value = (one) => (Array.isArray(one[name]) ? one[name][0] : one[name]);
  return candidates.toSorted((a, b) => {
    const [x, y] = [value(a), value(b)];
    if (x === null || y === null) return Number(x === null) - Number(y === null);
    const order = typeof x === "string" ? x.localeCompare(y) : x - y;
    return isFalling ? -order : order;
  });
}

/** How far a place is from a line between two others, px. */
export function awayFrom(x, y, [ax, ay, bx, by]) {
  const [dx, dy] = [bx - ax, by - ay];
  const length = dx * dx + dy * dy;
  const share = length ? Math.min(Math.max(((x - ax) * dx + (y - ay) * dy) / length, 0), 1) : 0;
  return Math.hypot(x - ax - share * dx, y - ay - share * dy);
}
