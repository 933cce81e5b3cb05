// Sections of the map, chosen on the page: along the trajectory, or along a line of two clicks.
import { cloudFrom, coordinates } from "./clouds.mjs";
import { BY } from "./colours.mjs";
import { fixed } from "./numbers.mjs";
import { stroke } from "./overlay.mjs";
import { scans } from "./scans.mjs";
import { lengths, unroll } from "./section.mjs";

export class Slices {
  constructor(view, select, width, output) {
    Object.assign(this, { view, select, width, output, corners: [] });
    select.add(new Option("none", ""));
    if (scans && scans.count > 1 && view.cloud.nearest) select.add(new Option("along the trajectory", "way"));
    select.add(new Option("along a line", "line"));
    select.addEventListener("change", () => this.choose(select.value));
    width.addEventListener("input", () => this.view.section && this.show());
    view.leavers.push(() => this.left());
    view.painters.push((pen, _, colour) => {
      if (this.select.value === "line" && !view.section) stroke(pen, view.project(this.corners), colour("c5"), colour("paper"), 2);
    });
  }

  choose(what) {
    if (this.view.section) this.view.leaveSection();
    this.select.value = what;
    this.corners = [];
    this.view.take(what === "line" ? this : null, what === "line" ? (x, y) => this.click(x, y) : null);
    this.output.textContent = what === "line" ? "Click where the section begins, and where it ends." : "";
    if (what === "way") this.cut(scans.positions, this.view.cloud.nearest);
    this.view.drawSigns();
  }

  /** The view was turned away from the section, or another tool takes the clicks. */
  stop() {
    if (this.select.value === "line" && !this.view.section) this.left();
  }

  left() {
    [this.select.value, this.output.textContent, this.corners] = ["", "", []];
  }

  click(x, y) {
    const place = this.view.pick(x, y);
    if (!place) {
      this.output.textContent = "No point of the map is seen there.";
      return;
    }
    this.corners.push(...place);
    if (this.corners.length === 6) this.cut(Float32Array.from(this.corners), null);
    this.view.drawSigns();
  }

  cut(line, corner) {
    this.view.take(null, null);
    [this.line, this.corner] = [line, corner];
    this.show();
  }

  /** The points of a section take part when the map is coloured in another way. */
  recolour() {
    if (this.view.section) this.show();
  }

  show() {
    const { view, line, corner } = this;
    const width = Number(this.width.value);
    const places = coordinates(view.cloud);
    const { xyz, rows } = unroll(places, line, width / 2, corner);
    if (!rows.length) {
      this.output.textContent = `Nothing of the map lies within ${fixed(width / 2, 1)} m of the line.`;
      if (view.section) view.leaveSection();
      return;
    }
    const cloud = cloudFrom(xyz);
    const bytes = view.known[view.way_of_colour].bytes;
    if (bytes) {
      const size = view.by === BY.rgb ? 3 : 1;
      const some = new Uint8Array(size * rows.length);
      rows.forEach((row, i) => some.set(bytes.subarray(size * row, size * (row + 1)), size * i));
      cloud[view.by === BY.rgb ? "rgb" : "value"] = some;
    }
    const way = lengths(line);
    const length = way.at(-1);
    const drawn = corner && Float32Array.from(line, (value, i) => (i % 3 === 0 ? way[i / 3] : i % 3 === 1 ? 0 : value));
    const heights = [cloud.low[2], cloud.low[2] + 65535 * cloud.step[2]];
    view.showSection(cloud, drawn, [0, length, ...heights]);
    this.select.value = corner ? "way" : "line";
    this.output.textContent = `${rows.length.toLocaleString("en")} points within ${fixed(width / 2, 1)} m of ${fixed(length, 1)} m; a click on 3D or From above leaves the section.`;
  }
}
