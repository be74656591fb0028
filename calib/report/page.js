"use strict";
// The headings of tables sort them; figures open large, show the numbers under the pointer and are
// zoomed. The page is complete without.

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

// Rows of a CSV file, of which no text has a line break.
function parsed(text) {
  return text.split("\n").map((line) =>
    [...`,${line}`.matchAll(/,(?:"((?:[^"]|"")*)"|([^,]*))/g)].map((cell) =>
      cell[1] === undefined ? cell[2] : cell[1].replaceAll('""', '"')));
}

// "mean, mm" and "1.2345" as "mean: 1.234 mm"; what no axis names, "x" or "y", is its value alone.
function told(label, text) {
  if (!text) return "";
  const cut = label.lastIndexOf(", "), isNumber = Number.isFinite(Number(text));
  const value = isNumber ? `${Number(Number(text).toPrecision(4))}` : text;
  const unit = cut < 0 || !isNumber ? "" : label.slice(cut + 2);
  const name = /^[xy]$/.test(label) ? "" : `${cut < 0 ? label : label.slice(0, cut)}: `;
  return `${name}${value} ${unit}`.trim();
}

// What one row below a heading says, a line each; of a panel whose axis has no name, its title is.
function rowTold(heading, row) {
  const [first, ...labels] = heading;
  if (labels[2] !== "from") return heading.map((label, k) => told(label, row[k])).filter(Boolean);
  const titled = first !== "series", unit = titled && first.includes(", ");
  const names = labels.map((label) => (unit && /^[xy]$/.test(label) ? first : label));
  const places = [0, 1].map((k) => {
    const number = Number.isFinite(Number(row[k + 1]));
    return told(number ? names[k] : labels[k], row[k + 1]);
  });
  const ends = row[3] && `from ${told("x", row[3])} to ${told("x", row[4])}`;
  return [[titled && !unit ? first : "", row[0]].filter(Boolean).join(", "), ...places, ends].filter(Boolean);
}

const NEAR = 18; // of a point, in units of the picture, of which an inch has 72

// What is at a place of the picture: the lines to show and the outline to draw; or nothing.
function found(blocks, rows, x, y) {
  let best = null;
  for (const { row, box, places } of blocks) {
    if (x < box[0] - 4 || x > box[2] + 4 || y < box[1] - 4 || y > box[3] + 4) continue;
    let next = row + 1;
    for (const each of places) {
      if (each.what) {
        const between = (edges, at) => edges.findIndex((e, k) => k && (e - at) * (edges[k - 1] - at) <= 0) - 1;
        const column = between(each.x, x), line = between(each.y, y);
        if (column < 0 || line < 0) continue;
        const [title, across, up, what] = each.what, cells = rows[row + 1 + line];
        const value = cells[column + 1] === "" ? "not seen" : told(what, cells[column + 1]);
        const lines = [title, value, told(across, rows[row][column + 1]), told(up, cells[0])];
        const corner = [each.x[column], each.x[column + 1], each.y[line], each.y[line + 1]];
        best ??= { lines: lines.filter(Boolean), corner, far: NEAR };
        continue;
      }
      each.x.forEach((at, k) => {
        const far = Math.hypot(each.by.includes("x") ? at - x : 0, each.by.includes("y") ? each.y[k] - y : 0);
        if (far <= (best ? best.far : NEAR)) {
          best = { lines: rowTold(rows[row], rows[next + k]), at: [at, each.y[k]], far };
        }
      });
      next += each.x.length;
    }
  }
  return best;
}

function svgElement(name, parts) {
  const made = document.createElementNS("http://www.w3.org/2000/svg", name);
  for (const [key, value] of Object.entries(parts)) made.setAttribute(key, value);
  return made;
}

function outline({ at, corner }) {
  if (at) return svgElement("circle", { class: "found", cx: at[0], cy: at[1], r: 5 });
  const [a, b, c, d] = corner || [0, 0, 0, 0];
  const parts = { x: Math.min(a, b), y: Math.min(c, d), width: Math.abs(b - a), height: Math.abs(d - c) };
  return svgElement("rect", { class: "found", ...parts });
}

