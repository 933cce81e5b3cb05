// Pictures that zoom and pan, and say what their points are.
import { KEYS } from "./elements.mjs";
import { gestures } from "./gestures.mjs";
import { clamp, nearestBy } from "./numbers.mjs";

/** A picture within its frame: zoomed about the pointer, never smaller than it is at first; it says what its points are. */
export function startPicture(frame) {
  const picture = frame.querySelector("img");
  const points = JSON.parse(frame.querySelector("script")?.textContent || "[]"); // [x, y, text], shares of the picture
  const said = frame.parentElement.querySelector(".told");
  const ring = document.createElement("i");
  let [k, x, y, told] = [1, 0, 0, -1];
  const place = ([u, v]) => [x + u * picture.offsetWidth * k, y + v * picture.offsetHeight * k];
  const show = () => {
    x = clamp(x, frame.clientWidth - picture.offsetWidth * k, 0);
    y = clamp(y, frame.clientHeight - picture.offsetHeight * k, 0);
    picture.style.transform = `translate(${x}px, ${y}px) scale(${k})`;
    frame.classList.toggle("moved", k > 1);
    ring.hidden = told < 0;
    if (told >= 0) [ring.style.left, ring.style.top] = place(points[told]).map((px) => `${px}px`);
  };
  const tell = (which) => {
    told = which;
    const isThere = ([u, v]) => Math.hypot(u - points[told][0], v - points[told][1]) < 1e-3; // several curves may go through it
    if (told >= 0) said.textContent = points.filter(isThere).map((point) => point[2]).join("; ");
    show();
  };
  frame.setAttribute("role", "group");
  frame.setAttribute("aria-label", `${picture.alt}: ${KEYS}${points.length ? "; comma and full stop go from point to point" : ""}`);
  if (points.length) {
    ring.className = "ring";
    frame.append(ring);
    said.hidden = false;
    said.textContent = "Point at a value, or press comma and full stop: what it is stands here.";
  } else frame.title = KEYS;
  show();
  gestures(frame, {
    zoom: (factor, px, py) => {
      const next = clamp(k * factor, 1, 20);
      [x, y, k] = [px - ((px - x) * next) / k, py - ((py - y) * next) / k, next];
      show();
    },
    pan: (dx, dy) => { [x, y] = [x + dx, y + dy]; show(); },
    reset: () => { [k, x, y] = [1, 0, 0]; show(); },
    hover: (px, py) => {
      const away = points.map((point) => { const [u, v] = place(point); return Math.hypot(u - px, v - py); });
      const nearest = nearestBy(away, 0);
      if (nearest >= 0 && away[nearest] < 20) tell(nearest);
    },
    step: (by) => { if (points.length) tell(clamp(told + by, 0, points.length - 1)); },
  });
}

export function startPictures() {
  document.querySelectorAll(".picture").forEach(startPicture);
}
