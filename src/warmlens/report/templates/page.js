
"use strict";

// Tables: a click on a header sorts by that column, a second one turns the order round.
for (const head of document.querySelectorAll("th[aria-sort]")) {
  head.querySelector("button").addEventListener("click", () => {
    const ascending = head.getAttribute("aria-sort") !== "ascending";
    for (const other of head.parentElement.children) {
      if (other.hasAttribute("aria-sort")) other.setAttribute("aria-sort", "none");
    }
    head.setAttribute("aria-sort", ascending ? "ascending" : "descending");
    const body = head.closest("table").tBodies[0];
    const key = (row) => cellValue(row.cells[head.cellIndex]);
    const compare = head.dataset.kind === "number"
      ? (a, b) => Number(key(a)) - Number(key(b))
      : (a, b) => key(a).localeCompare(key(b), "en");
    body.append(...[...body.rows].sort((a, b) => (ascending ? compare(a, b) : compare(b, a))));
  });
}

function cellValue(cell) {
  return cell.dataset.value ?? cell.textContent.trim();
}

// Filters: a row stays if every column lies between the limits that are given.
for (const form of document.querySelectorAll("form.filter")) {
  const rows = [...document.getElementById(form.dataset.table).tBodies[0].rows];
  const show = () => {
    let shown = 0;
    for (const row of rows) {
      row.hidden = ![...form.querySelectorAll("input")].every((input) => {
        const limit = input.value.trim() === "" ? NaN : Number(input.value);
        if (Number.isNaN(limit)) return true;
        const value = Number(cellValue(row.cells[input.dataset.column]));
        return input.dataset.edge === "low" ? value >= limit : value <= limit;
      });
      shown += row.hidden ? 0 : 1;
    }
    form.querySelector("output").textContent = `${shown} of ${rows.length} samples shown`;
  };
  form.addEventListener("input", show);
  form.addEventListener("reset", () => setTimeout(show));
  form.addEventListener("submit", (event) => event.preventDefault());
}

// Figures: a click shows one at full size.
for (const button of document.querySelectorAll("button.zoom")) {
  button.addEventListener("click", () => {
    const dialog = document.createElement("dialog");
    dialog.className = "viewer";
    const close = document.createElement("button");
    close.type = "button";
    close.textContent = "Close";
    close.addEventListener("click", () => dialog.close());
    const small = button.querySelector("img");
    const width = Math.min(small.naturalWidth, Math.max(1000, innerWidth - 40));
    const large = new Image(width, Math.round(width * small.naturalHeight / small.naturalWidth));
    large.src = small.src;
    large.alt = small.alt;
    dialog.append(close, large);
    dialog.addEventListener("close", () => { dialog.remove(); button.focus(); });
    document.body.append(dialog);
    dialog.showModal();
  });
}

// Paper: what is folded on the screen is printed too.
const folded = () => document.querySelectorAll("details:not([open])");
let opened = [];
addEventListener("beforeprint", () => { opened = [...folded()]; for (const item of opened) item.open = true; });
addEventListener("afterprint", () => { for (const item of opened) item.open = false; });
