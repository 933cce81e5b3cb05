// Charts that zoom and pan, and show the marked scan. A chart is an SVG with `data-view`: limits and places of its axes.
import { make } from "./elements.mjs";
import { gestures } from "./gestures.mjs";
import { clamp, nearestBy, number, ticks } from "./numbers.mjs";
import { mark, marked, scans, watchers } from "./scans.mjs";

export class Chart {
  constructor(svg, id) {
    this.svg = svg;
    const [x0, x1, y0, y1, left, right, top, bottom] = svg.dataset.view.split(" ").map(Number);
    this.full = [x0, x1, y0, y1];
    this.view = [...this.full];
    this.box = { left, right, top, bottom };
    this.isPlane = svg.classList.contains("plane");
    this.places = scans && scans.by[svg.dataset.by];
    this.data = svg.querySelector("g.data");
    this.grid = svg.querySelector("g.ticks");
    this.drawn = this.grid.innerHTML;
    const clip = make("clipPath", { id }, svg);
    make("rect", { x: left, y: top, width: right - left, height: bottom - top }, clip);
    this.layer = make("g", { "clip-path": `url(#${id})` });
    svg.insertBefore(this.layer, this.data);
    this.layer.append(this.data);
    this.cursor = this.places && make(this.isPlane ? "circle" : "path", { class: "cursor", r: 6, visibility: "hidden" }, this.layer);
    this.here = make("text", { class: "tick here", x: right, y: 14, "text-anchor": "end" }, svg);
    // What keeps its size, about its middle or where its text begins.
    this.signs = [...this.data.querySelectorAll("circle, rect.dot, .cross, text")].map((sign) => {
      if (sign.tagName === "text") return [sign, Number(sign.getAttribute("x")), Number(sign.getAttribute("y"))];
      const { x, y, width, height } = sign.getBBox();
      return [sign, x + width / 2, y + height / 2];
    });
    svg.setAttribute("aria-roledescription", "chart that zooms");
    svg.setAttribute("aria-keyshortcuts", "+ - 0 ArrowLeft ArrowRight ArrowUp ArrowDown , .");
    gestures(svg, {
      zoom: (factor, x, y, event) => this.zoom(factor, this.at(x, y), event.shiftKey),
      pan: (dx, dy) => this.pan(dx, dy),
      reset: () => this.show([...this.full]),
      hover: (x, y) => this.hover(...this.at(x, y)),
    });
    svg.addEventListener("pointerleave", () => { this.here.textContent = ""; });
    if (this.places) watchers.push((k) => this.mark(k));
  }

  /** Units of the SVG per px of the screen. */
  get scale() {
    return 1 / this.svg.getScreenCTM().a;
  }

  /** Data at px of the element. */
  at(x, y) {
    const [x0, x1, y0, y1] = this.view;
    const { left, right, top, bottom } = this.box;
    const [corner, placed] = [this.svg.getBoundingClientRect(), this.svg.getScreenCTM()];
    const [u, v] = [(x + corner.left - placed.e) / placed.a, (y + corner.top - placed.f) / placed.d];
    return [x0 + ((u - left) / (right - left)) * (x1 - x0), y0 + ((bottom - v) / (bottom - top)) * (y1 - y0)];
  }

  px(x) {
    return this.box.left + ((x - this.view[0]) / (this.view[1] - this.view[0])) * (this.box.right - this.box.left);
  }

  py(y) {
    return this.box.bottom - ((y - this.view[2]) / (this.view[3] - this.view[2])) * (this.box.bottom - this.box.top);
  }

  /** About (x, y); of a chart the abscissa alone, unless `both`. */
  zoom(factor, [x, y], both) {
    const [x0, x1, y0, y1] = this.view;
    const scaled = (low, high, about) => [about + (low - about) / factor, about + (high - about) / factor];
    this.show([...scaled(x0, x1, x), ...(this.isPlane || both ? scaled(y0, y1, y) : [y0, y1])]);
  }

