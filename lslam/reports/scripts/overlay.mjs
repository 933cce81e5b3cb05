// What is drawn over the points of the map: ground truth, trajectory, loops, failed scans, the marked scan, scale and axes;
// of merged runs the trajectory of each, and the loops between them. Lines hide behind points in 3D, signs do not.
import { partsOf } from "./against_map.mjs";
import { clamp } from "./numbers.mjs";
import { marked, scans } from "./scans.mjs";
import { placesOf, sessions } from "./sessions.mjs";

const HIDDEN = 0.25; // opacity of a line behind points

/** Lines for the drawer, each with a rim below that sets it off from the points. */
export function linesOf(view, colour) {
  const found = [];
  const hidden = view.camera.isFlat ? 1 : HIDDEN;
  const add = (points, css, width, isPairs = false) => {
    found.push({ points, tint: tintOf(colour("paper")), width: width + 2.5, hidden: view.camera.isFlat ? 1 : 0, isPairs });
    found.push({ points, tint: tintOf(css), width, hidden, isPairs });
  };
  if (view.section) {
    if (view.section.line) add(view.section.line, colour("c2"), 2);
    return found;
  }
  if (scans) {
    if (scans.truth) add(scans.truth, colour("truth"), 1.5);
    for (const { style, points } of wayParts()) add(points, colour(style === "carried" ? "ink" : style.replace("s", "c")), 2);
    add(loopLines(), colour("c1"), 2, true);
  }
  if (sessions) {
    const style = (session) => getComputedStyle(view.figure.querySelector(`.legend .${session.style}`)).color;
    for (const session of sessions.sessions) if (!session.isHidden) add(placesOf(session), style(session), 2);
    if (!sessions.isBefore) add(sessions.ties, colour("ink"), 1, true);
  }
  for (const lines of view.liners) found.push(...lines(view, colour, add));
  return found;
}

let [loopEnds, parts] = [null, null];

/** The trajectory in one style, or of a drive in an old map in those of its states. */
function wayParts() {
  parts ||= scans.fixes ? partsOf(scans.positions, scans.fixes, scans.states) : [{ style: "s2", points: scans.positions }];
  return parts;
}

/** Both ends of each closed loop, x, y, z. */
function loopLines() {
  loopEnds ||= Float32Array.from(scans.loops.flat().flatMap((k) => [...scans.positions.subarray(3 * k, 3 * k + 3)]));
  return loopEnds;
}

/** Red, green, blue and opacity of a colour of the page, as shares. */
export function tintOf(css) {
  const hex = /^#(..)(..)(..)$/.exec(css);
  const parts = hex ? hex.slice(1).map((part) => parseInt(part, 16)) : css.match(/[\d.]+/g).map(Number);
  return [parts[0] / 255, parts[1] / 255, parts[2] / 255, 1];
}

export function drawOver(pen, view, colour) {
  pen.lineJoin = "round";
  pen.font = "12px system-ui, sans-serif";
  if (scans && !view.section) drawSigns(pen, view, colour);
  if (sessions && !view.section) drawPointed(pen, view, colour);
  drawScale(pen, view, colour);
  drawAxes(pen, view, view.camera.axes(), colour);
}

/** A line through px in pairs, with a rim that sets it off from the points. */
export function stroke(pen, seen, colour, rim, width) {
  pen.beginPath();
  let isOn = false;
  for (let i = 0; i < seen.length; i += 2) {
    const [x, y] = [seen[i], seen[i + 1]];
    if (!Number.isFinite(x + y)) isOn = false;
    else if (!isOn) {
      pen.moveTo(x, y);
      isOn = true;
    } else pen.lineTo(x, y);
  }
  if (rim) {
    [pen.strokeStyle, pen.lineWidth] = [rim, width + 2.5];
    pen.stroke();
  }
  [pen.strokeStyle, pen.lineWidth] = [colour, width];
  pen.stroke();
}

