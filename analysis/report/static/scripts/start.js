// Draws the page: sections in order, contents, theme, addresses behind #.
"use strict";

const RENDER = {
  summary: renderSummary, tables: renderTables, runs: renderRuns, regions: renderRegions,
  searches: renderSearches, masks: renderMasks, differences: renderDifferences,
};

for (const [name, render] of Object.entries(RENDER)) render(document.getElementById(name));

/** The contents: sections, and below them what has a place of its own. */
function drawContents() {
  const below = {
    tables: [...DATA.tables.filter((table) => table.isRun).map((table) => [table.id, contentsName(table)]),
      ...(DATA.tables.some((table) => !table.isRun) ? [["not-run-yet", "not run yet"]] : [])],
    searches: DATA.studies.map((study) => [study.id, study.name]),
  };
  const link = ([id, text]) => el("li", {}, el("a", { href: `#${id}` }, text));
  const entries = Object.keys(RENDER).map((id) => {
    const heading = document.getElementById(`${id}-heading`).textContent;
    return el("li", {}, el("a", { href: `#${id}`, class: "section-link" }, heading),
      below[id]?.length ? el("ul", {}, below[id].map(link)) : null);
  });
  document.getElementById("navigation").append(el("ul", {}, entries));
}

/** A table run at two scales, or with overrides, stands twice: its name there says which it is. */
function contentsName(table) {
  const twice = DATA.tables.filter((other) => other.name === table.name).length > 1;
  const which = twice ? [table.scale, table.extra].filter(Boolean).join(", ") : table.extra;
  return [`${table.paper}, ${table.number}`, which ? breakable(` (${which})`) : null];
}

/** Marks in the contents where the reader is. */
function followReading() {
  const links = new Map([...document.querySelectorAll("#navigation a")].map((a) => [a.hash.slice(1), a]));
  const places = [...links.keys()].map((id) => document.getElementById(id)).filter(Boolean);
  const mark = () => {
    const passed = places.filter((place) => place.getBoundingClientRect().top < 120);
    const current = passed.length ? passed[passed.length - 1].id : places[0]?.id;
    for (const [id, a] of links) {
      if (id === current) a.setAttribute("aria-current", "location"); else a.removeAttribute("aria-current");
    }
  };
  let waiting = false;
  addEventListener("scroll", () => {
    if (waiting) return;
    waiting = true;
    requestAnimationFrame(() => { waiting = false; mark(); });
  }, { passive: true });
  mark();
}

/** What a part of an address stands for; as it is where it was not written by this page ("50%"). */
function decoded(part) {
  try {
    return decodeURIComponent(part);
  } catch (error) {
    return part;
  }
}

/** Open what the address names: a run, a cell, a trial, or a place inside something folded. */
function openHash() {
  const hash = location.hash.slice(1);
  const [kind, value] = hash.split("=").map(decoded);
  if (kind === "run" && value) return openRun(value);
  if (kind === "cell" && value) return openCellAt(value.split("/"));
  if (kind === "trial" && value) return openTrialAt(value.split("/"));
  const place = hash && document.getElementById(hash);
  if (!place) return undefined;
  for (let node = place; node; node = node.parentElement) if (node.tagName === "DETAILS") node.open = true;
  return place.scrollIntoView({ behavior: "instant" });
}

function openCellAt([id, row, column]) {
  const table = DATA.tables.find((each) => each.id === id);
  if (table?.cells[row]?.[column]) openCell(table, Number(row), Number(column));
}

function openTrialAt([id, number]) {
  const study = DATA.studies.find((each) => each.id === id);
  const trial = study?.trials.find((each) => each.number === Number(number));
  if (trial) openTrial(study, trial);
}

function startTheme() {
  const button = document.getElementById("theme");
  const themes = ["auto", "light", "dark"];
  let theme = rememberedTheme();
  const name = () => (button.textContent = `Theme: ${theme}`);
  button.addEventListener("click", () => {
    theme = themes[(themes.indexOf(theme) + 1) % themes.length];
    applyTheme(theme);
    name();
  });
  name();
}

function startMenu() {
  const button = document.getElementById("menu");
  const open = (on) => {
    document.body.classList.toggle("menu-open", on);
    button.setAttribute("aria-expanded", on);
  };
  button.addEventListener("click", () => open(!document.body.classList.contains("menu-open")));
  document.getElementById("navigation").addEventListener("click", (event) => {
    if (event.target.closest("a")) open(false);
  });
}

/** Paper shows what a click would: folded parts that hold results are opened, and closed again. */
function startPrinting() {
  let opened = [];
  addEventListener("beforeprint", () => {
    opened = [...document.querySelectorAll("main details:not(.waiting):not([open])")];
    opened.forEach((details) => (details.open = true));
  });
  addEventListener("afterprint", () => opened.forEach((details) => (details.open = false)));
}

function startResizing() {
  let width = chartWidth();
  let timer;
  addEventListener("resize", () => {
    clearTimeout(timer);
    timer = setTimeout(() => {
      if (chartWidth() === width) return;
      width = chartWidth();
      redraws.forEach((redraw) => redraw());
    }, 120);
  });
}

drawContents();
startTheme();
startMenu();
startPrinting();
startResizing();
followReading();
addEventListener("hashchange", openHash);
openHash();
document.documentElement.dataset.drawn = "yes";