  pan(dx, dy) {
    const [x0, x1, y0, y1] = this.view;
    const right = (-dx * this.scale * (x1 - x0)) / (this.box.right - this.box.left);
    const up = (dy * this.scale * (y1 - y0)) / (this.box.bottom - this.box.top);
    this.show([x0 + right, x1 + right, y0 + up, y1 + up]);
  }

  /** These limits, moved and bounded so that they lie within those of the whole chart. */
  show(limits) {
    for (const axis of [0, 2]) {
      const [low, high] = [this.full[axis], this.full[axis + 1]];
      const size = clamp(limits[axis + 1] - limits[axis], 1e-4 * (high - low), high - low);
      const from = clamp((limits[axis] + limits[axis + 1] - size) / 2, low, high - size);
      [this.view[axis], this.view[axis + 1]] = [from, from + size];
    }
    const { left, right, top, bottom } = this.box;
    const [x0, x1, y0, y1] = this.full;
    const kx = (x1 - x0) / (this.view[1] - this.view[0]);
    const ky = (y1 - y0) / (this.view[3] - this.view[2]);
    this.data.setAttribute("transform", `matrix(${kx} 0 0 ${ky} ${this.px(x0) - kx * left} ${this.py(y0) - ky * bottom})`);
    for (const [sign, x, y] of this.signs) sign.setAttribute("transform", `translate(${x} ${y}) scale(${1 / kx} ${1 / ky}) translate(${-x} ${-y})`);
    const isWhole = kx * ky < 1 + 1e-9;
    this.svg.classList.toggle("moved", !isWhole);
    if (isWhole) this.grid.innerHTML = this.drawn;
    else this.drawGrid(left, right, top, bottom);
    if (this.places) this.mark(marked);
  }

  drawGrid(left, right, top, bottom) {
    const [x0, x1, y0, y1] = this.view;
    this.grid.replaceChildren();
    for (const value of ticks(x0, x1, Math.max(2, Math.round((right - left) / 75)))) {
      make("path", { class: "grid", d: `M${this.px(value)} ${top}V${bottom}` }, this.grid);
      make("text", { class: "tick", x: this.px(value), y: bottom + 16, "text-anchor": "middle" }, this.grid).textContent = number(value, x1 - x0);
    }
    for (const value of ticks(y0, y1, Math.max(2, Math.round((bottom - top) / 50)))) {
      make("path", { class: "grid", d: `M${left} ${this.py(value)}H${right}` }, this.grid);
      make("text", { class: "tick", x: left - 6, y: this.py(value) + 4, "text-anchor": "end" }, this.grid).textContent = number(value, y1 - y0);
    }
  }

  hover(x, y) {
    const [x0, x1, y0, y1] = this.view;
    const isInside = x >= x0 && x <= x1 && y >= y0 && y <= y1;
    this.here.textContent = isInside ? `${number(x, (x1 - x0) / 10)}, ${number(y, (y1 - y0) / 10)}` : "";
    if (!isInside || !this.places) return;
    if (!this.isPlane) return mark(nearestBy(this.places, x));
    const [xs, ys] = this.places;
    const reach = (30 * this.scale * (x1 - x0)) / (this.box.right - this.box.left);
    const away = xs.map((value, k) => Math.hypot(value - x, ys[k] - y));
    const k = nearestBy(away, 0);
    if (k >= 0 && away[k] < reach) mark(k);
  }

  mark(k) {
    const [x, y] = this.isPlane ? [this.places[0][k], this.places[1][k]] : [this.places[k], this.view[2]];
    const isSeen = Number.isFinite(x + y);
    this.cursor.setAttribute("visibility", isSeen ? "visible" : "hidden");
    if (!isSeen) return;
    if (this.isPlane) {
      this.cursor.setAttribute("cx", this.px(x));
      this.cursor.setAttribute("cy", this.py(y));
    } else this.cursor.setAttribute("d", `M${this.px(x)} ${this.box.top}V${this.box.bottom}`);
  }
}

export function startCharts() {
  document.querySelectorAll("svg[data-view]").forEach((svg, i) => {
    if (!svg.closest(".live")) new Chart(svg, `clip-${i}`);
  });
}
