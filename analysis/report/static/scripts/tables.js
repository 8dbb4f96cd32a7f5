// Section 2: every table beside the paper.
"use strict";

const shownKinds = new Set(KINDS);
const tableViews = [];

/** Tables of up to this many columns have ours, published, ... beside each other. */
const BESIDE = 3;

for (const table of DATA.tables) {
  table.id = placeName("table", table.name, table.scale, table.extra);
  table.decimals = printedDecimals(table);
  table.isRun = table.cells.flat().some((cell) => cell.runs.length || isNumber(cell.mean));
}

/** The column that a table is about: mIoU, else the first one with mIoU in its name, else the first. */
function mainColumn(table) {
  const named = [table.columns.indexOf("mIoU"), table.columns.findIndex((name) => name.includes("mIoU")), 0];
  return named.find((index) => index >= 0);
}

function renderTables(section) {
  const run = DATA.tables.filter((table) => table.isRun);
  const waiting = DATA.tables.filter((table) => !table.isRun);
  section.append(
    el("p", {}, "Click a number of ours to see the runs behind it: commit, configuration, and the command that repeats them. ",
      el("b", {}, "Bold"), ": best of its column among ours or among the published; ", el("u", {}, "underlined"), ": second best. ", comparisonHint()),
    tableTools());
  section.append(...run.map((table) => tableCard(table)));
  if (!run.length) section.append(el("p", { class: "empty" }, "No row of a table has been run yet."));
  if (waiting.length) section.append(el("h3", { id: "not-run-yet" }, `Not run yet (${waiting.length})`), ...waiting.map(waitingTable));
}

/** What intervals of single rows do not say: a paired difference may be clear where they overlap. */
function comparisonHint() {
  return ["Intervals of single rows do not answer whether two rows differ; ",
    el("code", {}, "rgbt compare a=... b=..."), " does, image by image."];
}

function tableTools() {
  const toggles = KINDS.map((kind) => checkbox(KIND_WORDS[kind], true, (on) => {
    if (on) shownKinds.add(kind); else shownKinds.delete(kind);
    tableViews.forEach((view) => view.draw());
  }));
  const filter = textFilter("Filter rows and tables", (text) => tableViews.forEach((view) => view.filter(text)));
  return el("div", { class: "tools sticky-tools" }, filter, el("fieldset", {}, el("legend", { class: "hidden" }, "Show"), toggles));
}

function tableTitle(table) {
  const scale = table.scale ? el("span", { class: `badge ${table.scale}` }, `${table.scale} scale`) : null;
  const extra = table.extra ? [" ", el("code", { class: "extra", title: "every row of ours was run with it" }, breakable(table.extra))] : null;
  return [el("span", { class: "paper-name" }, `${table.paper} `), `${table.number} `, scale, extra];
}

/** Name and number, and the overrides that every row was run with. */
function fullName(table) {
  return [table.name, table.number, table.extra].filter(Boolean).join(", ");
}

function tableCard(table) {
  const facts = `Published: ${table.data}. Unit: ${table.unit}. ${intervalText(table)}`;
  const view = tableView(table);
  return el("article", { id: table.id, class: "table-card" },
    el("h3", {}, tableTitle(table), el("a", { class: "anchor", href: `#${table.id}`, "aria-label": "Link to this table" }, "#")),
    el("p", { class: "caption" }, table.caption), el("p", { class: "muted" }, facts),
    table.scale === "demo" ? el("p", { class: "demo-note" }, "Demo scale: compare the order of the rows with the paper, not the values.") : null,
    tableChart(table), view.box, view.notes,
    table.command ? [el("p", { class: "muted command-label" }, "Completes this table:"), commandBox(table.command, "the command of the table")] : null);
}

