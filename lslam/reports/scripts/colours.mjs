// Colours of the points: what they can show, and how it is spread over a palette.
import { clamp, fixed } from "./numbers.mjs";

/** Ways in which points are coloured: by height or value through the palette, by colours of their own, in one colour. */
export const BY = { height: 0, value: 1, rgb: 2, one: 3 };
const SAMPLE = 20_000; // values of which percentiles are taken
// Of points that have a class: one colour each, told apart by eyes that see few colours too (Okabe and Ito 2008), then repeated.
const KINDS = ["0072b2", "e69f00", "009e73", "cc79a7", "56b4e9", "d55e00", "f0e442", "999999"];

const rgbOf = (text) => [0, 2, 4].map((i) => parseInt(text.slice(i, i + 2), 16));

/** 256 colours, RGBA, mixed from the ones given as hexadecimal. */
export function ramp(colours) {
  const rgb = colours.map(rgbOf);
  return Uint8Array.from({ length: 1024 }, (_, i) => {
    if (i % 4 === 3) return 255;
    const at = ((i >> 2) / 255) * (rgb.length - 1);
    const k = Math.min(Math.floor(at), rgb.length - 2);
    return Math.round(rgb[k][i % 4] + (at - k) * (rgb[k + 1][i % 4] - rgb[k][i % 4]));
  });
}

/** Some of the finite values, in order. */
export function sample(count, valueAt) {
  const step = Math.max(1, Math.floor(count / SAMPLE));
  const found = [];
  for (let i = 0; i < count; i += step) if (Number.isFinite(valueAt(i))) found.push(valueAt(i));
  return Float64Array.from(found).sort();
}

/** Percentile p of ordered values, between neighbours. */
export function percentile(ordered, p) {
  const at = (p / 100) * (ordered.length - 1);
  const k = clamp(Math.floor(at), 0, Math.max(ordered.length - 2, 0));
  return ordered.length > 1 ? ordered[k] + (at - k) * (ordered[k + 1] - ordered[k]) : ordered[0] || 0;
}

/**
 * Ways to colour the points of a map, by name: `by` as the drawer has it, bytes for it, `ordered` values of which the range is
 * taken in percentiles, at first `usual`, `text` of a value, and what is `said` of it.
 */
export function colourings(cloud, scans) {
  const byValue = (bytes, low, high, text, said, usual = [2, 98]) => ({
    by: BY.value, bytes, said, usual, text: (share) => text(low + share * (high - low)), ordered: sample(bytes.length, (i) => bytes[i] / 255),
  });
  const z = (i) => cloud.low[2] + cloud.step[2] * (cloud.points[3 * i + 2] + 32768);
  const known = { height: { by: BY.height, said: "height z", usual: [2, 98], text: (value) => `${fixed(value, 1)} m`, ordered: sample(cloud.count, z) } };
  if (cloud.rgb) known["camera colours"] = { by: BY.rgb, bytes: cloud.rgb, said: "colours of the camera" };
  if (cloud.kind) {
    const palette = cloud.kinds.map((_, k) => rgbOf(KINDS[k % KINDS.length]));
    const bytes = new Uint8Array(3 * cloud.count);
    cloud.kind.forEach((kind, i) => bytes.set(palette[kind], 3 * i));
    known.class = { by: BY.rgb, bytes, said: "label in the recording", kinds: cloud.kinds.map((name, k) => [name, KINDS[k % KINDS.length]]) };
  }
  if (cloud.intensity) known.intensity = byValue(cloud.intensity, ...cloud.values, (value) => value.toPrecision(3), "intensity");
  if (!scans || !cloud.nearest) return known;
  const byScan = (values, top, ...rest) => byValue(Uint8Array.from(cloud.nearest, (k) => clamp((255 * values[k]) / top, 0, 255)), 0, top, ...rest);
  const end = scans.by.time[scans.count - 1];
  if (end > 0) known.time = byScan(scans.by.time, end, (value) => `${fixed(value, 1)} s`, "time of the nearest scan", [0, 100]);
  if (scans.error && scans.error.some(Number.isFinite)) {
    const top = Math.max(percentile(sample(scans.count, (k) => scans.error[k]), 98), 1e-6);
    known.error = byScan(scans.error, top, (value) => `${fixed(value, 3)} m`, `position error of the nearest scan (${scans.alignment})`, [0, 100]);
  }
  return known;
}
