// Wheel, drag, pinch and keys on an element.
import { mark, marked } from "./scans.mjs";

/**
 * Wheel, drag, pinch and keys on an element. `on` has zoom(factor, x, y, event), pan(dx, dy, event), reset() and, where
 * something is marked, hover(x, y), px within the element, and step(by) where that is no scan; click(x, y) where a click, or
 * Enter for the middle, means something. The wheel scrolls the page until the element was clicked.
 */
export function gestures(element, on) {
  const step = on.step || ((by) => mark(marked + by));
  const pointers = new Map();
  let spread = 0;
  let [dragged, isOne] = [0, true]; // px of this gesture, and whether it has one pointer
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
    if (!pointers.size) [dragged, isOne] = [0, true];
    pointers.set(event.pointerId, at(event));
    isOne &&= pointers.size === 1;
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
    dragged += Math.hypot(now[0] - before[0], now[1] - before[1]);
    on.pan(now[0] - before[0], now[1] - before[1], event);
    if (pointers.size > 1 && spread) on.zoom(width() / spread, ...now, event);
    spread = width();
  });
  element.addEventListener("pointerup", (event) => {
    release(event);
    if (on.hover) on.hover(...at(event));
    if (on.click && isOne && dragged < 4) on.click(...at(event));
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
      Enter: on.click && (() => on.click(x, y)),
    }[event.key];
    if (!done) return;
    event.preventDefault();
    done();
  });
}
