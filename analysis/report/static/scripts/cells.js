// The cells of the papers' tables: ours, interval, published, difference.
"use strict";

const KINDS = ["ours", "interval", "published", "difference"];
const KIND_WORDS = { ours: "ours", interval: "95 % interval", published: "published", difference: "difference" };

/** Rank marks: never by colour alone, and said to those who cannot see them. */
const RANKS = ["", "best", "second"];

const COVERS = { images: "over images", seeds: "over seeds", "images and seeds": "over images and seeds" };

/** Digits after the point of the printed values, as many as the paper prints. */
function printedDecimals(table) {
  const digits = table.cells.flat().map((cell) => (String(cell.published ?? "").split(".")[1] ?? "").length);
  return Math.max(0, ...digits);
}

/** Whether differences of a cell mean better (1), worse (-1) or neither (0). */
function direction(table, column, difference) {
  if (!isNumber(difference) || table.best[column] === "none" || table.scale === "demo") return 0;
  return Math.sign(table.best[column] === "lowest" ? -difference : difference);
}

function ranked(rank, text) {
  if (!rank) return text;
  const tag = rank === 1 ? "b" : "u";
  return el(tag, { title: `${RANKS[rank]} of the column` }, text, el("span", { class: "hidden" }, ` (${RANKS[rank]})`));
}

/** What a cell shows of one kind; null: nothing. */
function cellPart(table, row, column, kind, notes) {
  const cell = table.cells[row][column];
  if (kind === "ours") return oursPart(table, row, column, notes);
  if (kind === "interval") return isNumber(cell.low) ? `[${fixed(cell.low)}, ${fixed(cell.high)}]` : null;
  if (kind === "published") return isNumber(cell.published) ? ranked(cell.published_rank, fixed(cell.published, table.decimals)) : null;
  if (!isNumber(cell.difference)) return null;
  const way = direction(table, column, cell.difference);
  const words = { 1: "better", 0: "neutral", "-1": "worse" };
  return el("span", { class: `difference ${words[way]}` }, signed(cell.difference), way ? el("span", { class: "hidden" }, ` ${words[way]}`) : null);
}

function oursPart(table, row, column, notes) {
  const cell = table.cells[row][column];
  const note = cell.reason ? el("sup", { title: cell.reason }, notes.mark(cell.reason)) : null;
  if (!cell.runs.length && !isNumber(cell.mean)) return note ? el("span", { class: "muted" }, DASH, note) : null;
  const spread = isNumber(cell.sd) ? el("small", {}, ` ± ${fixed(cell.sd)}`) : null;
  const label = `${table.rows[row]}, ${table.columns[column]}: ${fixed(cell.mean)}; show its runs`;
  const button = el("button", { type: "button", class: "value", "aria-label": label,
    onclick: () => openCell(table, row, column) }, ranked(cell.rank, fixed(cell.mean)), spread);
  return [button, note];
}

/** Footnotes of one table: each sentence once, lettered in order of appearance. */
class Footnotes {
  constructor() {
    this.sentences = [];
  }

  mark(sentence) {
    if (!this.sentences.includes(sentence)) this.sentences.push(sentence);
    return letters(this.sentences.indexOf(sentence));
  }
}

/** 0 -> a, 25 -> z, 26 -> aa. */
function letters(index) {
  const last = String.fromCharCode(97 + (index % 26));
  return index < 26 ? last : letters(Math.floor(index / 26) - 1) + last;
}

/** The panel behind a cell. */
function openCell(table, row, column) {
  const cell = table.cells[row][column];
  const spread = isNumber(cell.sd) ? ` ± ${fixed(cell.sd)}` : "";
  const covers = COVERS[cell.covers] ? ` (95 %, ${COVERS[cell.covers]})` : "";
  const facts = [
    ["ours", el("strong", {}, `${fixed(cell.mean)}${spread}`)],
    ["interval", isNumber(cell.low) ? `[${fixed(cell.low)}, ${fixed(cell.high)}]${covers}` : DASH],
    ["published", fixed(cell.published, table.decimals)],
    ["difference", isNumber(cell.difference) ? signed(cell.difference) : DASH],
    ["seeds", String(cell.seeds)], ["unit", columnUnit(table, column)],
    ...(cell.reason ? [["note", cell.reason]] : []),
    ...(table.scale === "demo" ? [["scale", "demo: compare orders, not values"]] : []),
  ];
  openPanel({
    title: `${table.rows[row]}, ${table.columns[column]}`, subtitle: fullName(table),
    facts: el("dl", {}, facts.map(([name, value]) => [el("dt", {}, name), el("dd", {}, value)])),
    runs: cell.runs, values: valuesByRun(table, row, column), valueName: table.columns[column],
    hash: `cell=${encodeURIComponent(`${table.id}/${row}/${column}`)}`, peers: runsOfTable(table),
  });
}

/** The column's value of each run: as collected, else the run's score of that name; [] if unknown. */
function valuesByRun(table, row, column) {
  const cell = table.cells[row][column];
  if (cell.values.length) return cell.values;
  const values = cell.runs.map((key) => RUNS.get(key)?.scores[table.columns[column]]);
  return values.some(isNumber) ? values : [];
}

function columnUnit(table, column) {
  return table.columns[column] === "Var" ? "squared percent points" : table.unit;
}
