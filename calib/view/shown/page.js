// What viser's page lacks: a plot that tells of a range dragged across it, and keys that work
// wherever the focus is.
if (!window.rigcalPage) {
  window.rigcalPage = true;

  // viser tells its server of a widget at most every 50 ms, of a key at once. A key waits for longer
  // than that, so that it comes after the widget that was used before it.
  const AFTER_WIDGETS_MS = 60;
  const NO_TEXT = ["checkbox", "radio", "range", "button", "submit"];
  let chosen = null; // the menu in which an option was chosen last

  const isMenu = (e) => e.ariaHasPopup === "listbox" || e.getAttribute("role") === "combobox";

  // Whether letters belong to what has the focus. A menu takes some to search its options, while
  // they are shown and none of them is chosen yet.
  const takesText = (e) => {
    if (!e?.matches?.("input, textarea, select, [contenteditable=true]")) return false;
    if (e.matches("input") && NO_TEXT.includes(e.type)) return false;
    return !isMenu(e) || (e.ariaExpanded === "true" && e !== chosen);
  };

  document.addEventListener("pointerdown", (e) => {
    if (!e.target.closest?.("[role=option]")) chosen = null;
  }, true);
  document.addEventListener("click", (e) => {
    if (e.target.closest?.("[role=option]")) chosen = document.activeElement;
  }, true);

  window.addEventListener("keydown", (e) => {
    const used = document.activeElement;
    if (!e.key) return; // a browser that fills in a field presses no key
    if (e.key === "Enter" && used?.matches("input")) {
      if (isMenu(used)) chosen = used;
      else used.blur(); // what was written is done
    } else if (e.key === "Tab" || (e.key.startsWith("Arrow") && used === chosen)) {
      chosen = null; // options are shown again
    }
    const plain = !(e.ctrlKey || e.metaKey || e.altKey || e.shiftKey);
    if (e.rigcal || !plain || !/^[np]$/i.test(e.key) || takesText(used)) return;
    e.preventDefault();
    e.stopImmediatePropagation();
    if (e.repeat) return;
    const key = e.key.toLowerCase();
    const again = new KeyboardEvent("keydown", { key, code: e.code, bubbles: true });
    again.rigcal = true;
    setTimeout(() => document.documentElement.dispatchEvent(again), AFTER_WIDGETS_MS);
  }, true);

  // Plots of viser tell a server nothing of what is dragged across them: the range is written into
  // the field, as a person would.
  document.addEventListener("mouseup", () => setTimeout(() => {
    const told = document.querySelector("[data-is=plotted]");
    let panel = told;
    while (panel && !panel.querySelector(".u-over")) panel = panel.parentElement;
    const box = [...(panel?.querySelectorAll(".u-select") ?? [])].find(
      (b) => parseFloat(b.style.width) > 0 && b.dataset.told !== b.style.cssText);
    const label = [...document.querySelectorAll("label")].find((l) => l.textContent === "Light up");
    const field = [...document.querySelectorAll("input")].find(
      (i) => label?.compareDocumentPosition(i) & Node.DOCUMENT_POSITION_FOLLOWING);
    if (!box || !field) return;
    box.dataset.told = box.style.cssText;
    const over = box.closest(".u-over");
    const low = +told.dataset.low, step = (told.dataset.high - low) / over.clientWidth;
    const left = parseFloat(box.style.left), right = left + parseFloat(box.style.width);
    const ends = [left, right].map((px) => +(low + px * step).toPrecision(4));
    Object.getOwnPropertyDescriptor(HTMLInputElement.prototype, "value").set.call(
      field, ends.join(" to "));
    field.dispatchEvent(new Event("input", { bubbles: true }));
  }));
}
