// Points coloured by kind: the session that came nearest, and what differs from an old map.
import { BY, ramp } from "./colours.mjs";
import { clamp } from "./numbers.mjs";

const GREYS = ["5a5f66", "d4d8dc"]; // low to high, of what is as it was
const DARKEST = 0.5; // share of a session's colour at its lowest points
const CHANGES = { [-1]: ["gone", "d64541"], 1: ["not in the map", "2e86c1"] };

/** Ways to colour the points of a cloud by kind, as `colourings` has them; `colourOf` is that of a session, "rgb(0, 99, 166)". */
export function kindsOf(cloud, sessions, colourOf) {
  const known = {};
  if (cloud.change) {
    const kinds = Object.values(CHANGES);
    known.changes = { by: BY.rgb, bytes: changed(cloud), said: "height in grey, lighter is higher;", kinds };
  }
  if (cloud.session) {
    const colours = sessions.map((session) => colourOf(session).match(/\d+/g).slice(0, 3).map(Number));
    const share = heightOf(cloud);
    const bytes = spreadOut(cloud.session, (k, i) => colours[k].map((value) => value * (DARKEST + (1 - DARKEST) * share(i))));
    known.session = { by: BY.rgb, bytes, said: "session whose trajectory is nearest; higher is brighter" };
  }
  return known;
}

/** Red, green, blue of each point: grey by height, but for what changed. */
function changed(cloud) {
  const greys = ramp(GREYS);
  const share = heightOf(cloud);
  const rgb = Object.fromEntries(Object.entries(CHANGES).map(([code, [, hex]]) => [code, ramp([hex, hex]).slice(0, 3)]));
  return spreadOut(cloud.change, (code, i) => {
    if (code) return rgb[code];
    const k = Math.round(255 * share(i));
    return greys.subarray(4 * k, 4 * k + 3);
  });
}

/** Height of each point, from 0 to 1 over the usual range. */
function heightOf(cloud) {
  const [low, high] = cloud.height;
  return (i) => clamp((cloud.low[2] + cloud.step[2] * (cloud.points[3 * i + 2] + 32768) - low) / (high - low), 0, 1);
}

/** Three bytes for each value. */
function spreadOut(values, rgbOf) {
  const bytes = new Uint8Array(3 * values.length);
  values.forEach((value, i) => bytes.set(rgbOf(value, i), 3 * i));
  return bytes;
}
