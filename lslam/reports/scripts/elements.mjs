// Elements of the page, and the data that they hold.

export const KEYS = "click, then scroll; + and − zoom, arrows pan, 0 shows all";

export function read(id) {
  const element = globalThis.document?.getElementById(id);
  return element ? JSON.parse(element.textContent) : null;
}

export function make(name, attributes, parent) {
  const element = document.createElementNS("http://www.w3.org/2000/svg", name);
  for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
  if (parent) parent.appendChild(element);
  return element;
}
