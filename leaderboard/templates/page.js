"use strict";
document.documentElement.classList.add("js");
for (const table of document.querySelectorAll("table.sortable")) {
  const body = table.tBodies[0];
  table.tHead.querySelectorAll("th[data-sort]").forEach((head) => {
    const column = head.cellIndex;
    const button = document.createElement("button");
    button.type = "button";
    while (head.firstChild) button.appendChild(head.firstChild);
    head.appendChild(button);
    button.addEventListener("click", () => {
      const now = head.getAttribute("aria-sort");
      const first = head.dataset.sort;
      const order = now === first ? (first === "ascending" ? "descending" : "ascending") : first;
      for (const other of table.tHead.querySelectorAll("th[aria-sort]")) other.removeAttribute("aria-sort");
      head.setAttribute("aria-sort", order);
      const sign = order === "ascending" ? 1 : -1;
      const value = (row) => row.cells[column].dataset.value;
      const rows = Array.from(body.rows);
      rows.sort((a, b) => {
        const x = value(a), y = value(b);
        if (x === "" || y === "") return (x === "") - (y === "");
        const p = Number(x), q = Number(y);
        return sign * (isNaN(p) || isNaN(q) ? x.localeCompare(y) : p - q);
      });
      body.append(...rows);
    });
  });
}
for (const controls of document.querySelectorAll(".controls")) {
  const rows = document.querySelectorAll("[data-table='" + controls.dataset.for + "'] tbody tr");
  const unranked = controls.querySelector("input");
  let chosen = "";
  const update = () => {
    for (const row of rows) {
      const other = chosen !== "" && row.dataset.reconstructor !== chosen;
      row.hidden = other || (!unranked.checked && row.dataset.ranked === "no");
    }
  };
  for (const button of controls.querySelectorAll("button")) {
    button.addEventListener("click", () => {
      chosen = button.value;
      for (const other of controls.querySelectorAll("button")) other.setAttribute("aria-pressed", String(other === button));
      update();
    });
  }
  unranked.addEventListener("change", update);
}
