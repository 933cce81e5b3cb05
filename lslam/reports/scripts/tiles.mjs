// More points of the map from the server: nodes of its octree, as fine as the view needs them.
import { BY } from "./colours.mjs";
import { nodeOf, nodesFor } from "./octree.mjs";
import { ask, askBytes, served } from "./served.mjs";
import { mapView } from "./view.mjs";

const BUDGET = 1_500_000; // points that are drawn
const HELD = 2 * BUDGET; // points that are kept for when they are seen again
const FINEST = 1.2; // px between points that are near enough
const AT_ONCE = 4; // nodes that are asked for
const TOGETHER_MS = 250; // in which nodes that come are drawn at once
const AGAIN_MS = 1500; // between two questions of how far the octree is

export class Tiles {
  constructor(view) {
    [this.view, this.tree, this.held, this.asked] = [view, null, new Map(), new Set()];
    this.said = document.createElement("span");
    this.said.className = "tiles-said";
    view.figure.querySelector("figcaption").append(" ", this.said);
    view.painters.push(() => this.look());
    this.begin();
  }

  /** Ask for the index until it is there. */
  async begin() {
    try {
      const tree = await ask("tiles/tree.json");
      if (tree.error) throw new Error(tree.error);
      if (tree.nodes) {
        if (tree.points <= this.view.cloud.count) return; // the page has them all
        this.tree = tree;
        this.view.drawSigns();
        return;
      }
      this.said.textContent = `All points are being sorted: ${Math.round(100 * tree.share)} %.`;
      setTimeout(() => this.begin(), AGAIN_MS);
    } catch (error) {
      this.said.textContent = `No more points: ${error.message}.`;
    }
  }

  /** Draw the nodes that the view needs, and ask for those that are missing. */
  look() {
    const { view } = this;
    if (!this.tree || view.section) return;
    this.wanted = nodesFor(this.tree, view.camera, BUDGET, FINEST / (devicePixelRatio || 1));
    if (this.way !== view.way_of_colour) {
      this.way = view.way_of_colour;
      for (const [name, cloud] of this.held) view.drawer.add(name, this.coloured(cloud));
      view.draw(); // some points were drawn in colours that they had before
    }
    const there = this.wanted.filter((name) => this.held.has(name));
    for (const name of there) {
      const cloud = this.held.get(name);
      this.held.delete(name); // the last seen are the last of the map
      this.held.set(name, cloud);
    }
    view.spacing = this.spacingOf(there);
    const names = ["map", ...there];
    const isOther = names.join() !== view.names.join();
    view.names = names;
    if (isOther) this.drawSoon();
    this.forget();
    this.loadSome();
    const points = there.reduce((sum, name) => sum + this.tree.nodes[name], 0);
    this.said.textContent = `${points.toLocaleString("en")} of all ${this.tree.points.toLocaleString("en")} points are loaded, nearer ones as they are seen.`;
  }

  /** m between points where nodes `there` are drawn: that of the finest, and not less than that of the whole map, which is of surfaces. */
  spacingOf(there) {
    const { spacing, count } = this.view.cloud;
    const finest = Math.min(spacing, ...there.map((name) => this.tree.edge / 2 ** (name.length - 1) / this.tree.cells));
    return Math.max(finest, spacing * Math.sqrt(count / this.tree.points));
  }

  /** The map anew, once for all nodes that come in a moment. */
  drawSoon() {
    this.due ||= setTimeout(() => {
      this.due = 0;
      this.view.draw();
    }, TOGETHER_MS);
  }

  loadSome() {
    for (const name of this.wanted) {
      if (this.asked.size >= AT_ONCE) return;
      if (!this.held.has(name) && !this.asked.has(name)) this.load(name);
    }
  }

  async load(name) {
    this.asked.add(name);
    try {
      const cloud = nodeOf(name, await askBytes(`tiles/${name}.bin`), this.tree, this.view.cloud);
      this.held.set(name, cloud);
      this.view.drawer.add(name, this.coloured(cloud));
      this.view.drawSigns();
    } catch (error) {
      this.tree = null; // it is not asked again
      this.said.textContent = `No more points: ${error.message}.`;
    } finally {
      this.asked.delete(name);
    }
  }

  /** The cloud as the drawer takes it, in the map's way of colours. */
  coloured(cloud) {
    const way = this.view.waysOf(cloud)[this.view.way_of_colour];
    if (this.view.by === BY.rgb) return { ...cloud, rgb: way?.bytes || new Uint8Array(3 * cloud.count).fill(128) };
    return { ...cloud, rgb: null, value: way?.bytes || new Uint8Array(cloud.count) };
  }

  /** Drop what was not seen for longest. */
  forget() {
    let points = 0;
    for (const name of this.held.keys()) points += this.tree.nodes[name];
    for (const name of this.held.keys()) {
      if (points <= HELD) return;
      this.view.drawer.remove(name);
      this.held.delete(name);
      points -= this.tree.nodes[name];
    }
  }
}

export const tiles = served && mapView?.drawer ? new Tiles(mapView) : null;
