// Tables whose columns sort: headers are buttons, blanks stay last.
"use strict";

/**
 * `rows` in order of `value`; numbers by size, else by text; null and "" always last.
 * Without a value function: as given.
 */
function sortedRows(rows, value, descending) {
  if (!value) return [...rows];
  const isBlank = (v) => v === null || v === undefined || v === "" || Number.isNaN(v);
  const keyed = rows.map((row, index) => ({ row, index, v: value(row) }));
  keyed.sort((a, b) => {
    if (isBlank(a.v) || isBlank(b.v)) return isBlank(a.v) - isBlank(b.v) || a.index - b.index;
    const way = typeof a.v === "number" && typeof b.v === "number"
      ? a.v - b.v
      : String(a.v).localeCompare(String(b.v), "en", { numeric: true });
    return (descending ? -way : way) || a.index - b.index;
  });
  return keyed.map((entry) => entry.row);
}

/**
 * A header cell that sorts. Clicks go: best first, the other way, as given.
 * `sort` is {column, descending}; `onSort` draws the table again.
 */
function sortHeader(title, column, sort, onSort, { highFirst = true, ...attributes } = {}) {
  const active = sort.column === column;
  const state = active ? (sort.descending ? "descending" : "ascending") : "none";
  const mark = { descending: "▼", ascending: "▲", none: "" }[state];
  const button = el("button", { type: "button", class: "sort" }, el("span", {}, title),
    el("span", { class: "mark", "aria-hidden": "true" }, mark));
  button.addEventListener("click", () => {
    if (!active) Object.assign(sort, { column, descending: highFirst });
    else if (sort.descending === highFirst) sort.descending = !highFirst;
    else Object.assign(sort, { column: null, descending: false });
    onSort(column);
  });
  return el("th", { scope: "col", "aria-sort": state, ...attributes }, button);
}

/** Put the focus back on the header after the table was drawn again. */
function focusHeader(table, index) {
  table.querySelectorAll("th .sort")[index]?.focus();
}

/**
 * A plain sortable table.
 * columns: {title, show(row) -> node or text, sort(row) -> value, number, highFirst}; the first one
 * labels the row. Returns {box, update(rows)}.
 */
function sortableTable(label, columns, { sort = { column: null, descending: false }, rowClass } = {}) {
  const table = el("table", { class: "plain" });
  let current = [];
  const draw = () => {
    const headers = columns.map((column, index) => header(column, index));
    const value = sort.column === null ? null : columns[sort.column].sort;
    const body = sortedRows(current, value, sort.descending).map((row) =>
      el("tr", { class: rowClass?.(row) }, columns.map((column, index) => cell(column, index, row))));
    table.replaceChildren(el("caption", { class: "hidden" }, label),
      el("thead", {}, el("tr", {}, headers)), el("tbody", {}, body));
  };
  const header = (column, index) => {
    const classes = column.number ? "number" : null;
    if (!column.sort) return el("th", { scope: "col", class: classes }, column.title);
    const redraw = (chosen) => {
      draw();
      focusHeader(table, columns.slice(0, chosen).filter((c) => c.sort).length);
    };
    const highFirst = column.highFirst ?? Boolean(column.number);
    return sortHeader(column.title, index, sort, redraw, { highFirst, class: classes });
  };
  const cell = (column, index, row) => {
    const attributes = { class: column.number ? "number" : column.class };
    const tag = index === 0 ? "th" : "td";
    return el(tag, index === 0 ? { scope: "row", ...attributes } : attributes, column.show(row));
  };
  const update = (rows) => {
    current = rows;
    draw();
  };
  return { box: scrollBox(label, table), update };
}
