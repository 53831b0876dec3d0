"use strict";
// Sorting by any column, filters, sets of columns and the figure of the map of objects.
document.documentElement.classList.add("js");

function sortBy(table, head) {
  const column = head.cellIndex;
  const first = head.dataset.sort;
  const now = head.getAttribute("aria-sort");
  const order = now === first ? (first === "ascending" ? "descending" : "ascending") : first;
  for (const other of table.tHead.querySelectorAll("th[aria-sort]")) other.removeAttribute("aria-sort");
  head.setAttribute("aria-sort", order);
  const sign = order === "ascending" ? 1 : -1;
  const value = (row) => row.cells[column].dataset.value;
  const rows = Array.from(table.tBodies[0].rows);
  rows.sort((a, b) => {
    const x = value(a), y = value(b);
    if (x === "" || y === "") return (x === "") - (y === ""); // what is missing stays below
    const p = Number(x), q = Number(y);
    return sign * (isNaN(p) || isNaN(q) ? x.localeCompare(y) : p - q);
  });
  table.tBodies[0].append(...rows);
}

for (const table of document.querySelectorAll("table.sortable")) {
  for (const head of table.tHead.querySelectorAll("th[data-sort]")) {
    const button = document.createElement("button");
    button.type = "button";
    while (head.firstChild) button.appendChild(head.firstChild);
    head.appendChild(button);
    button.addEventListener("click", () => sortBy(table, head));
  }
}

for (const form of document.querySelectorAll(".controls[data-for]")) {
  const number = form.dataset.for;
  const table = document.getElementById("entries-" + number);
  const rows = Array.from(table.tBodies[0].rows);
  const others = Array.from(document.getElementById("heat-" + number).tBodies[0].rows);
  const filters = Array.from(form.querySelectorAll("[data-filter]"));
  const view = form.querySelector("[data-view]");
  const output = form.querySelector("output");

  const fits = (row) => filters.every((filter) => {
    const wanted = filter.value.trim();
    if (wanted === "") return true;
    if (filter.dataset.filter !== "text") return row.dataset[filter.dataset.filter] === wanted;
    const text = row.querySelector("th").textContent + " " + row.dataset.reconstructor;
    return text.toLowerCase().includes(wanted.toLowerCase());
  });
  const update = () => {
    const hidden = new Set();
    for (const row of rows) {
      row.hidden = !fits(row);
      if (row.hidden) hidden.add(Number(row.dataset.entry));
    }
    for (const row of others) row.hidden = hidden.has(Number(row.dataset.entry));
    output.textContent = (rows.length - hidden.size) + " of " + rows.length + " entries";
    document.dispatchEvent(new CustomEvent("entries", { detail: { table: Number(number) - 1, hidden } }));
  };
  const columns = () => { table.dataset.columns = view.value; };
  for (const filter of filters) filter.addEventListener("input", update);
  view.addEventListener("change", columns);
  form.addEventListener("submit", (event) => event.preventDefault());
  form.addEventListener("reset", () => setTimeout(() => { update(); columns(); }));
  form.reset(); // a reloaded page remembers what was chosen, and its rows do not
}
