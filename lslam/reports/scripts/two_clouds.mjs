// Two scans on each other, in two colours, as odometry has them or as registration does.
import { cloudOf, coordinates } from "./clouds.mjs";
import { gestures } from "./gestures.mjs";
import { clamp } from "./numbers.mjs";

const SIDE = 1.35; // rad from straight down

/** Points moved by the rows (3, 4) of a transform. */
export function moved(points, rows) {
  const out = new Float32Array(points.length);
  for (let i = 0; i < points.length; i += 3) {
    for (let k = 0; k < 3; k += 1) out[i + k] = rows[k][0] * points[i] + rows[k][1] * points[i + 1] + rows[k][2] * points[i + 2] + rows[k][3];
  }
  return out;
}

export class TwoClouds {
  /** onSwitch(isAfter) : told which of both is seen */
  constructor(canvas, onSwitch) {
    [this.canvas, this.onSwitch] = [canvas, onSwitch];
    [this.yaw, this.tilt, this.isAfter] = [0, 0, true];
    gestures(canvas, {
      zoom: (factor) => this.zoom(factor),
      pan: (dx, dy) => this.pan(dx, dy),
      reset: () => this.reset(),
      step: () => this.switch(!this.isAfter),
    });
    new ResizeObserver(() => this.draw()).observe(canvas);
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.draw());
  }

  /** Show a pair of clouds, or nothing. */
  show(pair) {
    this.clouds = pair && {
      a: coordinates(cloudOf(pair.a)),
      b: [pair.before, pair.after || pair.before].map((rows) => moved(coordinates(cloudOf(pair.b)), rows)),
    };
    this.reset();
  }

  switch(isAfter) {
    this.isAfter = isAfter;
    this.onSwitch(isAfter);
    this.draw();
  }

  /** From above, or from the side. */
  turnTo(isSide) {
    [this.yaw, this.tilt] = [0, isSide ? SIDE : 0];
    this.reset();
  }

  reset() {
    this.centre = [0, 0, 0];
    const away = this.clouds ? Float32Array.from({ length: this.clouds.a.length / 3 }, (_, i) => Math.hypot(this.clouds.a[3 * i], this.clouds.a[3 * i + 1])).sort() : [];
    this.reach = Math.max(away[Math.floor(0.95 * (away.length - 1))] || 0, 5);
    this.closer = 1;
    this.draw();
  }

  zoom(factor) {
    this.closer = clamp(this.closer * factor, 0.3, 100);
    this.draw();
  }

  pan(dx, dy) {
    if (this.tilt > 0) {
      this.yaw += 0.006 * dx;
      this.tilt = clamp(this.tilt - 0.006 * dy, 0.05, Math.PI / 2);
    } else {
      this.centre[0] -= dx * this.metres;
      this.centre[1] += dy * this.metres;
    }
    this.draw();
  }

  draw() {
    const ratio = devicePixelRatio || 1;
    const [width, height] = [this.canvas.clientWidth, this.canvas.clientHeight].map((size) => Math.round(size * ratio));
    if (!width || !height) return;
    [this.canvas.width, this.canvas.height] = [width, height];
    if (!this.clouds) return;
    this.metres = (2 * this.reach) / this.closer / Math.min(this.canvas.clientWidth, this.canvas.clientHeight);
    const pen = this.canvas.getContext("2d");
    const style = getComputedStyle(this.canvas);
    const size = Math.max(1.6 * ratio, 0.12 / this.metres);
    for (const [points, colour] of [[this.clouds.a, "--c1"], [this.clouds.b[Number(this.isAfter)], "--c2"]]) {
      pen.fillStyle = style.getPropertyValue(colour).trim();
      pen.globalAlpha = 0.8;
      this.put(pen, points, width, height, ratio / this.metres, size);
    }
  }

  put(pen, points, width, height, scale, size) {
    const [c, s, ct, st] = [Math.cos(this.yaw), Math.sin(this.yaw), Math.cos(this.tilt), Math.sin(this.tilt)];
    for (let i = 0; i < points.length; i += 3) {
      const [x, y, z] = [points[i] - this.centre[0], points[i + 1] - this.centre[1], points[i + 2] - this.centre[2]];
      const right = width / 2 + scale * (c * x + s * y);
      const down = height / 2 - scale * (ct * (c * y - s * x) + st * z);
      pen.fillRect(right, down, size, size);
    }
  }
}
