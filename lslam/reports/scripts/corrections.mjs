// Loops and points that a person corrects: chosen in the list or on the map, looked at, said; saved as files or by the server.
import { pairsFile, pointOf, pointsFile, saidOf, sortedBy, withVerdict } from "./edits.mjs";
import { KEYS, read } from "./elements.mjs";
import { MapPicks } from "./map_picks.mjs";
import { fixed, unpack } from "./numbers.mjs";
import { scans } from "./scans.mjs";
import { ask, served } from "./served.mjs";
import { TwoClouds } from "./two_clouds.mjs";
import { mapView } from "./view.mjs";

const ASKED_MS = 1000; // between two questions of what the graph does

class Corrections {
  constructor(section, data) {
    [this.section, this.candidates, this.views] = [section, data.candidates, data.views];
    [this.pairs, this.points] = [[], []];
    this.candidates.forEach((one, k) => Object.assign(one, { k, scans: one.poses.map((pose) => scans.index[pose]) }));
    this.poseOf = new Map(Array.from(scans.index, (number, pose) => [number, pose]));
    this.clouds = new TwoClouds(this.find("canvas"), (isAfter) => this.press(isAfter ? "after" : "before", ["before", "after"]));
    this.sorting = ["doubt", true];
    section.classList.toggle("served", served);
    section.hidden = false;
    this.map = mapView?.drawer ? new MapPicks(this, mapView) : null;
    this.startButtons();
    this.startForms();
    this.list();
    if (this.candidates.length) this.choose(this.candidates[0], false);
    if (served) this.resume();
  }

  find(selector) {
    return this.section.querySelector(selector);
  }

  all(selector) {
    return this.section.querySelectorAll(selector);
  }

  startButtons() {
    const views = ["above", "side"];
    const see = {
      before: () => this.clouds.switch(false), after: () => this.clouds.switch(true),
      above: () => this.clouds.turnTo(false), side: () => this.clouds.turnTo(true),
    };
    for (const button of this.all("[data-see]")) {
      button.addEventListener("click", () => {
        see[button.dataset.see]();
        if (views.includes(button.dataset.see)) this.press(button.dataset.see, views);
      });
    }
    for (const button of this.all("[data-say]")) button.addEventListener("click", () => this.judge(button.dataset.say));
    for (const button of this.all("[data-pick]")) {
      button.disabled = !this.map;
      button.addEventListener("click", () => (this.map.picking === button.dataset.pick ? this.map.stop() : this.map.pick(button.dataset.pick)));
    }
    for (const button of this.all("[data-by]")) {
      button.addEventListener("click", () => {
        const [name, isFalling] = this.sorting;
        this.sorting = [button.dataset.by, button.dataset.by === name ? !isFalling : button.dataset.by === "doubt"];
        this.list();
      });
    }
    for (const button of this.all("[data-file]")) button.addEventListener("click", () => this.download(button.dataset.file));
    this.find("[data-graph=run]").addEventListener("click", () => this.told(async () => this.follow(await ask("api/graph", {}))));
    this.find("[data-graph=stop]").addEventListener("click", () => this.told(async () => this.follow(await ask("api/stop", {}))));
  }

  /** Show which of some views it is. */
  press(name, names) {
    for (const other of names) this.find(`[data-see=${other}]`).setAttribute("aria-pressed", String(other === name));
  }

  startForms() {
    const [pair, point] = [this.find("form.pair"), this.find(".point form")];
    pair.addEventListener("submit", (event) => {
      event.preventDefault();
      this.told(() => this.chooseScans(...[pair.a, pair.b].map((field) => this.numberOf(field.value))));
    });
    point.addEventListener("submit", (event) => {
      event.preventDefault();
      this.told(() => {
        const row = pointOf(Object.fromEntries(new FormData(point)));
        this.numberOf(String(row.scan));
        if (this.seen?.scan === row.scan) Object.assign(row, this.seen.at);
        this.change(this.pairs, [...this.points, row]);
        this.see(null);
        for (const name of ["x", "y", "z"]) point[name].value = "";
      });
    });
    point.scan.addEventListener("input", () => this.see(null));
  }

  /** A scan's number as it was typed. Raises Error where the run has no such scan. */
  numberOf(text) {
    const number = /^\s*\d+\s*$/.test(text) ? Number(text) : NaN;
    if (!this.poseOf.has(number)) throw new Error(`scan ${text} is none of the run's`);
    return number;
  }

