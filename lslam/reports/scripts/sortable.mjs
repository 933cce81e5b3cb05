// Tables that a click on a column's head, or Enter on it, sorts; once more the other way round, then as they were.

/** The first number of a cell, as in "0.12 ± 0.03", "~12.1" or "2/2"; NaN for words. */
export function valueOf(text) {
  const found = text.replaceAll("−", "-").match(/^[~×\s]*(-?\d[\d.]*(?:e[-+]?\d+)?)/i);
  return found ? Number(found[1]) : NaN;
}

/** Order of the cells of a column: numbers by size, else words by letter; what a column of numbers has no number for comes last. */
export function orderOf(texts, isDown) {
  const values = texts.map(valueOf);
  const sign = isDown ? -1 : 1;
  const isNumbers = values.some(Number.isFinite);
  return texts.map((_, k) => k).sort((a, b) => {
    if (!isNumbers) return sign * texts[a].localeCompare(texts[b]) || a - b;
    const [x, y] = [values[a], values[b]];
    if (!Number.isFinite(x) || !Number.isFinite(y)) return Number.isFinite(y) - Number.isFinite(x) || a - b;
    return sign * (x - y) || a - b;
  });
}

export function startSorting() {
  for (const table of document.querySelectorAll("table.sortable")) makeSortable(table);
}

function makeSortable(table) {
  const rows = [...table.tBodies[0].rows];
  if (rows.length < 2) return;
  const heads = [...table.tHead.rows[0].cells];
  heads.forEach((head, column) => {
    const button = document.createElement("button");
    button.type = "button";
    button.append(...head.childNodes);
    head.append(button);
    head.setAttribute("aria-sort", "none");
    button.addEventListener("click", () => {
      const next = { none: "ascending", ascending: "descending", descending: "none" }[head.getAttribute("aria-sort")];
      for (const other of heads) other.setAttribute("aria-sort", "none");
      head.setAttribute("aria-sort", next);
      const texts = rows.map((row) => row.cells[column].textContent.trim());
      const order = next === "none" ? rows.keys() : orderOf(texts, next === "descending");
      table.tBodies[0].append(...[...order].map((k) => rows[k]));
    });
  });
}
