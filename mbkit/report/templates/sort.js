// Makes tables sort by the column whose head is pressed: up, down, as written. The page reads without it.
"use strict";
const seconds = {"s": 1, "ms": 1e-3, "µs": 1e-6, "ns": 1e-9};

// The first number of a cell, times in seconds: "✓ 1.2e-13", "21.5 µs", "to 1000 N/m". NaN where there is none.
function numberIn(text) {
  const plain = text.replace(/−/g, "-");
  const found = plain.match(/[-+]?(?:∞|\d+(?:\.\d+)?(?:e[-+]?\d+)?)/);
  if (!found) return /\b(?:same|zero)\b/.test(plain) ? 0 : NaN;
  const unit = plain.slice(found.index + found[0].length).trim().split(/\s/)[0];
  return Number(found[0].replace("∞", "Infinity")) * (seconds[unit] || 1);
}

function compare(a, b, down) {
  if (typeof a === "number") {
    // What has no number stands last, up and down.
    if (isNaN(a) || isNaN(b)) return isNaN(a) - isNaN(b);
    return ((a > b) - (a < b)) * down;
  }
  return a.localeCompare(b, "en", {numeric: true}) * down;
}

function sortable(table) {
  const heads = table.tHead && table.tHead.rows.length === 1 ? [...table.tHead.rows[0].cells] : [];
  const rows = [...table.tBodies].flatMap(body => [...body.rows]);
  if (rows.length < 2 || table.querySelector("[rowspan], [colspan]")) return;
  const bodies = rows.map(row => row.parentNode);
  // A group's name is written in its first row; among sorted rows each needs it.
  const blanks = [];
  heads.forEach((_, k) => {
    let name = null;
    for (const row of rows) {
      const cell = row.cells[k];
      if (cell.tagName !== "TH") continue;
      if (cell.textContent.trim()) name = cell;
      else if (name) blanks.push([cell, name]);
    }
  });
  heads.forEach((head, k) => {
    if (!head.textContent.trim()) return;
    const button = document.createElement("button");
    button.type = "button";
    button.title = "Sort by this column";
    button.append(...head.childNodes);
    head.append(button);
    head.setAttribute("aria-sort", "none");
    button.addEventListener("click", () => {
      const next = {none: "ascending", ascending: "descending", descending: "none"}[head.getAttribute("aria-sort")];
      heads.forEach(each => each.hasAttribute("aria-sort") && each.setAttribute("aria-sort", "none"));
      head.setAttribute("aria-sort", next);
      for (const [cell, name] of blanks) {
        cell.replaceChildren(...(next === "none" ? [] : [...name.childNodes].map(node => node.cloneNode(true))));
      }
      if (next === "none") {
        rows.forEach((row, n) => bodies[n].append(row));
        return;
      }
      const numeric = head.classList.contains("n");
      const keys = new Map(rows.map(row => {
        const text = row.cells[k].textContent.trim();
        return [row, numeric ? numberIn(text) : text];
      }));
      const down = next === "descending" ? -1 : 1;
      rows.slice().sort((a, b) => compare(keys.get(a), keys.get(b), down)).forEach(row => bodies[0].append(row));
    });
  });
}

document.querySelectorAll("table:not(.map)").forEach(sortable);