  say(text, isBad = false) {
    const outcome = this.find(".outcome");
    outcome.classList.toggle("bad", isBad);
    outcome.textContent = text;
  }

  /** Do what may fail, and say why where it does. */
  async told(action) {
    try {
      this.say("");
      await action();
    } catch (error) {
      this.say(error.message, true);
    }
  }

  list() {
    const [name, isFalling] = this.sorting;
    for (const button of this.all("[data-by]")) {
      button.parentElement.toggleAttribute("aria-sort", false);
      if (button.dataset.by === name) button.parentElement.setAttribute("aria-sort", isFalling ? "descending" : "ascending");
    }
    this.find("tbody").replaceChildren(...sortedBy(this.candidates, name, isFalling).map((one) => this.row(one)));
    if (!this.candidates.length) this.find("tbody").innerHTML = "<tr><td colspan=5>No loop candidate was registered.</td></tr>";
    this.markRow();
  }

  row(one) {
    const row = document.createElement("tr");
    row.dataset.k = one.k;
    const [cell, button] = [document.createElement("td"), document.createElement("button")];
    button.type = "button";
    button.textContent = one.scans.join(" – ");
    button.addEventListener("click", () => this.choose(one));
    cell.append(button);
    const said = saidOf(this.pairs, ...one.scans);
    const texts = [fixed(one.doubt, 2), said ? `${one.verdict}, now ${said}` : one.verdict, one.overlap === null ? "" : `${fixed(100 * one.overlap, 0)} %`, one.reason];
    row.append(cell, ...texts.map((text, k) => {
      const other = document.createElement("td");
      if (k === 3) other.className = "text";
      other.textContent = text;
      return other;
    }));
    return row;
  }

  markRow() {
    for (const row of this.all("tbody tr")) {
      const isChosen = row.dataset.k !== undefined && Number(row.dataset.k) === this.chosen?.k;
      row.classList.toggle("chosen", isChosen);
      row.querySelector("button")?.toggleAttribute("aria-current", isChosen);
    }
  }

  /** Look at a candidate, or at any pair: `scans` are the numbers of both. The first is shown before anybody asks. */
  choose(one, isAsked = true) {
    [this.chosen, this.isAsked] = [one, isAsked];
    const form = this.find("form.pair");
    [form.a.value, form.b.value] = one.scans;
    const [view, said] = [this.views[one.k], [`Scans ${one.scans.join(" and ")}`]];
    if (one.verdict) said.push(`${one.verdict}${one.reason ? `: ${one.reason}` : ""}`);
    if (one.rmse) said.push(`rmse ${fixed(one.rmse, 2)} m`);
    if (!view && !served) said.push("their points are not in this file: lslam view shows them");
    this.show(view || null, said.join("; "), one.scans);
    if (served && isAsked) this.told(() => this.register(one, said));
  }

  /** Any two scans; a candidate where they are one. */
  chooseScans(a, b) {
    if (a === b) throw new Error("these are one scan: choose two that lie apart");
    const pair = [Math.min(a, b), Math.max(a, b)];
    this.choose(this.candidates.find((one) => one.scans.toString() === pair.toString()) || { scans: pair, poses: pair.map((n) => this.poseOf.get(n)) });
  }

  async register(one, said) {
    this.find(".facts").textContent = `${said.join("; ")}; registering them …`;
    const pair = await ask(`api/pair?a=${one.scans[0]}&b=${one.scans[1]}`).catch((error) => {
      this.find(".facts").textContent = said.join("; ");
      throw error;
    });
    if (this.chosen !== one) return;
    const fits = `as a known pair they close a loop, rmse ${fixed(pair.rmse, 2)} m, overlap ${fixed(100 * pair.overlap, 0)} %`;
    const told = pair.verdict === "accepted" ? fits : `as a known pair they close no loop${pair.reason === one.reason ? " either" : `: ${pair.reason}`}`;
    this.show(pair, [...said, told].join("; "), pair.scans);
  }

  show(pair, said, numbers) {
    this.clouds.show(pair);
    this.find(".facts").textContent = said;
    [this.find(".older").textContent, this.find(".newer").textContent] = numbers.map((number) => `scan ${number}`);
    this.find("canvas").setAttribute("aria-label", pair ? `Both scans on each other, ${numbers.join(" and ")}; ${KEYS}; comma switches before and registered` : "Their points are not here");
    const after = this.find("[data-see=after]");
    after.disabled = !pair?.after;
    this.showVerdict();
    this.markRow();
    this.map?.view.drawSigns();
  }

