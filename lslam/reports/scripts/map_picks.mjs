// Corrections on the map: loops with their reasons, and scans and points that are picked by a click.
import { awayFrom, seenFrom } from "./edits.mjs";
import { nearestBy } from "./numbers.mjs";
import { filled, stroke } from "./overlay.mjs";
import { scans } from "./scans.mjs";

const REACH_PX = 9; // px between the pointer and what it means

export class MapPicks {
  /** corrections : what is chosen, said and changed */
  constructor(corrections, view) {
    [this.of, this.view, this.picking, this.first] = [corrections, view, "", null];
    view.painters.push((pen, _, colour) => this.draw(pen, colour));
    this.bubble = document.createElement("p");
    this.bubble.className = "loop-said";
    this.bubble.hidden = true;
    view.stage.append(this.bubble);
    const at = (event) => {
      const box = view.stage.getBoundingClientRect();
      return [event.clientX - box.left, event.clientY - box.top];
    };
    view.lines.addEventListener("pointermove", (event) => this.point(...at(event)));
    view.lines.addEventListener("pointerleave", () => this.point(NaN, NaN));
    this.stop();
    if (corrections.candidates.some((one) => one.verdict === "rejected")) view.explain("loop rejected", "limit");
    view.lines.addEventListener("keydown", (event) => {
      if (event.key === "Escape") this.stop();
    });
  }

  /** From now on clicks pick a `pair` of scans or a `point`. */
  pick(what) {
    this.view.take(this, (x, y) => this.of.told(() => (what === "pair" ? this.pickScan(x, y) : this.pickPoint(x, y))));
    this.press(what);
    this.view.stage.scrollIntoView({ block: "center" });
  }

  /** Clicks choose loops again. */
  stop() {
    if (!this.view.tool || this.view.tool === this) {
      this.view.take(null, (x, y) => {
        const loop = this.loopAt(x, y);
        if (loop) this.of.choose(loop);
      });
    }
    this.press("");
  }

  press(what) {
    [this.picking, this.first] = [what, null];
    this.view.stage.classList.toggle("picks", Boolean(what));
    for (const button of this.of.all("[data-pick]")) button.setAttribute("aria-pressed", String(button.dataset.pick === what));
  }

  /** Where poses are on the map, px. */
  ends(poses) {
    return poses.flatMap((pose) => [this.view.way[2 * pose], this.view.way[2 * pose + 1]]);
  }

  loopAt(x, y) {
    const away = Float32Array.from(this.view.way && !this.view.section ? this.of.candidates : [], (one) => awayFrom(x, y, this.ends(one.poses)));
    const k = nearestBy(away, 0);
    return k >= 0 && away[k] < REACH_PX ? this.of.candidates[k] : null;
  }

  /** Say what the loop under the pointer is. */
  point(x, y) {
    const loop = this.loopAt(x, y);
    this.bubble.hidden = !loop;
    if (!loop) return;
    this.bubble.textContent = `Scans ${loop.scans.join(" and ")}, ${loop.verdict}${loop.reason ? `: ${loop.reason}` : ""}`;
    const { width, height } = this.view.camera;
    Object.assign(this.bubble.style, x > width / 2 ? { left: "", right: `${width - x + 12}px` } : { left: `${x + 12}px`, right: "" });
    Object.assign(this.bubble.style, y > height / 2 ? { top: "", bottom: `${height - y + 12}px` } : { top: `${y + 12}px`, bottom: "" });
  }

  /** The pose that is seen nearest to px, and how far away, px. */
  poseAt(x, y) {
    const away = Float32Array.from({ length: scans.count }, (_, k) => Math.hypot(this.view.way[2 * k] - x, this.view.way[2 * k + 1] - y));
    const k = nearestBy(away, 0);
    return { pose: k, away: k < 0 ? Infinity : away[k] };
  }

  pickScan(x, y) {
    const { pose, away } = this.poseAt(x, y);
    if (away > 4 * REACH_PX) throw new Error("no scan lies there: click beside the trajectory");
    const [number, first] = [scans.index[pose], this.first];
    if (first !== null) {
      this.stop();
      this.of.chooseScans(first, number);
      return;
    }
    this.first = number;
    this.of.say(`Scan ${number}: now the other one`);
    this.view.drawSigns();
  }

  /** A point of the map with the scan that passed it nearest, or a scan where the trajectory is meant. */
  pickPoint(x, y) {
    const { pose, away } = this.poseAt(x, y);
    const point = away < REACH_PX ? null : this.view.pick(x, y);
    if (away >= REACH_PX && !point) throw new Error("no point of the map lies there");
    const place = (k) => Array.from(scans.positions.subarray(3 * k, 3 * k + 3));
    const near = point ? nearestBy(Float32Array.from({ length: scans.count }, (_, k) => Math.hypot(...place(k).map((value, axis) => value - point[axis]))), 0) : pose;
    const seen = point && seenFrom(point, place(near), Array.from(scans.angles.subarray(3 * near, 3 * near + 3))).map((value) => Number(value.toFixed(3)));
    this.stop();
    this.of.see({ scan: scans.index[near], point: point || place(near), at: seen ? { lidar_x: seen[0], lidar_y: seen[1], lidar_z: seen[2] } : {} });
  }

  draw(pen, colour) {
    if (this.view.section) return;
    const [of, paper] = [this.of, colour("paper")];
    const line = (points, css, rim, width, dashes) => {
      pen.setLineDash(dashes);
      stroke(pen, points, css, rim, width);
      pen.setLineDash([]);
    };
    const disc = (x, y, css) => filled(pen, css, paper, () => pen.arc(x, y, 6, 0, 7));
    for (const one of of.candidates) if (one.verdict === "rejected") line(this.ends(one.poses), colour("bad"), null, 1.4, [5, 4]);
    for (const pair of of.pairs) {
      const ends = this.ends([pair.scan_a, pair.scan_b].map((number) => of.poseOf.get(number)));
      line(ends, colour(pair.verdict === "known" ? "ok" : "bad"), paper, 3, []);
    }
    if (of.changed) line(this.view.project(of.changed), colour("c3"), paper, 3, [8, 5]);
    if (of.chosen && of.isAsked) {
      const ends = this.ends(of.chosen.poses);
      line(ends, colour("ink"), paper, 2.5, []);
      disc(ends[0], ends[1], colour("c1"));
      disc(ends[2], ends[3], colour("c2"));
    }
    if (this.first !== null) disc(...this.ends([of.poseOf.get(this.first)]), colour("c1"));
    if (of.seen) disc(...this.view.project(of.seen.point), colour("warn"));
  }
}
