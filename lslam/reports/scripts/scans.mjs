// Every scan of a run, what is known of it, and the one that is marked in all plots.
import { read } from "./elements.mjs";
import { fixed, unpack } from "./numbers.mjs";

/** Every scan of a run, and the abscissae that charts are drawn over; null on pages of several runs. */
export const scans = (() => {
  const data = read("scans");
  if (!data) return null;
  const positions = unpack(data.positions, Float32Array);
  const stamps = unpack(data.stamps, Float64Array);
  const index = unpack(data.index, Int32Array);
  const column = (points, axis) => Float32Array.from({ length: points.length / 3 }, (_, k) => points[3 * k + axis]);
  const own = [column(positions, 0), column(positions, 1)];
  const by = { scan: index, way: unpack(data.way, Float32Array), time: stamps.map((ns) => ns * 1e-9), own };
  if (data.aligned) {
    by.truth = unpack(data.truth_way, Float32Array);
    by.aligned = data.aligned.slice(0, 2).map((row) => Float32Array.from({ length: data.count }, (_, k) =>
      row[0] * positions[3 * k] + row[1] * positions[3 * k + 1] + row[2] * positions[3 * k + 2] + row[3]));
  }
  const status = unpack(data.status, Uint8Array);
  const failed = ["bridged", "skipped"].map((word) => data.statuses.indexOf(word));
  return {
    ...data, positions, stamps, index, by, status,
    failed: Array.from(status.keys()).filter((k) => failed.includes(status[k] & 7)),
    angles: unpack(data.angles, Float32Array),
    posedBy: unpack(data.posed_by, Uint8Array),
    fixes: data.fixes ? unpack(data.fixes, Uint8Array) : null,
    error: data.error ? unpack(data.error, Float32Array) : null,
    truth: data.truth ? unpack(data.truth, Float32Array) : null,
  };
})();

/** What became of scan k, in words. */
export function statusOf(k) {
  const code = scans.status[k];
  const words = [scans.statuses[code & 7]];
  if (code & scans.flags.degenerate) words.push("poorly constrained");
  if (code & scans.flags.lost) words.push("may be lost");
  if (scans.posers.length > 1 && scans.posedBy[k] < scans.posers.length) words.push(`posed by ${scans.posers[scans.posedBy[k]]}`);
  if (scans.reasons[k]) words.push(scans.reasons[k]);
  return words.join(", ");
}

/** What is known of scan k, as [name, text]. */
export function tell(k) {
  const three = (values, digits) => [0, 1, 2].map((axis) => fixed(values[3 * k + axis], digits)).join(", ");
  const rows = [
    ["scan", scans.index[k] < 0 ? "n/a" : String(scans.index[k])],
    ["time", `${fixed(scans.by.time[k], 3)} s`],
    ["stamp", `${BigInt(scans.first_stamp_ns) + BigInt(scans.stamps[k])} ns`],
    ["x, y, z", `${three(scans.positions, 2)} m`],
    ["roll, pitch, yaw", `${three(scans.angles, 2)}°`],
  ];
  if (scans.error) rows.push([`error (${scans.alignment})`, Number.isFinite(scans.error[k]) ? `${fixed(scans.error[k], 3)} m` : "not matched"]);
  if (scans.fixes) rows.push(["map", scans.states[scans.fixes[k]][0]]);
  rows.push(["status", statusOf(k)]);
  return rows;
}

// The scan that is marked in all plots.
export const watchers = [];
export let marked = 0;
let isDue = false;

export function mark(k) {
  if (!scans || k === marked || k < 0 || k >= scans.count) return;
  marked = k;
  if (isDue) return;
  isDue = true;
  requestAnimationFrame(() => {
    isDue = false;
    for (const watcher of watchers) watcher(marked);
  });
}
