// Colours of the points: what they can show, and how it is spread over a palette.
import { clamp, fixed, unpack } from "./numbers.mjs";
import { scans } from "./scans.mjs";

/** 256 colours, RGBA, mixed from the ones given as hexadecimal. */
export function ramp(colours) {
  const rgb = colours.map((text) => [0, 2, 4].map((i) => parseInt(text.slice(i, i + 2), 16)));
  return Uint8Array.from({ length: 1024 }, (_, i) => {
    if (i % 4 === 3) return 255;
    const at = ((i >> 2) / 255) * (rgb.length - 1);
    const k = Math.min(Math.floor(at), rgb.length - 2);
    return Math.round(rgb[k][i % 4] + (at - k) * (rgb[k + 1][i % 4] - rgb[k][i % 4]));
  });
}

/** Ways to colour the points: name -> what they say, and a share of 0 to 255 for each. */
export function colourings(cloud) {
  const q = unpack(cloud.points, Int16Array);
  const [low, high] = cloud.height;
  const height = () => Uint8Array.from({ length: cloud.count }, (_, i) =>
    clamp((255 * (cloud.low[2] + cloud.step[2] * (q[3 * i + 2] + 32768) - low)) / (high - low), 0, 255));
  const known = { height: { said: "height z", range: [`${fixed(low, 1)} m`, `${fixed(high, 1)} m`], shades: height } };
  if (cloud.intensity) {
    known.intensity = { said: "intensity", range: cloud.values.map((value) => value.toPrecision(3)), shades: () => unpack(cloud.intensity, Uint8Array) };
  }
  if (!scans || !cloud.nearest) return known;
  const nearest = unpack(cloud.nearest, scans.count <= 65535 ? Uint16Array : Uint32Array);
  const byScan = (values, top) => () => Uint8Array.from(nearest, (k) => clamp((255 * values[k]) / top, 0, 255));
  const end = scans.by.time[scans.count - 1];
  if (end > 0) known.time = { said: "time of the nearest scan", range: ["0 s", `${fixed(end, 1)} s`], shades: byScan(scans.by.time, end) };
  if (scans.error && scans.error.some(Number.isFinite)) {
    const sorted = scans.error.filter(Number.isFinite).sort();
    const top = Math.max(sorted[Math.floor(0.98 * (sorted.length - 1))], 1e-6);
    known.error = { said: `position error of the nearest scan (${scans.alignment})`, range: ["0 m", `${fixed(top, 3)} m`], shades: byScan(scans.error, top) };
  }
  return known;
}
