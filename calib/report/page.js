"use strict";
// The headings of tables sort them, and figures open large; the page is complete without.

const words = new Intl.Collator("en", { numeric: true });

function button(text, act) {
  const made = document.createElement("button");
  made.type = "button";
  made.textContent = text;
  made.addEventListener("click", act);
  return made;
}

// What a cell is sorted by: its number, or its text.
function key(row, column) {
  const cell = row.cells[column], number = cell.querySelector("data");
  return number ? Number(number.value) : cell.textContent.trim();
}

// Numbers before texts; an empty cell comes last, whichever way is up.
function compared(a, b, way) {
  if (a === "" || b === "") return (a === "") - (b === "");
  if (typeof a !== typeof b) return typeof a === "number" ? -1 : 1;
  return way * (typeof a === "number" ? a - b : words.compare(a, b));
}

function sort(table, heading) {
  const way = heading.getAttribute("aria-sort") === "ascending" ? -1 : 1;
  for (const each of table.tHead.rows[0].cells) each.removeAttribute("aria-sort");
  heading.setAttribute("aria-sort", way > 0 ? "ascending" : "descending");
  const column = heading.cellIndex, body = table.tBodies[0];
  const rows = [...body.rows].sort((a, b) => compared(key(a, column), key(b, column), way));
  body.append(...rows);
}

for (const table of document.querySelectorAll("table.sortable")) {
  for (const heading of table.tHead.rows[0].cells) {
    const sorter = button(heading.textContent, () => sort(table, heading));
    heading.replaceChildren(sorter);
  }
}

// A figure that is open large stands in the dialog; `place` keeps its place in the page.
const dialog = document.body.appendChild(document.createElement("dialog"));
const place = document.createElement("div");

function enlarge(figure) {
  if (dialog.open) return dialog.close();
  place.className = figure.className;
  place.style.height = `${figure.offsetHeight}px`;
  figure.replaceWith(place);
  dialog.replaceChildren(figure);
  dialog.setAttribute("aria-label", figure.querySelector("h4").textContent);
  figure.querySelector("button").textContent = "Close";
  dialog.showModal();
}

dialog.addEventListener("close", () => {
  const figure = dialog.querySelector("figure"), opener = figure.querySelector("button");
  place.replaceWith(figure);
  opener.textContent = "Enlarge";
  opener.focus({ preventScroll: true });
});
dialog.addEventListener("click", (event) => {
  if (event.target === dialog || event.target.closest("a[href^='#']")) dialog.close();
});

for (const figure of document.querySelectorAll("figure")) {
  figure.querySelector(".tools").append(button("Enlarge", () => enlarge(figure)));
  figure.querySelector("svg").addEventListener("click", () => {
    if (getSelection().isCollapsed) enlarge(figure);
  });
}