function intervalText(table) {
  const covers = unique(table.cells.flat().map((cell) => cell.covers)).filter((name) => COVERS[name]);
  const seeds = extent(table.cells.flat().filter((cell) => cell.seeds).map((cell) => cell.seeds));
  const count = seeds ? `Ours: mean ± standard deviation over ${unique(seeds).join(" to ")} ${seeds[1] === 1 ? "seed" : "seeds"}. ` : "";
  return count + (covers.length ? `Interval: 95 %, ${covers.map((name) => COVERS[name]).join("; ")}.` : "");
}

function waitingTable(table) {
  const view = tableView(table);
  return el("details", { id: table.id, class: "table-card waiting" },
    el("summary", {}, tableTitle(table), el("span", { class: "muted" }, table.caption)),
    el("p", { class: "muted" }, `Published: ${table.data}. Unit: ${table.unit}.`), view.box, view.notes,
    table.command ? [el("p", { class: "muted command-label" }, "Runs it:"), commandBox(table.command, "the command of the table")] : null);
}

/** Draws one table for the chosen kinds, order and filter. */
function tableView(table) {
  const element = el("table", { class: `results columns-${Math.min(table.columns.length, 20)}` });
  const box = scrollBox(fullName(table), element);
  const notes = el("div", { class: "notes" });
  const state = { sort: { column: null, descending: false }, text: "" };
  const draw = (focused) => {
    const footnotes = new Footnotes();
    const kinds = KINDS.filter((kind) => shownKinds.has(kind) && hasKind(table, kind));
    const layout = table.columns.length <= BESIDE ? besideLayout : stackedLayout;
    element.replaceChildren(el("caption", { class: "hidden" }, `${table.name}: ${table.caption}`),
      ...layout(table, kinds, state.sort, draw, visibleRows(table, state), footnotes));
    notes.replaceChildren(...noteLists(table, footnotes));
    if (focused !== undefined) focusHeader(element, focused);
  };
  const view = { box, notes, draw: () => draw(), filter: (text) => {
    const isNamed = [table.name, table.number, table.caption, table.extra].join(" ").toLowerCase().includes(text);
    state.text = isNamed ? "" : text;
    draw();
    const card = document.getElementById(table.id);
    if (card) card.hidden = !isNamed && !visibleRows(table, state).length;
  } };
  tableViews.push(view);
  draw();
  return view;
}

function hasKind(table, kind) {
  const field = { ours: "runs", interval: "low", published: "published", difference: "difference" }[kind];
  if (kind === "ours") return table.cells.flat().some((cell) => cell.runs.length || cell.reason || isNumber(cell.mean));
  return table.cells.flat().some((cell) => isNumber(cell[field]));
}

/** Indices of the rows that match, in order. Ours sorts first; rows without it follow by their printed value. */
function visibleRows(table, { sort, text }) {
  const rows = table.rows.map((_, index) => index).filter((index) => table.rows[index].toLowerCase().includes(text));
  if (sort.column === null) return rows;
  if (sort.column === -1) return sortedRows(rows, (row) => table.rows[row], sort.descending);
  const cell = (row) => table.cells[row][sort.column];
  const ours = rows.filter((row) => isNumber(cell(row).mean));
  const others = rows.filter((row) => !isNumber(cell(row).mean));
  return [...sortedRows(ours, (row) => cell(row).mean, sort.descending),
    ...sortedRows(others, (row) => cell(row).published, sort.descending)];
}

function columnHead(table, column, sort, draw, attributes = {}) {
  const highFirst = column < 0 ? false : table.best[column] !== "lowest";
  const title = column < 0 ? "row" : breakable(table.columns[column]);
  const arrow = column < 0 || table.best[column] === "none" ? "" : { highest: " ↑", lowest: " ↓" }[table.best[column]];
  const hint = arrow && el("span", { class: "muted", title: `${table.best[column]} is best`, "aria-hidden": "true" }, arrow);
  return sortHeader([title, hint || null], column, sort, () => draw(column + 1), { highFirst, ...attributes });
}