  showVerdict() {
    const said = this.chosen ? saidOf(this.pairs, ...this.chosen.scans) : "";
    for (const button of this.all("[data-say]")) {
      button.disabled = !this.chosen || (!button.dataset.say && !said);
      if (button.dataset.say) button.setAttribute("aria-pressed", String(button.dataset.say === said));
    }
  }

  judge(verdict) {
    this.told(() => this.change(withVerdict(this.pairs, ...this.chosen.scans, verdict), this.points));
  }

  /** Other corrections: shown, and saved where there is a server. */
  async change(pairs, points) {
    const before = [this.pairs, this.points];
    [this.pairs, this.points] = [pairs, points];
    this.listSaid();
    if (!served) return;
    try {
      await ask("api/edits", { pairs, points });
      this.say(`Written: ${pairs.length} in edits.csv, ${points.length} in points.csv`);
    } catch (error) {
      [this.pairs, this.points] = before;
      this.listSaid();
      throw error;
    }
  }

  listSaid() {
    const item = (text, pairs, points) => {
      const [line, button] = [document.createElement("li"), document.createElement("button")];
      button.type = "button";
      button.textContent = "Remove";
      button.setAttribute("aria-label", `Remove ${text}`);
      button.addEventListener("click", () => this.told(() => this.change(pairs(), points())));
      line.append(text, button);
      return line;
    };
    const same = (rows) => () => rows;
    const without = (rows, one) => () => rows.filter((row) => row !== one);
    this.find(".said ul").replaceChildren(
      ...this.pairs.map((one) => item(`${one.scan_a} – ${one.scan_b} ${one.verdict}`, without(this.pairs, one), same(this.points))),
      ...this.points.map((one) => item(`point of scan ${one.scan} at ${one.x}, ${one.y}, ${one.z} m, ${one.crs}`, same(this.pairs), without(this.points, one))),
    );
    this.find("[data-file='edits.csv']").disabled = !this.pairs.length;
    this.find("[data-file='points.csv']").disabled = !this.points.length;
    this.find("[data-graph=run]").disabled = !(this.pairs.length || this.points.length);
    this.showVerdict();
    this.list();
    this.map?.view.drawSigns();
  }

  download(name) {
    const link = document.createElement("a");
    link.href = URL.createObjectURL(new Blob([name === "edits.csv" ? pairsFile(this.pairs) : pointsFile(this.points)], { type: "text/csv" }));
    link.download = name;
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 1e4);
  }

  /** What was said before the page was opened, and what the graph does. */
  resume() {
    this.told(async () => {
      const { pairs, points } = await ask("api/edits");
      [this.pairs, this.points] = [pairs, points];
      this.listSaid();
      this.follow(await ask("api/graph"));
    });
  }

  /** Say what the graph does until it is over, then what it changed. */
  follow(state) {
    const isRunning = state.state === "running";
    this.find("[data-graph=stop]").hidden = !isRunning;
    this.find("[data-graph=run]").disabled = isRunning || !(this.pairs.length || this.points.length);
    if (state.state === "none") return;
    const last = state.said.at(-1) || "it starts";
    const texts = { running: `lslam graph into ${state.out}: ${last}`, stopped: "lslam graph was stopped", failed: `lslam graph failed: ${last}`, done: "" };
    this.say(texts[state.state], state.state === "failed");
    if (isRunning) setTimeout(() => this.told(async () => this.follow(await ask("api/graph"))), ASKED_MS);
    if (state.state !== "done") return;
    this.changed = unpack(state.positions, Float32Array);
    const link = document.createElement("a");
    [link.href, link.textContent] = [state.page, state.out];
    this.find(".change").replaceChildren(`Poses moved by ${fixed(state.mean_m, 3)} m, ${fixed(state.most_m, 3)} m at most (dashed green on the map). The new run: `, link);
    this.map?.view.drawSigns();
  }

  /** What was picked as a point, or null: its scan, its place in the world, and how its LiDAR saw it. */
  see(seen) {
    this.seen = seen;
    const form = this.find(".point form");
    if (seen) {
      form.scan.value = seen.scan;
      form.x.focus();
    }
    const at = seen && Object.values(seen.at);
    this.find(".seen").textContent = !seen ? "" : at.length ? `seen from its LiDAR at ${at.map((value) => fixed(value, 2)).join(", ")} m` : "the LiDAR itself";
    this.map?.view.drawSigns();
  }
}

const candidates = read("candidates");
export const corrections = candidates && scans && new Corrections(document.getElementById("corrections"), candidates);
