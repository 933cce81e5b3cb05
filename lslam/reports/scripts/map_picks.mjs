// Corrections on the map: loops with their reasons, and scans and points that are picked by a click.
import { awayFrom, seenFrom } from "./edits.mjs";
import { nearestBy, unpack } from "./numbers.mjs";
import { layers, stroke } from "./overlay.mjs";
import { scans } from "./scans.mjs";

const NEAR = 9; // px between the pointer and what it means

export class MapPicks {
  /** corrections : what is chosen, said and changed */
  constructor(corrections, view) {
    [this.of, this.view, this.picking, this.first] = [corrections, view, "", null];
    layers.push((pen, seen, colour) => this.draw(pen, seen, colour));
    this.bubble = document.createElement("p");
    this.bubble.className = "loop-said";
    this.bubble.hidden = true;
    view.stage.append(this.bubble);
    let pressed = [NaN, NaN];
    const at = (event) => {
      const box = view.stage.getBoundingClientRect();
      return [event.clientX - box.left, event.clientY - box.top];
    };
    view.lines.addEventListener("pointerdown", (event) => {
      pressed = at(event);
    });
    view.lines.addEventListener("pointermove", (event) => this.point(...at(event)));
    view.lines.addEventListener("pointerleave", () => this.point(NaN, NaN));
    view.stage.addEventListener("click", (event) => {
      const [x, y] = at(event);
      if (Math.hypot(x - pressed[0], y - pressed[1]) < NEAR && this.click(x, y)) event.stopPropagation();
    }, true);
    view.lines.addEventListener("keydown", (event) => {
      if (event.key === "Escape") this.pick("");
    });
  }

  /** Whether a click meant something here. */
  click(x, y) {
    if (this.picking) {
      this.of.told(() => (this.picking === "pair" ? this.pickScan(x, y) : this.pickPoint(x, y)));
      return true;
    }
    const loop = this.loopAt(x, y);
    if (loop) this.of.choose(loop);
    return Boolean(loop);
  }

  /** From now on clicks pick a `pair` of scans, a `point`, or nothing. */
  pick(what) {
    [this.picking, this.first] = [what, null];
    this.view.stage.classList.toggle("picks", Boolean(what));
    for (const button of this.of.all("[data-pick]")) button.setAttribute("aria-pressed", String(button.dataset.pick === what));
    if (what) this.view.stage.scrollIntoView({ block: "center" });
  }

  /** Where poses are on the map, px. */
  ends(poses) {
    return poses.flatMap((pose) => [this.view.way[2 * pose], this.view.way[2 * pose + 1]]);
  }

  loopAt(x, y) {
    const away = Float32Array.from(this.view.way ? this.of.candidates : [], (one) => awayFrom(x, y, this.ends(one.poses)));
    const k = nearestBy(away, 0);
    return k >= 0 && away[k] < NEAR ? this.of.candidates[k] : null;
  }

  /** Say what the loop under the pointer is. */
  point(x, y) {
    const loop = this.loopAt(x, y);
    this.bubble.hidden = !loop;
    if (!loop) return;
    this.bubble.textContent = `Scans ${loop.scans.join(" and ")}, ${loop.verdict}${loop.reason ? `: ${loop.reason}` : ""}`;
    const { width, height } = this.view;
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
    if (away > 4 * NEAR) throw new Error("no scan lies there: click beside the trajectory");
    const [number, first] = [scans.index[pose], this.first];
    if (first !== null) {
      this.pick("");
      this.of.chooseScans(first, number);
      return;
    }
    this.first = number;
    this.of.say(`Scan ${number}: now the other one`);
    this.view.draw();
  }

  /** A point of the map with the scan that passed it nearest, or a scan where the trajectory is meant. */
  pickPoint(x, y) {
    const { pose, away } = this.poseAt(x, y);
    const point = away < NEAR ? null : this.pointAt(x, y);
    if (away >= NEAR && !point) throw new Error("no point of the map lies there");
    const place = (k) => Array.from(scans.positions.subarray(3 * k, 3 * k + 3));
    const near = point ? nearestBy(Float32Array.from({ length: scans.count }, (_, k) => Math.hypot(...place(k).map((value, axis) => value - point[axis]))), 0) : pose;
    const seen = point && seenFrom(point, place(near), Array.from(scans.angles.subarray(3 * near, 3 * near + 3))).map((value) => Number(value.toFixed(3)));
    this.pick("");
    this.of.see({ scan: scans.index[near], point: point || place(near), at: seen ? { lidar_x: seen[0], lidar_y: seen[1], lidar_z: seen[2] } : {} });
  }

  /** The point of the map that is seen nearest to px, of those as near the one nearest to the viewer; null without any. */
  pointAt(x, y) {
    const cloud = this.view.cloud;
    this.known ??= Float32Array.from(unpack(cloud.points, Int16Array), (q, i) => cloud.low[i % 3] + cloud.step[i % 3] * (q + 32768));
    const [seen, { back }] = [this.view.project(this.known), this.view.axes()];
    let [best, least] = [null, Infinity];
    for (let i = 0; i < seen.length / 2; i += 1) {
      const off = Math.hypot(seen[2 * i] - x, seen[2 * i + 1] - y);
      if (off > NEAR) continue;
      const point = this.known.subarray(3 * i, 3 * i + 3);
      // A px counts as much as the 10 px that something is nearer to the viewer.
      const cost = off - (back[0] * point[0] + back[1] * point[1] + back[2] * point[2]) / this.view.metres / 10;
      if (cost < least) [best, least] = [Array.from(point), cost];
    }
    return best;
  }

  draw(pen, view, colour) {
    const [of, paper] = [this.of, colour("paper")];
    const disc = (x, y, fill) => {
      pen.beginPath();
      pen.arc(x, y, 6, 0, 7);
      [pen.fillStyle, pen.strokeStyle, pen.lineWidth] = [fill, paper, 1.5];
      pen.fill();
      pen.stroke();
    };
    for (const one of of.candidates) if (one.verdict === "rejected") stroke(pen, this.ends(one.poses), colour("bad"), null, 1.2, [5, 4]);
    for (const pair of of.pairs) {
      stroke(pen, this.ends([pair.scan_a, pair.scan_b].map((number) => of.poseOf.get(number))), colour(pair.verdict === "known" ? "ok" : "bad"), paper, 3);
    }
    if (of.changed) stroke(pen, view.project(of.changed), colour("c1"), paper, 2, [2, 4]);
    if (of.chosen && of.isAsked) {
      const ends = this.ends(of.chosen.poses);
      stroke(pen, ends, colour("ink"), paper, 2.5);
      disc(ends[0], ends[1], colour("c1"));
      disc(ends[2], ends[3], colour("c2"));
    }
    if (this.first !== null) disc(...this.ends([of.poseOf.get(this.first)]), colour("c1"));
    if (of.seen) disc(...view.project(of.seen.point), colour("warn"));
  }
}
