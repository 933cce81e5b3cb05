// The controls above the map.
import { Measure } from "./measure.mjs";
import { Slices } from "./slices.mjs";
import { mapView } from "./view.mjs";

export function startTools(view) {
  const tools = view.figure.querySelector(".tools");
  const find = (name) => tools.querySelector(`[name=${name}]`);
  const output = view.figure.querySelector(".measured");
  const doings = {
    flat: () => view.turnTo(0, 0), turn: () => view.turnTo(0.6, 0.95), in: () => view.zoom(1.4), out: () => view.zoom(1 / 1.4), reset: () => view.reset(),
    fill: () => (document.fullscreenElement ? document.exitFullscreen() : view.figure.requestFullscreen()),
  };
  for (const [name, act] of Object.entries(doings)) tools.querySelector(`[data-do=${name}]`).addEventListener("click", act);
  tools.querySelector("[data-do=fill]").hidden = !document.fullscreenEnabled;
  for (const name of Object.keys(view.known)) find("colour").add(new Option(name));
  const ends = [find("from"), find("to")];
  const showEnds = () => {
    const { ordered } = view.known[find("colour").value];
    for (const [k, end] of ends.entries()) {
      end.value = view.percentiles[k];
      end.disabled = !ordered;
    }
  };
  find("colour").addEventListener("change", () => {
    view.colour(find("colour").value);
    slices.recolour();
    showEnds();
  });
  for (const end of ends) {
    end.addEventListener("input", () => {
      const [from, to] = ends.map((input) => Number(input.value));
      view.spread(Math.min(from, to - 1), Math.max(to, from + 1));
      showEnds();
    });
  }
  find("size").addEventListener("input", () => {
    view.size = Number(find("size").value);
    view.draw();
  });
  find("shade").addEventListener("change", () => {
    view.isShaded = find("shade").checked;
    view.draw();
  });
  new Measure(view, tools.querySelector("[data-do=measure]"), output);
  const slices = new Slices(view, find("section"), find("width"), output);
  showEnds();
  tools.hidden = false;
  tools.querySelector("details").open = view.figure.clientWidth > 700; // not on a phone, nor beside a chart
}

if (mapView?.drawer) startTools(mapView);
