// The camera of the map: it turns about a centre, and looks straight down, in perspective, or straight at a section.
import { clamp } from "./numbers.mjs";

const LENS = 0.5; // tan of half the angle of view
const STEEPEST = 1.45; // rad from straight down
const NEAR = 0.02; // of the distance to the centre

/** metres: of a CSS px at the centre; yaw, tilt: rad, tilt from straight down; isFlat: parallel rays, no perspective. */
export class Camera {
  constructor() {
    [this.centre, this.yaw, this.tilt, this.metres, this.isFlat] = [[0, 0, 0], 0, 0, 1, true];
    [this.width, this.height, this.widest] = [1, 1, 1];
  }

  /** A canvas of this size, px; all of extent x0, x1, y0, y1 (m, on the screen's axes) can be seen. */
  fit(width, height, [x0, x1, y0, y1]) {
    [this.width, this.height] = [width, height];
    this.widest = 1.04 * Math.max((x1 - x0) / width, (y1 - y0) / height);
  }

  /** Axes of the view in the world, and how far the viewer is from the centre, m. */
  axes() {
    const [c, s, ct, st] = [Math.cos(this.yaw), Math.sin(this.yaw), Math.cos(this.tilt), Math.sin(this.tilt)];
    return { right: [c, s, 0], up: [-s * ct, c * ct, st], back: [s * st, -c * st, ct], away: (this.height * this.metres) / 2 / LENS };
  }

  /**
   * `M`, column by column: points less the centre to clip coordinates, of a scene that reaches `reach` m from the centre;
   * `depth`, `rest`, `perspective`: depth of the screen to m towards the viewer, as (ndc − rest) / (depth + perspective ndc).
   */
  matrix(reach) {
    const { right, up, back, away } = this.axes();
    const [a, b] = [2 / (this.width * this.metres), 2 / (this.height * this.metres)];
    const perspective = this.isFlat ? 0 : 1 / away;
    const [near, far] = [NEAR * away, away + reach];
    const [depth, rest] = this.isFlat ? [-1 / reach, 0] : [-(far + near) / (far - near) / away, (far + near) / (far - near) - (2 * far * near) / (far - near) / away];
    const column = (k) => [a * right[k], b * up[k], depth * back[k], -perspective * back[k]];
    return { M: new Float32Array([...column(0), ...column(1), ...column(2), 0, 0, rest, 1]), depth, rest, perspective, away };
  }

  /** Where points (x, y, z, x, y, ...) are seen: px, in pairs, NaN behind the viewer; with `depths` also m behind the centre. */
  project(points, depths = null) {
    const { right, up, back, away } = this.axes();
    const [cx, cy, cz] = this.centre;
    const seen = new Float32Array((points.length / 3) * 2);
    for (let i = 0; i < points.length / 3; i += 1) {
      const [x, y, z] = [points[3 * i] - cx, points[3 * i + 1] - cy, points[3 * i + 2] - cz];
      const behind = -(back[0] * x + back[1] * y + back[2] * z);
      const w = this.isFlat ? 1 : 1 + behind / away;
      const share = w > NEAR ? 1 / (w * this.metres) : NaN;
      seen[2 * i] = this.width / 2 + (right[0] * x + right[1] * y + right[2] * z) * share;
      seen[2 * i + 1] = this.height / 2 - (up[0] * x + up[1] * y + up[2] * z) * share;
      if (depths) depths[i] = behind;
    }
    return seen;
  }

  /** Index of the point seen within `radius` px of (x, y) that is nearest to the viewer; −1 without one. */
  pick(points, x, y, radius = 6) {
    const depths = new Float32Array(points.length / 3);
    const seen = this.project(points, depths);
    let [found, least] = [-1, Infinity];
    for (let i = 0; i < depths.length; i += 1) {
      if (depths[i] >= least || Math.hypot(seen[2 * i] - x, seen[2 * i + 1] - y) > radius) continue;
      [found, least] = [i, depths[i]];
    }
    return found;
  }

  zoom(factor, x, y) {
    const before = this.metres;
    this.metres = clamp(before / factor, this.widest / 2000, 3 * this.widest);
    this.shift((x - this.width / 2) * (before - this.metres), (this.height / 2 - y) * (before - this.metres));
  }

  /** Move the centre: so many m to the right and up, as seen; along the ground, except where the view is level. */
  shift(right, up) {
    const isLevel = this.isFlat && this.tilt > 1;
    const away = isLevel ? 0 : up / Math.max(Math.cos(this.tilt), 0.2);
    this.centre[0] += Math.cos(this.yaw) * right - Math.sin(this.yaw) * away;
    this.centre[1] += Math.sin(this.yaw) * right + Math.cos(this.yaw) * away;
    if (isLevel) this.centre[2] += up;
  }

  /** Turn by a drag of so many px. */
  turn(dx, dy) {
    this.yaw += 0.006 * dx;
    this.tilt = clamp(this.tilt - 0.006 * dy, 0.05, STEEPEST);
  }
}
