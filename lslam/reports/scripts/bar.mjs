// The bar with the slider over time, and printing.
import { mark, marked, scans, tell, watchers } from "./scans.mjs";

/** The bar with the slider over time and what is known of the marked scan. */
export function startBar() {
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
export function startPrinting() {
  let opened = [];
  addEventListener("beforeprint", () => {
    opened = [...document.querySelectorAll("details:not([open])")];
    for (const details of opened) details.open = true;
  });
  addEventListener("afterprint", () => {
    for (const details of opened) details.open = false;
  });
}
