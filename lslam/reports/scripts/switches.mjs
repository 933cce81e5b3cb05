// Switches of trajectories: which of them are shown, in every chart and on the map, and whether as they were before.
import { sessions } from "./sessions.mjs";

/** Start the boxes and buttons; `redraw` draws the map anew. */
export function startSwitches(redraw) {
  const boxes = [...document.querySelectorAll("input[data-style]")];
  for (const box of boxes) {
    box.addEventListener("change", () => {
      const { style } = box.dataset;
      for (const other of boxes) if (other.dataset.style === style) other.checked = box.checked;
      document.body.classList.toggle(`without-${style}`, !box.checked);
      for (const way of sessions?.sessions ?? []) if (way.style === style) way.isHidden = !box.checked;
      redraw();
    });
  }
  const buttons = [...document.querySelectorAll("button[data-ways]")];
  for (const button of buttons) {
    button.addEventListener("click", () => {
      for (const other of buttons) other.setAttribute("aria-pressed", String(other === button));
      sessions.isBefore = button.dataset.ways === "before";
      redraw();
    });
  }
  for (const part of document.querySelectorAll(".switches")) part.hidden = false;
}
