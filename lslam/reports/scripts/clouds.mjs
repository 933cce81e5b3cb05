// A cloud of the page: coordinates are `low` + `step` (q + 32768), m, of whole numbers q.
import { unpack } from "./numbers.mjs";

const QUANTA = 65535;

/** From the page's data: points as Int16Array, and per point `value`, `rgb`, `kind` and `nearest` where it has them. */
export function cloudOf(data, scanCount = 0) {
  const column = (name, Kind) => (data[name] ? unpack(data[name], Kind) : null);
  return {
    ...data,
    points: unpack(data.points, Int16Array),
    intensity: column("intensity", Uint8Array),
    rgb: column("rgb", Uint8Array),
    kind: column("kind", Uint8Array),
    session: column("session", Uint8Array),
    change: column("change", Int8Array),
    nearest: column("nearest", scanCount <= QUANTA ? Uint16Array : Uint32Array),
  };
}

/** Coordinates of a cloud, m: x, y, z, x, ... */
export function coordinates(cloud) {
  const [x0, y0, z0] = cloud.low.map((low, k) => low + 32768 * cloud.step[k]);
  const [sx, sy, sz] = cloud.step;
  const found = new Float32Array(cloud.points.length);
  for (let i = 0; i < found.length; i += 3) {
    found[i] = x0 + sx * cloud.points[i];
    found[i + 1] = y0 + sy * cloud.points[i + 1];
    found[i + 2] = z0 + sz * cloud.points[i + 2];
  }
  return found;
}

/** A cloud of coordinates x, y, z, x, ..., m, packed into whole numbers. */
export function cloudFrom(xyz) {
  const [low, high] = [[Infinity, Infinity, Infinity], [-Infinity, -Infinity, -Infinity]];
  for (let i = 0; i < xyz.length; i += 1) {
    low[i % 3] = Math.min(low[i % 3], xyz[i]);
    high[i % 3] = Math.max(high[i % 3], xyz[i]);
  }
  const step = low.map((value, k) => Math.max((high[k] - value) / QUANTA, 1e-6));
  const points = Int16Array.from(xyz, (value, i) => Math.round((value - low[i % 3]) / step[i % 3]) - 32768);
  return { points, low, step, count: xyz.length / 3 };
}
