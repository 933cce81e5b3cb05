// The map as points that turn, with the trajectory over them. Without WebGL 2 the drawing of the page stays.
import { Camera } from "./camera.mjs";
import { kindsOf } from "./categories.mjs";
import { cloudOf, coordinates } from "./clouds.mjs";
import { BY, colourings, percentile } from "./colours.mjs";
import { KEYS, make, read } from "./elements.mjs";
import { gestures } from "./gestures.mjs";
import { clamp, nearestBy } from "./numbers.mjs";
import { drawOver, linesOf } from "./overlay.mjs";
import { PointDrawer } from "./points.mjs";
import { mark, scans, watchers } from "./scans.mjs";
import { sessionAt, sessions } from "./sessions.mjs";

const SHADING = 8; // of edges by depth, in 3D
const REST_MS = 150; // without a gesture until more points are drawn
const WIDE = 2; // of the distance between points that a point covers
const LEAST_PX = 1.5; // of a point
const FRAME_MS = 70; // of a frame, by drawing fewer points
const FIRST = 200_000; // points of the first one

export class MapView {
  constructor(figure, data) {
    this.figure = figure;
    this.stage = figure.querySelector(".stage");
    [this.canvas, this.lines] = ["points", "lines"].map((name) => {
      const canvas = document.createElement("canvas");
      canvas.className = name;
      this.stage.append(canvas);
      return canvas;
    });
    this.drawer = PointDrawer.on(this.canvas, data.colours);
    if (!this.drawer) {
      this.canvas.remove();
      this.lines.remove();
      return;
    }
    figure.classList.add("live");
    this.canvas.addEventListener("webglcontextlost", () => this.giveUp());
    this.cloud = cloudOf(data, scans ? scans.count : 0);
    this.drawer.add("map", this.cloud);
    this.spacing = data.spacing; // m between the points that are drawn
    this.names = ["map"]; // clouds that are drawn
    this.known = this.waysOf(this.cloud);
    this.camera = new Camera();
    [this.size, this.isShaded, this.share] = [1, true, Math.min(1, FIRST / this.cloud.count)];
    [this.painters, this.liners, this.leavers] = [[], [], []];
    [this.drawn, this.movedAt, this.last] = [0, -Infinity, 0];
    this.onClick = null; // of a tool that takes clicks
    this.home = figure.dataset.extent.split(" ").map(Number);
    this.ground = (data.height[0] + data.height[1]) / 2;
    this.startLegend();
    this.lines.setAttribute("role", "application");
    this.lines.setAttribute("aria-label", `${this.stage.querySelector("svg").getAttribute("aria-label")}, ${KEYS}; comma and full stop mark the scan before and after`);
    gestures(this.lines, {
      zoom: (factor, x, y) => this.zoom(factor, x, y),
      pan: (dx, dy, event) => this.move(dx, dy, event.shiftKey || event.buttons === 2),
      reset: () => this.reset(),
      hover: (x, y) => this.hover(x, y),
      click: (x, y) => this.onClick?.(x, y),
    });
    this.lines.addEventListener("contextmenu", (event) => event.preventDefault());
    this.colour(Object.keys(this.known)[0]);
    this.reset();
    watchers.push(() => this.drawSigns());
    new ResizeObserver(() => this.fit()).observe(this.stage);
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.draw());
  }

  /** The graphics unit was taken away: the drawing of the page comes back. */
  giveUp() {
    this.isFitted = false;
    this.figure.classList.remove("live");
    this.figure.querySelector(".tools").hidden = true;
    this.canvas.remove();
    this.lines.remove();
  }

  startLegend() {
    for (const [name, style] of scans ? [["ground truth", scans.truth && "gt"], ["loop closed", scans.loops.length && "s1"]] : []) {
      if (style) this.explain(name, style);
    }
    if (sessions && sessions.tied) this.explain("loop between two of them", "");
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

  /** Ways to colour the points of a cloud of the map, by name. */
  waysOf(cloud) {
    const colourOf = ({ style }) => getComputedStyle(this.figure.querySelector(`.legend .${style}`)).color;
    return { ...kindsOf(cloud, sessions?.sessions, colourOf), ...colourings(cloud, scans) };
  }

  /** Colour the points by one of the ways that are known, over its usual range. */
  colour(name) {
    this.way_of_colour = name;
    const { bytes, by, usual } = this.known[name];
    if (bytes) this.drawer.recolour("map", by === BY.rgb ? "rgb" : "value", bytes);
    this.spread(...(usual || [0, 100]));
  }

  /** Spread the colours from the one percentile to the other. */
  spread(from, to) {
    const { by, ordered, text, said, kinds } = this.known[this.way_of_colour];
    this.percentiles = [from, to];
    this.by = by;
    const [low, high] = ordered ? [percentile(ordered, from), percentile(ordered, to)] : [0, 1];
    this.range = [low, Math.max(high, low + 1e-6)];
    this.say(text ? this.range.map(text) : null, said, kinds);
    this.draw();
  }

  /** What the colours mean, beside the palette. */
  say(ends, said, kinds = []) {
    const ramp = this.figure.querySelector(".ramp");
    if (!ramp) return;
    [ramp.querySelector(".low").textContent, ramp.querySelector(".high").textContent] = ends || ["", ""];
    ramp.querySelector("i").hidden = !ends;
    ramp.querySelector(".said").replaceChildren(said, ...kinds.flatMap(([name, colour]) => {
      const swatch = document.createElement("b");
      swatch.className = "swatch";
      swatch.style.color = `#${colour}`;
      return [" ", swatch, name];
    }));
  }

  /** The whole map, as it is turned; of a section the whole of it. */
  reset() {
    const [x0, x1, y0, y1] = this.home;
    this.camera.centre = [(x0 + x1) / 2, (y0 + y1) / 2, this.ground];
    this.isWhole = true;
    if (this.section) this.fit();
    else this.turnTo(this.camera.yaw, this.camera.tilt);
  }

  turnTo(yaw, tilt) {
    if (this.section) this.leaveSection();
    Object.assign(this.camera, { yaw, tilt, isFlat: tilt === 0 });
    this.press(tilt > 0 ? "turn" : "flat");
    this.fit();
  }

  /** Show which of the two views it is; neither in a section. */
  press(which) {
    for (const name of ["flat", "turn"]) this.figure.querySelector(`[data-do=${name}]`).setAttribute("aria-pressed", String(name === which));
  }

  /** Show a cloud of its own, (along, to the left, z), and a line in it, from the side; `sides` x0, x1, z0, z1 of it, m. */
  showSection(cloud, line, sides) {
    const { yaw, tilt } = this.camera;
    const before = this.section?.before || { yaw, tilt, centre: [...this.camera.centre], metres: this.camera.metres, home: this.home, ground: this.ground, isFlat: this.camera.isFlat };
    this.section = { cloud, line, before };
    const [x0, x1, z0, z1] = sides;
    this.drawer.add("section", cloud);
    this.names = ["section"];
    this.home = [x0, x1, 0, 0];
    this.sides = sides;
    this.ground = (z0 + z1) / 2;
    Object.assign(this.camera, { yaw: 0, tilt: Math.PI / 2, isFlat: true });
    this.press("");
    this.reset();
  }

  leaveSection() {
    const { home, ground, ...camera } = this.section.before;
    this.section = null;
    [this.names, this.home, this.ground] = [["map"], home, ground];
    this.drawer.remove("section");
    Object.assign(this.camera, camera);
    this.press(camera.isFlat ? "flat" : "turn");
    for (const leave of this.leavers) leave();
    this.fit();
  }

  fit() {
    const [width, height] = [this.stage.clientWidth, this.stage.clientHeight];
    if (!width || !height || !this.canvas.isConnected) return;
    this.camera.fit(width, height, this.section ? this.sides : this.home);
    if (this.isWhole) this.camera.metres = this.camera.widest;
    this.isWhole = false;
    this.ratio = devicePixelRatio || 1;
    for (const canvas of [this.canvas, this.lines]) [canvas.width, canvas.height] = [width * this.ratio, height * this.ratio];
    this.isFitted = true;
    this.draw();
  }

  zoom(factor, x = this.camera.width / 2, y = this.camera.height / 2) {
    this.camera.zoom(factor, x, y);
    this.moved();
  }

  move(dx, dy, isShift) {
    if (this.camera.isFlat || isShift) this.camera.shift(-dx * this.camera.metres, dy * this.camera.metres);
    else this.camera.turn(dx, dy);
    this.moved();
  }

  moved() {
    this.movedAt = performance.now();
    this.draw();
  }

  /**
   * The map anew, as it is now: as many points as keep it moving, then more of them in each frame until all are drawn.
   * Shading waits for the last of them, unless all are drawn at once.
   */
  draw() {
    this.drawn = 0;
    this.soon();
  }

  soon() {
    if (this.isDue || !this.isFitted) return;
    this.isDue = true;
    const frame = (now) => {
      // What was asked of the graphics unit before must be done: it takes what it is given, and falls behind.
      if (!this.drawer.isDone()) {
        requestAnimationFrame(frame);
        return;
      }
      this.isDue = false;
      if (this.last) this.share = clamp(this.share * clamp(FRAME_MS / (now - this.last), 0.3, 1.5), 0.02, 1);
      this.paint();
      const isMoving = now - this.movedAt < REST_MS;
      this.last = this.drawn < 1 || isMoving ? now : 0;
      if (this.drawn < 1 && isMoving) setTimeout(() => this.soon(), REST_MS);
      else if (this.drawn < 1) this.soon();
    };
    requestAnimationFrame(frame);
  }

  paint() {
    const { camera, ratio } = this;
    const colour = this.colourOf();
    const reach = Math.hypot(...[0, 1, 2].map((k) => 65535 * this.cloud.step[k] + Math.abs(camera.centre[k] - this.cloud.low[k])));
    const [from, to] = [this.drawn, Math.min(1, this.drawn + this.share)];
    const isWhole = to === 1;
    this.drawer.draw({
      view: camera.matrix(reach), centre: camera.centre, by: this.by, range: this.range, ratio, names: this.names, from, to,
      size: Math.max((WIDE * (this.section ? this.cloud.spacing : this.spacing)) / camera.metres, LEAST_PX) * this.size * ratio, least: LEAST_PX * Math.min(this.size, 1) * ratio,
      strength: isWhole && this.isShaded && !(camera.isFlat && !this.section) ? SHADING : 0, lines: linesOf(this, colour),
    });
    this.drawn = to;
    this.drawSigns();
  }

  /** What lies over points and lines: it changes with the pointer. */
  drawSigns() {
    if (!this.isFitted) return;
    const [{ camera, ratio }, colour] = [this, this.colourOf()];
    const pen = this.lines.getContext("2d");
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    pen.clearRect(0, 0, camera.width, camera.height);
    drawOver(pen, this, colour);
    for (const paint of this.painters) paint(pen, this, colour);
  }

  /** Colours of the page by name. */
  colourOf() {
    const style = getComputedStyle(this.figure);
    return (name) => style.getPropertyValue(`--${name}`).trim();
  }

  project(points) {
    return this.camera.project(points);
  }

  /** The point that is seen at px, of all clouds that are drawn: [x, y, z], m; null without one. */
  pick(x, y) {
    const { back } = this.camera.axes();
    const toViewer = (point) => back[0] * point[0] + back[1] * point[1] + back[2] * point[2];
    let best = null;
    for (const name of this.names) {
      const { cloud } = this.drawer.clouds.get(name);
      cloud.places ||= coordinates(cloud);
      const i = this.camera.pick(cloud.places, x, y);
      const point = i < 0 ? null : Array.from(cloud.places.subarray(3 * i, 3 * i + 3));
      if (point && (!best || toViewer(point) > toViewer(best))) best = point;
    }
    return best;
  }

  /** From now on clicks go to `act(x, y)` of `tool`; the tool that had them before is stopped. */
  take(tool, act) {
    const before = this.tool;
    [this.tool, this.onClick] = [tool, act];
    if (before && before !== tool) before.stop();
  }

  get shown() {
    return this.section ? this.section.cloud : this.cloud;
  }

  hover(x, y) {
    if (sessions) {
      this.pointed = sessionAt(x, y);
      this.drawSigns();
    }
    if (!this.way || this.section) return;
    const away = Float32Array.from({ length: scans.count }, (_, k) => Math.hypot(this.way[2 * k] - x, this.way[2 * k + 1] - y));
    const k = nearestBy(away, 0);
    if (k >= 0 && away[k] < 30) mark(k);
  }
}

const cloudOfMap = read("cloud");
export const mapView = cloudOfMap && new MapView(document.getElementById("map"), cloudOfMap);
