// The small chart of a table: ours with its interval, and the published value, by row.
"use strict";

const ROW_HEIGHT = 24;
const CHART_TOP = 34;

function tableChart(table) {
  const state = { column: mainColumn(table) };
  const made = chart((width) => drawTableChart(table, state.column, width));
  const options = table.columns.map((name, index) => [String(index), name]);
  const select = choice("Chart of", options, String(state.column), (value) => {
    state.column = Number(value);
    made.redraw();
  });
  return el("div", { class: "table-chart" }, el("div", { class: "tools" }, select, chartKey()), made.holder);
}

function chartKey() {
  const ours = svg("svg", { width: 34, height: 14, "aria-hidden": "true" },
    svg("line", { class: "ours-line", x1: 2, x2: 32, y1: 7, y2: 7 }), svg("circle", { class: "ours-mark", cx: 17, cy: 7, r: 4.5 }));
  const published = svg("svg", { width: 18, height: 14, "aria-hidden": "true" }, marker("diamond", 9, 7, 4, { class: "published-mark" }));
  const run = svg("svg", { width: 14, height: 14, "aria-hidden": "true" }, svg("circle", { class: "run-mark", cx: 7, cy: 7, r: 2.2 }));
  const entry = (mark, text) => el("span", {}, mark, text);
  return el("span", { class: "key" }, entry(ours, "ours, mean and 95 % interval"), entry(run, "one run"), entry(published, "published"));
}

/** Rows below each other. At demo scale the values are not comparable, so each has its own axis. */
function drawTableChart(table, column, width) {
  const rows = table.rows.map((label, index) => ({ label, index, cell: table.cells[index][column] }))
    .filter(({ cell }) => isNumber(cell.mean) || isNumber(cell.published));
  if (!rows.length) return el("p", { class: "empty" }, `${table.columns[column]}: nothing to draw.`);
  const labels = Math.min(width * 0.3, Math.max(60, ...rows.map((row) => row.label.length * 7.3 + 14)));
  const height = CHART_TOP + rows.length * ROW_HEIGHT + 42;
  const name = `${table.name} ${table.columns[column]}`;
  const size = { rows, left: labels, right: width - 16, bottom: CHART_TOP + rows.length * ROW_HEIGHT, values: (r) => valuesByRun(table, r, column) };
  const names = rows.map((row, at) => cutText(row.label, labels - 8, { x: labels - 10, y: rowY(at) + 4, "text-anchor": "end", class: "row-label" }));
  const unit = table.columns[column] === "Var" ? "squared percent points" : table.unit;
  const panels = table.scale === "demo" ? apartPanels(size, unit) : [togetherPanel(size, unit)];
  const stripes = rows.map((_, at) => (at % 2 ? null : svg("rect", { class: "stripe", x: 0, y: rowY(at) - ROW_HEIGHT / 2, width, height: ROW_HEIGHT })));
  return drawing(width, height, `${name}: ours and published by row`, stripes, names, panels);
}

function rowY(at) {
  return CHART_TOP + (at + 0.5) * ROW_HEIGHT;
}

function oursValues({ rows, values }) {
  return rows.flatMap(({ cell, index }) => [cell.mean, cell.low, cell.high, ...values(index)]);
}

function togetherPanel(size, unit) {
  const x = linear([...oursValues(size), ...size.rows.map(({ cell }) => cell.published)], size.left, size.right);
  return [xAxis(x, CHART_TOP, size.bottom, unit), publishedMarks(size, x), oursMarks(size, x)];
}

function apartPanels(size, unit) {
  const printed = size.rows.map(({ cell }) => cell.published);
  if (!printed.some(isNumber)) return [togetherPanel(size, unit)];
  const middle = size.left + (size.right - size.left) * 0.58;
  const left = linear(oursValues(size), size.left, middle - 12);
  const right = linear(printed, middle + 12, size.right);
  const title = (x, text) => svg("text", { class: "panel-title", x, y: CHART_TOP - 12 }, text);
  return [title(size.left, "ours (demo scale)"), title(middle + 12, size.right - middle > 150 ? "published, own axis" : "published"),
    xAxis(left, CHART_TOP, size.bottom, unit), xAxis(right, CHART_TOP, size.bottom, unit), oursMarks(size, left), publishedMarks(size, right)];
}

function oursMarks({ rows, values }, x) {
  return rows.map(({ cell, index, label }, at) => {
    if (!isNumber(cell.mean)) return null;
    const y = rowY(at);
    const interval = isNumber(cell.low) ? svg("path", { class: "ours-line",
      d: `M${x(cell.low)} ${y}H${x(cell.high)}M${x(cell.low)} ${y - 4}V${y + 4}M${x(cell.high)} ${y - 4}V${y + 4}` }) : null;
    const runs = values(index).filter(isNumber).map((value) => svg("circle", { class: "run-mark", cx: x(value), cy: y + 7, r: 2.2 }));
    const range = isNumber(cell.low) ? ` [${fixed(cell.low)}, ${fixed(cell.high)}]` : "";
    return [interval, runs, svg("circle", { class: "ours-mark", cx: x(cell.mean), cy: y, r: 4.5 }, svg("title", {}, `${label}: ${fixed(cell.mean)}${range}`))];
  });
}

function publishedMarks({ rows }, x) {
  return rows.map(({ cell, label }, at) => (isNumber(cell.published)
    ? marker("diamond", x(cell.published), rowY(at), 4, { class: "published-mark", "aria-label": `${label}: ${cell.published} published` }) : null));
}
