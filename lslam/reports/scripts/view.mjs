// The map as points that turn, with the trajectory over them. Without WebGL the drawing of the page stays.
import { colourings } from "./colours.mjs";
import { KEYS, make, read } from "./elements.mjs";
import { gestures } from "./gestures.mjs";
import { clamp, nearestBy } from "./numbers.mjs";
import { drawOver } from "./overlay.mjs";
import { pointDrawer } from "./points.mjs";
import { mark, scans, watchers } from "./scans.mjs";
import { sessionAt, sessions } from "./sessions.mjs";

const LENS = 0.5; // tan of half the angle of view
const STEEPEST = 1.45; // rad from straight down

export class MapView {
  constructor(figure, cloud) {
    this.figure = figure;
    this.cloud = cloud;
    this.stage = figure.querySelector(".stage");
    [this.points, this.lines] = ["points", "lines"].map((name) => {
      const canvas = document.createElement("canvas");
      canvas.className = name;
      this.stage.append(canvas);
      return canvas;
    });
    this.drawer = pointDrawer(this.points, cloud);
    if (!this.drawer) {
      this.points.remove();
      this.lines.remove();
      return;
    }
    figure.classList.add("live");
    this.home = figure.dataset.extent.split(" ").map(Number);
    this.ground = (cloud.height[0] + cloud.height[1]) / 2;
    this.startTools();
    this.lines.setAttribute("role", "application");
    this.lines.setAttribute("aria-label", `${this.stage.querySelector("svg").getAttribute("aria-label")}, ${KEYS}; comma and full stop mark the scan before and after`);
    gestures(this.lines, {
      zoom: (factor, x, y) => this.zoom(factor, x, y),
      pan: (dx, dy, event) => this.move(dx, dy, event.shiftKey || event.buttons === 2),
      reset: () => this.reset(),
      hover: (x, y) => this.hover(x, y),
    });
    this.lines.addEventListener("contextmenu", (event) => event.preventDefault());
    this.colour("height");
    this.reset();
    watchers.push(() => this.draw());
    new ResizeObserver(() => this.fit()).observe(this.stage);
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.draw());
  }

  startTools() {
    const tools = this.figure.querySelector(".tools");
    const actions = {
      flat: () => this.turnTo(0, 0), turn: () => this.turnTo(0.6, 0.95), in: () => this.zoom(1.4), out: () => this.zoom(1 / 1.4), reset: () => this.reset(),
    };
    for (const button of tools.querySelectorAll("button")) button.addEventListener("click", actions[button.dataset.do]);
    for (const [name, style] of scans ? [["ground truth", scans.truth && "gt"], ["loop closed", scans.loops.length && "s1"]] : []) {
      if (style) this.explain(name, style);
    }
    if (sessions && sessions.tied) this.explain("loop between two of them", "");
    this.known = colourings(this.cloud);
    const select = tools.querySelector("select");
    for (const name of Object.keys(this.known)) select.add(new Option(name));
    select.addEventListener("change", () => this.colour(select.value));
    tools.hidden = false;
  }

  /** One more line of the legend: what the drawing underneath does not show. */
  explain(name, style) {
    const item = document.createElement("li");
    item.className = "only-live";
    const line = make("svg", { viewBox: "0 0 26 12", "aria-hidden": "true" }, item);
    make("path", { class: `line ${style}`, d: "M0 6H26" }, line);
    item.append(name);
    this.figure.querySelector(".legend").append(item);
  }

  colour(name) {
    const { said, range, shades } = this.known[name];
    const ramp = this.figure.querySelector(".ramp");
    [ramp.querySelector(".low").textContent, ramp.querySelector(".high").textContent] = range;
    ramp.querySelector(".said").textContent = said;
    this.drawer.shade(shades());
    this.draw();
  }

  /** The whole map, as it is turned. */
  reset() {
    const [x0, x1, y0, y1] = this.home;
    this.centre = [(x0 + x1) / 2, (y0 + y1) / 2, this.ground];
    this.metres = null;
    this.turnTo(this.yaw || 0, this.tilt || 0);
  }

  turnTo(yaw, tilt) {
    [this.yaw, this.tilt] = [yaw, tilt];
    for (const button of this.figure.querySelectorAll("[aria-pressed]")) {
      button.setAttribute("aria-pressed", String((button.dataset.do === "turn") === tilt > 0));
    }
    this.fit();
  }

  fit() {
    const [width, height] = [this.stage.clientWidth, this.stage.clientHeight];
    if (!width || !height) return;
    const [x0, x1, y0, y1] = this.home;
    this.widest = 1.04 * Math.max((x1 - x0) / width, (y1 - y0) / height);
    this.metres = this.metres || this.widest; // of a CSS px
    this.ratio = devicePixelRatio || 1;
    for (const canvas of [this.points, this.lines]) [canvas.width, canvas.height] = [width * this.ratio, height * this.ratio];
    [this.width, this.height] = [width, height];
    this.draw();
  }

  zoom(factor, x = this.width / 2, y = this.height / 2) {
    const before = this.metres;
    this.metres = clamp(before / factor, this.widest / 2000, 3 * this.widest);
    this.shift((x - this.width / 2) * (before - this.metres), (this.height / 2 - y) * (before - this.metres));
    this.draw();
  }

  /** Move the centre along the ground: so many m to the right and away from the viewer, as seen. */
  shift(right, up) {
    const away = up / Math.max(Math.cos(this.tilt), 0.2);
    this.centre[0] += Math.cos(this.yaw) * right - Math.sin(this.yaw) * away;
    this.centre[1] += Math.sin(this.yaw) * right + Math.cos(this.yaw) * away;
  }

  move(dx, dy, isShift) {
    if (this.tilt > 0 && !isShift) {
      this.yaw += 0.006 * dx;
      this.tilt = clamp(this.tilt - 0.006 * dy, 0.05, STEEPEST);
    } else this.shift(-dx * this.metres, dy * this.metres);
    this.draw();
  }

  /** Axes of the view in the world, and how far the viewer is from the centre, m. */
  axes() {
    const [c, s, ct, st] = [Math.cos(this.yaw), Math.sin(this.yaw), Math.cos(this.tilt), Math.sin(this.tilt)];
    return { right: [c, s, 0], up: [-s * ct, c * ct, st], back: [s * st, -c * st, ct], away: (this.height * this.metres) / 2 / LENS };
  }

  /** Column by column: points less the centre to clip coordinates; from above without perspective. */
  matrix({ right, up, back, away }) {
    const [a, b] = [2 / (this.width * this.metres), 2 / (this.height * this.metres)];
    const reach = Math.hypot(...this.cloud.step.map((step) => 65535 * step)) + Math.hypot(...this.centre.map((value, k) => value - this.cloud.low[k]));
    const perspective = this.tilt > 0 ? 1 / away : 0;
    const [near, far] = [0.02 * away, away + reach];
    const [depth, rest] = perspective ? [-(far + near) / (far - near) / away, (far + near) / (far - near) - (2 * far * near) / (far - near) / away] : [-1 / reach, 0];
    const column = (k) => [a * right[k], b * up[k], depth * back[k], -perspective * back[k]];
    return new Float32Array([...column(0), ...column(1), ...column(2), 0, 0, rest, 1]);
  }

  /** Where points (x, y, z, x, y, ...) are seen: px, in pairs, NaN behind the viewer. */
  project(points) {
    const { right, up, back, away } = this.axes();
    const seen = new Float32Array((points.length / 3) * 2);
    for (let i = 0; i < points.length / 3; i += 1) {
      const d = [points[3 * i] - this.centre[0], points[3 * i + 1] - this.centre[1], points[3 * i + 2] - this.centre[2]];
      const along = (axis) => axis[0] * d[0] + axis[1] * d[1] + axis[2] * d[2];
      const w = this.tilt > 0 ? 1 - along(back) / away : 1;
      const share = w > 0.02 ? 1 / (w * this.metres) : NaN;
      seen[2 * i] = this.width / 2 + along(right) * share;
      seen[2 * i + 1] = this.height / 2 - along(up) * share;
    }
    return seen;
  }

  draw() {
    if (!this.width || !this.metres) return;
    const axes = this.axes();
    const size = Math.max(this.figure.dataset.voxel / this.metres, 1.3) * this.ratio;
    this.drawer.draw(this.matrix(axes), this.centre, size);
    const pen = this.lines.getContext("2d");
    pen.setTransform(this.ratio, 0, 0, this.ratio, 0, 0);
    pen.clearRect(0, 0, this.width, this.height);
    drawOver(pen, this, axes);
  }

  hover(x, y) {
    if (sessions) {
      this.pointed = sessionAt(x, y);
      this.draw();
    }
    if (!this.way) return;
    const away = Float32Array.from({ length: scans.count }, (_, k) => Math.hypot(this.way[2 * k] - x, this.way[2 * k + 1] - y));
    const k = nearestBy(away, 0);
    if (k >= 0 && away[k] < 30) mark(k);
  }
}

const cloudOfMap = read("cloud");
export const mapView = cloudOfMap && new MapView(document.getElementById("map"), cloudOfMap);