// The numbers under the pointer.
function numbers(figure) {
  const svg = figure.querySelector("svg"), box = document.createElement("div");
  const blocks = JSON.parse(figure.dataset.places);
  let rows = null, drawn = null;
  box.className = "told";
  box.setAttribute("role", "status");
  box.hidden = true;
  figure.append(box);
  const end = () => { drawn?.remove(); box.hidden = true; };
  svg.addEventListener("pointerleave", end);
  svg.addEventListener("pointermove", (event) => {
    const address = figure.querySelector("a.csv").href;
    rows ??= parsed(decodeURIComponent(address.slice(address.indexOf(",") + 1)));
    const [x, y] = inside(svg, event), hit = event.buttons ? null : found(blocks, rows, x, y);
    end();
    if (!hit) return;
    box.replaceChildren(...hit.lines.map((line) => {
      const made = document.createElement("div");
      made.textContent = line;
      return made;
    }));
    drawn = svg.appendChild(outline(hit));
    box.hidden = false;
    const { clientX: left, clientY: top } = event, { offsetWidth: wide, offsetHeight: high } = box;
    box.style.left = `${left + wide + 24 > innerWidth ? left - wide - 12 : left + 14}px`;
    box.style.top = `${top + high + 24 > innerHeight ? top - high - 12 : top + 14}px`;
  });
}

// Where the pointer is, in units of the picture.
function inside(svg, event) {
  const at = new DOMPoint(event.clientX, event.clientY).matrixTransform(svg.getScreenCTM().inverse());
  return [at.x, at.y];
}

// A box that is dragged, or the wheel where the figure is open large or with Ctrl, zooms in; a
// double click shows all of it again. The picture keeps its shape, so the page does not move.
function zoom(figure) {
  const svg = figure.querySelector("svg"), whole = svg.getAttribute("viewBox");
  const [, , wide, high] = whole.split(" ").map(Number);
  let begun = null, frame = null;
  const reset = button("Reset zoom", () => show(0, 0, wide));
  reset.hidden = true;
  figure.querySelector(".tools").append(reset);

  function show(left, top, width) {
    const some = Math.min(Math.max(width, wide / 40), wide), tall = (some * high) / wide;
    const x = Math.min(Math.max(left, 0), wide - some), y = Math.min(Math.max(top, 0), high - tall);
    svg.setAttribute("viewBox", some === wide ? whole : `${x} ${y} ${some} ${tall}`);
    reset.hidden = some === wide;
  }
  svg.addEventListener("wheel", (event) => {
    if (!event.ctrlKey && !dialog.open) return;
    event.preventDefault();
    const [x, y] = inside(svg, event), { x: left, y: top, width } = svg.viewBox.baseVal;
    const by = Math.min(width * Math.exp(event.deltaY / 400), wide) / width;
    show(x - (x - left) * by, y - (y - top) * by, width * by);
  }, { passive: false });
  svg.addEventListener("pointerdown", (event) => {
    if (event.button || event.pointerType === "touch") return;
    event.preventDefault(); // no text is selected
    begun = inside(svg, event);
    svg.setPointerCapture(event.pointerId);
  });
  svg.addEventListener("pointermove", (event) => {
    if (!begun) return;
    const [x, y] = inside(svg, event);
    frame?.remove();
    frame = svg.appendChild(outline({ corner: [begun[0], x, begun[1], y] }));
  });
  svg.addEventListener("pointerup", (event) => {
    if (!begun) return;
    const [x, y] = inside(svg, event), [a, b] = begun;
    frame?.remove();
    begun = frame = null;
    const width = Math.max(Math.abs(x - a), (Math.abs(y - b) * wide) / high);
    if (width > 0.02 * wide) show((x + a - width) / 2, (y + b - (width * high) / wide) / 2, width);
    else if (reset.hidden && !dialog.open) enlarge(figure);
  });
  svg.addEventListener("pointercancel", () => { frame?.remove(); begun = frame = null; });
  svg.addEventListener("dblclick", () => show(0, 0, wide));
}

for (const figure of document.querySelectorAll("figure")) {
  figure.querySelector(".tools").append(button("Enlarge", () => enlarge(figure)));
  zoom(figure);
  if (figure.dataset.places) numbers(figure);
}
const hint = document.createElement("p");
hint.className = "hint";
hint.textContent = "Figures: point at them for their numbers, drag a box to zoom in, double-click to zoom out, click to enlarge.";
document.querySelector(".numbers").after(hint);
