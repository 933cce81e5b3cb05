"use strict";
// What every page shares: packed numbers, the scan that is marked, gestures, printing.
// Pages are whole without it; nothing is fetched.

const KEYS = "click, then scroll; + and − zoom, arrows pan, 0 shows all";

function read(id) {
  const element = document.getElementById(id);
  return element ? JSON.parse(element.textContent) : null;
}

/** An array of `Kind` from base64; little-endian, as every machine with a browser is. */
function unpack(text, Kind) {
  const raw = atob(text);
  const bytes = new Uint8Array(raw.length);
  for (let i = 0; i < raw.length; i += 1) bytes[i] = raw.charCodeAt(i);
  return new Kind(bytes.buffer);
}

function make(name, attributes, parent) {
  const element = document.createElementNS("http://www.w3.org/2000/svg", name);
  for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
  if (parent) parent.appendChild(element);
  return element;
}

function clamp(value, low, high) {
  return Math.min(Math.max(value, low), high);
}

function fixed(value, digits) {
  if (!Number.isFinite(value)) return "n/a";
  const text = value.toFixed(digits);
  return Number(text) === 0 ? text.replace("-", "") : text.replace("-", "−");
}

/** Every scan of a run, and the abscissae that charts are drawn over; null on pages of several runs. */
const scans = (() => {
  const data = read("scans");
  if (!data) return null;
  const positions = unpack(data.positions, Float32Array);
  const stamps = unpack(data.stamps, Float64Array);
  const index = unpack(data.index, Int32Array);
  const column = (points, axis) => Float32Array.from({ length: points.length / 3 }, (_, k) => points[3 * k + axis]);
  const own = [column(positions, 0), column(positions, 1)];
  const by = { scan: index, way: unpack(data.way, Float32Array), time: stamps.map((ns) => ns * 1e-9), own };
  if (data.aligned) {
    by.truth = unpack(data.truth_way, Float32Array);
    by.aligned = data.aligned.slice(0, 2).map((row) => Float32Array.from({ length: data.count }, (_, k) =>
      row[0] * positions[3 * k] + row[1] * positions[3 * k + 1] + row[2] * positions[3 * k + 2] + row[3]));
  }
  const status = unpack(data.status, Uint8Array);
  const failed = ["bridged", "skipped"].map((word) => data.statuses.indexOf(word));
  return {
    ...data, positions, stamps, index, by, status,
    failed: Array.from(status.keys()).filter((k) => failed.includes(status[k] & 7)),
    angles: unpack(data.angles, Float32Array),
    posedBy: unpack(data.posed_by, Uint8Array),
    error: data.error ? unpack(data.error, Float32Array) : null,
    truth: data.truth ? unpack(data.truth, Float32Array) : null,
  };
})();

/** What became of scan k, in words. */
function statusOf(k) {
  const code = scans.status[k];
  const words = [scans.statuses[code & 7]];
  if (code & scans.flags.degenerate) words.push("poorly constrained");
  if (code & scans.flags.lost) words.push("may be lost");
  if (scans.posers.length > 1 && scans.posedBy[k] < scans.posers.length) words.push(`posed by ${scans.posers[scans.posedBy[k]]}`);
  if (scans.reasons[k]) words.push(scans.reasons[k]);
  return words.join(", ");
}

/** What is known of scan k, as [name, text]. */
function tell(k) {
  const three = (values, digits) => [0, 1, 2].map((axis) => fixed(values[3 * k + axis], digits)).join(", ");
  const rows = [
    ["scan", scans.index[k] < 0 ? "n/a" : String(scans.index[k])],
    ["time", `${fixed(scans.by.time[k], 3)} s`],
    ["stamp", `${BigInt(scans.first_stamp_ns) + BigInt(scans.stamps[k])} ns`],
    ["x, y, z", `${three(scans.positions, 2)} m`],
    ["roll, pitch, yaw", `${three(scans.angles, 2)}°`],
  ];
  if (scans.error) rows.push([`error (${scans.alignment})`, Number.isFinite(scans.error[k]) ? `${fixed(scans.error[k], 3)} m` : "not matched"]);
  rows.push(["status", statusOf(k)]);
  return rows;
}

// The scan that is marked in all plots.
const watchers = [];
let marked = 0;
let isDue = false;

function mark(k) {
  if (!scans || k === marked || k < 0 || k >= scans.count) return;
  marked = k;
  if (isDue) return;
  isDue = true;
  requestAnimationFrame(() => {
    isDue = false;
    for (const watcher of watchers) watcher(marked);
  });
}

