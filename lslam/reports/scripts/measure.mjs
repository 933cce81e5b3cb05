// Measuring on the map: two clicks, and how far it is between them.
import { fixed } from "./numbers.mjs";
import { filled, label, stroke } from "./overlay.mjs";

/** From point a to point b (x, y, z), m: distance, on the ground, and how much higher b is. */
export function between(a, b) {
  const [dx, dy, height] = [b[0] - a[0], b[1] - a[1], b[2] - a[2]];
  return { distance: Math.hypot(dx, dy, height), level: Math.hypot(dx, dy), height };
}

export class Measure {
  constructor(view, button, output) {
    [this.view, this.button, this.output, this.ends] = [view, button, output, []];
    button.addEventListener("click", () => (this.isOn ? this.stop() : this.start()));
    view.painters.push((pen, _, colour) => this.paint(pen, colour));
  }

  get isOn() {
    return this.button.getAttribute("aria-pressed") === "true";
  }

  start() {
    this.view.take(this, (x, y) => this.click(x, y));
    this.button.setAttribute("aria-pressed", "true");
    this.ends = [];
    this.output.textContent = "Click a point of the map, and another; or move one to the middle and press Enter.";
    this.view.drawSigns();
  }

  stop() {
    if (this.view.tool === this) this.view.take(null, null);
    this.button.setAttribute("aria-pressed", "false");
    [this.ends, this.output.textContent] = [[], ""];
    this.view.drawSigns();
  }

  click(x, y) {
    const place = this.view.pick(x, y);
    if (!place) {
      this.output.textContent = "No point of the map is seen there.";
      return;
    }
    this.ends = this.ends.length === 1 ? [this.ends[0], place] : [place];
    const [a, b] = this.ends;
    const at = (end) => end.map((value) => fixed(value, 2)).join(", ");
    if (!b) this.output.textContent = `From ${at(a)} m; click another point.`;
    else {
      const { distance, level, height } = between(a, b);
      this.output.textContent = `${fixed(distance, 2)} m: ${fixed(level, 2)} m level, ${fixed(height, 2)} m up; from ${at(a)} to ${at(b)} m`;
    }
    this.view.drawSigns();
  }

  paint(pen, colour) {
    if (!this.isOn) return;
    const seen = this.view.project(this.ends.flat());
    if (!this.ends.length) stroke(pen, this.middle(), colour("ink"), colour("paper"), 1.5);
    stroke(pen, seen, colour("ink"), colour("paper"), 2);
    for (let i = 0; i < seen.length; i += 2) {
      if (Number.isFinite(seen[i])) filled(pen, colour("c5"), colour("paper"), () => pen.arc(seen[i], seen[i + 1], 5, 0, 7));
    }
    if (this.ends.length < 2) return;
    const { distance } = between(...this.ends);
    label(pen, `${fixed(distance, 2)} m`, (seen[0] + seen[2]) / 2, (seen[1] + seen[3]) / 2 - 8, colour);
  }

  /** A cross in the middle, where Enter picks. */
  middle() {
    const [x, y] = [this.view.camera.width / 2, this.view.camera.height / 2];
    return [x - 8, y, x + 8, y, NaN, NaN, x, y - 8, x, y + 8];
  }
}
