// What is drawn over the points of the map: ground truth, trajectory, loops, failed scans, the marked scan, scale and axes;
// of merged runs the trajectory of each, and the loops between them.
import { clamp } from "./numbers.mjs";
import { marked, scans } from "./scans.mjs";
import { sessions } from "./sessions.mjs";

export function drawOver(pen, view, axes) {
  const style = getComputedStyle(view.figure);
  const colour = (name) => style.getPropertyValue(`--${name}`).trim();
  pen.lineJoin = "round";
  pen.font = "12px system-ui, sans-serif";
  if (scans) drawWay(pen, view, colour);
  if (sessions) drawSessions(pen, view, colour);
  drawScale(pen, view, colour);
  drawAxes(pen, view, axes, colour);
}

/** A line through px in pairs, with a rim that sets it off from the points. */
export function stroke(pen, seen, colour, rim, width, dashes = []) {
  pen.beginPath();
  let isOn = false;
  let [lastX, lastY] = [NaN, NaN];
  for (let i = 0; i < seen.length; i += 2) {
    const [x, y] = [seen[i], seen[i + 1]];
    if (!Number.isFinite(x + y)) isOn = false;
    else if (!isOn) {
      pen.moveTo(x, y);
      [isOn, lastX, lastY] = [true, x, y];
    } else if (Math.abs(x - lastX) + Math.abs(y - lastY) > 0.7 || i === seen.length - 2) {
      pen.lineTo(x, y);
      [lastX, lastY] = [x, y];
    }
  }
  pen.setLineDash([]);
  if (rim) {
    [pen.strokeStyle, pen.lineWidth] = [rim, width + 2.5];
    pen.stroke();
  }
  pen.setLineDash(dashes);
  [pen.strokeStyle, pen.lineWidth] = [colour, width];
  pen.stroke();
  pen.setLineDash([]);
}

function drawWay(pen, view, colour) {
  const [paper, bad] = [colour("paper"), colour("bad")];
  if (scans.truth) stroke(pen, view.project(scans.truth), colour("truth"), paper, 1.5, [6, 4]);
  const way = view.project(scans.positions);
  view.way = way;
  stroke(pen, way, colour("c2"), paper, 2);
  for (const [a, b] of scans.loops) {
    stroke(pen, [way[2 * a], way[2 * a + 1], way[2 * b], way[2 * b + 1]], colour("c1"), paper, 2);
  }
  for (const k of scans.failed) {
    const [x, y] = [way[2 * k], way[2 * k + 1]];
    stroke(pen, [x - 4, y - 4, x + 4, y + 4, NaN, NaN, x + 4, y - 4, x - 4, y + 4], bad, paper, 2);
  }
  const last = scans.count - 1;
  const sign = (k, fill, draw) => {
    if (!Number.isFinite(way[2 * k] + way[2 * k + 1])) return;
    pen.beginPath();
    draw(way[2 * k], way[2 * k + 1]);
    [pen.fillStyle, pen.strokeStyle, pen.lineWidth] = [fill, paper, 1.5];
    pen.fill();
    pen.stroke();
  };
  sign(last, bad, (x, y) => pen.rect(x - 5, y - 5, 10, 10));
  sign(0, colour("c3"), (x, y) => pen.arc(x, y, 4.5, 0, 7));
  drawMarked(pen, view, sign, colour);
}

/** The marked scan: a disc, and where it looks. */
function drawMarked(pen, view, sign, colour) {
  const at = Array.from(scans.positions.subarray(3 * marked, 3 * marked + 3));
  const yaw = (scans.angles[3 * marked + 2] * Math.PI) / 180;
  const ahead = 28 * view.metres;
  const nose = view.project([...at, at[0] + ahead * Math.cos(yaw), at[1] + ahead * Math.sin(yaw), at[2]]);
  stroke(pen, nose, colour("ink"), colour("paper"), 2.5);
  sign(marked, colour("ink"), (x, y) => pen.arc(x, y, 7, 0, 7));
}

/** Merged runs: where each went, where they are tied, and the scan under the pointer. */
function drawSessions(pen, view, colour) {
  const paper = colour("paper");
  for (const session of sessions.sessions) {
    session.way = view.project(session.positions);
    stroke(pen, session.way, getComputedStyle(view.figure.querySelector(`.legend .${session.style}`)).color, paper, 2);
  }
  const ends = view.project(sessions.ties);
  for (let i = 0; i < ends.length; i += 4) stroke(pen, ends.subarray(i, i + 4), colour("ink"), null, 1);
  if (!view.pointed) return;
  const { session, k } = view.pointed;
  const [x, y] = [session.way[2 * k], session.way[2 * k + 1]];
  pen.beginPath();
  pen.arc(x, y, 6, 0, 7);
  [pen.fillStyle, pen.strokeStyle, pen.lineWidth] = [colour("ink"), paper, 1.5];
  pen.fill();
  pen.stroke();
  const text = `${session.name}, scan ${session.index[k]}`;
  label(pen, text, clamp(x, pen.measureText(text).width / 2 + 4, view.width - pen.measureText(text).width / 2 - 4), y - 12, colour);
}


/** A bar of a round length, which from above is true everywhere, in 3D at the centre. */
function drawScale(pen, view, colour) {
  const power = 10 ** Math.floor(Math.log10(120 * view.metres));
  const length = [1, 2, 5, 10].map((m) => m * power).filter((m) => m <= 120 * view.metres).pop();
  const width = length / view.metres;
  const text = `${length >= 1 ? length : length.toPrecision(1)} m`;
  const [x, y] = [14, view.height - 14];
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
  const [x, y] = [view.width - 44, view.height - 40];
  ["x", "y", "z"].forEach((name, k) => {
    const [dx, dy] = [right[k], -up[k]];
    if (Math.hypot(dx, dy) < 0.15) return;
    stroke(pen, [x, y, x + 24 * dx, y + 24 * dy], colour("ink"), colour("paper"), 1.5);
    label(pen, name, x + 33 * dx, y + 33 * dy + 4, colour);
  });
}