/** The scan whose value is nearest to `value`; -1 without one. */
function nearestBy(values, value) {
  let best = -1;
  let least = Infinity;
  for (let k = 0; k < values.length; k += 1) {
    const off = Math.abs(values[k] - value);
    if (off < least) [least, best] = [off, k];
  }
  return best;
}

/**
 * Wheel, drag, pinch and keys on an element. `on` has zoom(factor, x, y, event), pan(dx, dy, event), reset() and, where
 * something is marked, hover(x, y), px within the element, and step(by) where that is no scan. The wheel scrolls the page
 * until the element was clicked.
 */
function gestures(element, on) {
  const step = on.step || ((by) => mark(marked + by));
  const pointers = new Map();
  let spread = 0;
  const at = (event) => {
    const box = element.getBoundingClientRect();
    return [event.clientX - box.left, event.clientY - box.top];
  };
  const middle = () => [...pointers.values()].reduce(([x, y], p) => [x + p[0] / pointers.size, y + p[1] / pointers.size], [0, 0]);
  const width = () => {
    const [a, b] = [...pointers.values()];
    return b ? Math.hypot(a[0] - b[0], a[1] - b[1]) : 0;
  };
  const release = (event) => {
    pointers.delete(event.pointerId);
    spread = width();
  };
  element.setAttribute("tabindex", "0");
  element.addEventListener("wheel", (event) => {
    if (!event.ctrlKey && !event.metaKey && document.activeElement !== element) return;
    event.preventDefault();
    const turned = (event.deltaY || event.deltaX) * (event.deltaMode === 1 ? 16 : 1);
    on.zoom(Math.exp(-0.0015 * turned), ...at(event), event);
  }, { passive: false });
  element.addEventListener("pointerdown", (event) => {
    pointers.set(event.pointerId, at(event));
    spread = width();
    element.setPointerCapture(event.pointerId);
    element.focus({ preventScroll: true });
  });
  element.addEventListener("pointermove", (event) => {
    const before = middle();
    if (!pointers.has(event.pointerId)) {
      if (on.hover) on.hover(...at(event));
      return;
    }
    pointers.set(event.pointerId, at(event));
    const now = middle();
    on.pan(now[0] - before[0], now[1] - before[1], event);
    if (pointers.size > 1 && spread) on.zoom(width() / spread, ...now, event);
    spread = width();
  });
  element.addEventListener("pointerup", (event) => {
    release(event);
    if (on.hover) on.hover(...at(event));
  });
  element.addEventListener("pointercancel", release);
  element.addEventListener("dblclick", () => on.reset());
  element.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const [x, y] = [element.clientWidth / 2, element.clientHeight / 2];
    const done = {
      "+": () => on.zoom(1.3, x, y, event), "=": () => on.zoom(1.3, x, y, event), "-": () => on.zoom(1 / 1.3, x, y, event),
      0: () => on.reset(), Home: () => on.reset(),
      ArrowLeft: () => on.pan(40, 0, event), ArrowRight: () => on.pan(-40, 0, event),
      ArrowUp: () => on.pan(0, 40, event), ArrowDown: () => on.pan(0, -40, event),
      ",": () => step(-1), ".": () => step(1), Escape: () => element.blur(),
    }[event.key];
    if (!done) return;
    event.preventDefault();
    done();
  });
}

/** The bar with the slider over time and what is known of the marked scan. */
function startBar() {
  const bar = document.getElementById("now");
  if (!bar || !scans) return;
  const slider = bar.querySelector("input");
  const said = bar.querySelector("output");
  const show = (k) => {
    const rows = tell(k);
    said.replaceChildren(...rows.map(([name, text]) => {
      const part = document.createElement("span");
      const word = document.createElement("i");
      word.textContent = `${name} `;
      part.append(word, text);
      return part;
    }));
    slider.value = String(k);
    slider.setAttribute("aria-valuetext", rows.map((row) => row.join(" ")).join("; "));
  };
  slider.addEventListener("input", () => mark(Number(slider.value)));
  watchers.push(show);
  bar.hidden = false;
  show(marked);
}

/** Folded parts are printed too. */
function startPrinting() {
  let opened = [];
  addEventListener("beforeprint", () => {
    opened = [...document.querySelectorAll("details:not([open])")];
    for (const details of opened) details.open = true;
  });
  addEventListener("afterprint", () => {
    for (const details of opened) details.open = false;
  });
}

startBar();
startPrinting();
for (const hint of document.querySelectorAll(".hint")) hint.hidden = false;