function rowHead(table, row, attributes = {}) {
  const seeds = extent(table.cells[row].map((cell) => cell.seeds || null));
  const proposed = table.proposed[row] ? el("small", { class: "proposed" }, "proposed") : null;
  const counted = seeds ? el("small", { class: "muted" }, `${unique(seeds).join("–")} ${seeds[1] === 1 ? "seed" : "seeds"}`) : null;
  return el("th", { scope: "row", ...attributes }, el("span", { class: "row-name" }, breakable(table.rows[row])), proposed, counted);
}

/** A line per kind inside each cell; a row shows the kinds that one of its cells has. */
function stackedLayout(table, kinds, sort, draw, rows, notes) {
  const columns = table.columns.map((_, index) => index);
  const heads = [columnHead(table, -1, sort, draw), el("th", { class: "kind-name" }, el("span", { class: "hidden" }, "what")),
    ...columns.map((column) => columnHead(table, column, sort, draw, { class: "number" }))];
  const body = rows.map((row) => {
    const parts = kinds.map((kind) => columns.map((column) => cellPart(table, row, column, kind, notes)));
    const there = kinds.map((_, k) => k).filter((k) => parts[k].some((part) => part !== null));
    const line = (k, content) => el("div", { class: `line ${kinds[k]}` }, content ?? "\u00a0");
    return el("tr", {}, rowHead(table, row),
      el("td", { class: "kind-name" }, there.map((k) => line(k, KIND_WORDS[kinds[k]]))),
      columns.map((column) => el("td", { class: "number" }, there.map((k) => line(k, parts[k][column])))));
  });
  return [el("thead", {}, el("tr", {}, heads)), el("tbody", {}, body), orderFoot(table, 1, 1)];
}

/** Kinds side by side under each column, for tables of few columns. */
function besideLayout(table, kinds, sort, draw, rows, notes) {
  const columns = table.columns.map((_, index) => index);
  const span = Math.max(1, kinds.length);
  const heads = [columnHead(table, -1, sort, draw, { rowspan: 2 }),
    ...columns.map((column) => columnHead(table, column, sort, draw, { class: "number group", colspan: span }))];
  const words = columns.flatMap(() => kinds.map((kind) => el("th", { scope: "col", class: `number line ${kind}` }, KIND_WORDS[kind])));
  const body = rows.map((row) => el("tr", {}, rowHead(table, row), columns.flatMap((column) => kinds.map((kind) =>
    el("td", { class: `number line ${kind}` }, cellPart(table, row, column, kind, notes) ?? "")))));
  return [el("thead", {}, el("tr", {}, heads), el("tr", {}, words)), el("tbody", {}, body), orderFoot(table, 0, span)];
}

/** How well the order of ours agrees with the paper's, by column. */
function orderFoot(table, blanks, span) {
  if (!Object.values(table.orders).some(([, rows]) => rows > 0)) return el("tfoot");
  const title = "Spearman's rank correlation between ours and the published values; +1: the same order";
  const cells = table.columns.map((name) => {
    const [rho, rows] = table.orders[name] ?? [null, 0];
    const text = isNumber(rho) ? [`${rho > 0 ? "+" : ""}${fixed(rho)}`, el("small", { class: "muted" }, ` n=${rows}`)] : [DASH];
    return el("td", { class: "number", colspan: span }, text);
  });
  const blank = Array.from({ length: blanks }, () => el("td", { class: "kind-name" }, "ρ"));
  return el("tfoot", {}, el("tr", {}, el("th", { scope: "row", title }, "order of rows", blanks ? null : " (ρ)"), blank, cells));
}

function noteLists(table, footnotes) {
  const reasons = footnotes.sentences.map((text, index) => el("li", {}, el("sup", {}, letters(index)), ` ${text}`));
  const notes = table.notes.map((text) => el("li", {}, text));
  const order = Object.values(table.orders).some(([rho]) => isNumber(rho))
    ? el("li", {}, "order of rows: Spearman's ρ between our means and the published values over n rows; +1 is the same order.") : null;
  if (!reasons.length && !notes.length && !order) return [];
  return [el("ul", {}, reasons, notes, order)];
}