/** Ends of the trajectory, scans that failed, and the one that is marked: a disc, and where it looks. */
function drawSigns(pen, view, colour) {
  const [paper, bad] = [colour("paper"), colour("bad")];
  const way = view.project(scans.positions);
  view.way = way;
  for (const k of scans.failed) {
    const [x, y] = [way[2 * k], way[2 * k + 1]];
    stroke(pen, [x - 4, y - 4, x + 4, y + 4, NaN, NaN, x + 4, y - 4, x - 4, y + 4], bad, paper, 2);
  }
  const sign = (k, fill, draw) => {
    if (Number.isFinite(way[2 * k] + way[2 * k + 1])) filled(pen, fill, paper, () => draw(way[2 * k], way[2 * k + 1]));
  };
  sign(scans.count - 1, bad, (x, y) => pen.rect(x - 5, y - 5, 10, 10));
  sign(0, colour("c3"), (x, y) => pen.arc(x, y, 4.5, 0, 7));
  const at = Array.from(scans.positions.subarray(3 * marked, 3 * marked + 3));
  const yaw = (scans.angles[3 * marked + 2] * Math.PI) / 180;
  const ahead = 28 * view.camera.metres;
  const nose = view.project([...at, at[0] + ahead * Math.cos(yaw), at[1] + ahead * Math.sin(yaw), at[2]]);
  stroke(pen, nose, colour("ink"), paper, 2.5);
  sign(marked, colour("ink"), (x, y) => pen.arc(x, y, 7, 0, 7));
}

/** A shape that `draw` outlines, filled, with a rim. */
export function filled(pen, fill, rim, draw) {
  pen.beginPath();
  draw();
  [pen.fillStyle, pen.strokeStyle, pen.lineWidth] = [fill, rim, 1.5];
  pen.fill();
  pen.stroke();
}

/** Merged runs: the scan under the pointer. */
function drawPointed(pen, view, colour) {
  for (const session of sessions.sessions) {
    session.way = view.project(placesOf(session));
    if (session.isHidden) session.way.fill(NaN);
  }
  if (!view.pointed || view.pointed.session.isHidden) return;
  const { session, k } = view.pointed;
  const [x, y] = [session.way[2 * k], session.way[2 * k + 1]];
  filled(pen, colour("ink"), colour("paper"), () => pen.arc(x, y, 6, 0, 7));
  const text = `${session.name}, scan ${session.index[k]}`;
  const half = pen.measureText(text).width / 2 + 4;
  label(pen, text, clamp(x, half, view.camera.width - half), y - 12, colour);
}

/** A bar of a round length, which without perspective is true everywhere, in 3D at the centre. */
function drawScale(pen, { camera }, colour) {
  const power = 10 ** Math.floor(Math.log10(120 * camera.metres));
  const length = [1, 2, 5, 10].map((m) => m * power).filter((m) => m <= 120 * camera.metres).pop();
  const width = length / camera.metres;
  const text = `${length >= 1 ? length : length.toPrecision(1)} m`;
  const [x, y] = [14, camera.height - 14];
  stroke(pen, [x, y - 5, x, y, x + width, y, x + width, y - 5], colour("ink"), colour("paper"), 2);
  label(pen, text, x + width / 2, y - 7, colour);
}

export function label(pen, text, x, y, colour) {
  pen.textAlign = "center";
  [pen.strokeStyle, pen.lineWidth, pen.fillStyle] = [colour("paper"), 3, colour("ink")];
  pen.strokeText(text, x, y);
  pen.fillText(text, x, y);
}

function drawAxes(pen, view, { right, up }, colour) {
  const [x, y] = [view.camera.width - 44, view.camera.height - 40];
  (view.section ? ["along", "", "z"] : ["x", "y", "z"]).forEach((name, k) => {
    const [dx, dy] = [right[k], -up[k]];
    if (!name || Math.hypot(dx, dy) < 0.15) return;
    stroke(pen, [x, y, x + 24 * dx, y + 24 * dy], colour("ink"), colour("paper"), 1.5);
    label(pen, name, x + 33 * dx - (name.length > 1 ? 24 * dx : 0), y + 33 * dy + 4 + (name.length > 1 ? 14 : 0), colour);
  });
}
