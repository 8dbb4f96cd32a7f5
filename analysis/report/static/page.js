// What moves on the page: sorting, filters, the panel behind a number, charts, theme, contents.
"use strict";

const DATA = JSON.parse(document.getElementById("data").textContent);
const DASH = "–";
const panel = document.getElementById("panel");

/** An element; children are nodes or text, never markup. */
function el(tag, attributes = {}, ...children) {
  const node = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (value !== null && value !== undefined && value !== false) node.setAttribute(name, value);
  }
  node.append(...children.flat(Infinity).filter((child) => child !== null && child !== undefined));
  return node;
}

function fixed(value, decimals = 2) {
  return Number.isFinite(value) ? value.toFixed(decimals).replace("-", "−") : DASH;
}

function plural(count, word) {
  return `${count} ${word}${count === 1 ? "" : "s"}`;
}

function unique(values) {
  return [...new Set(values)];
}

/** Tell people who cannot see the change. */
function say(text) {
  document.getElementById("said").textContent = text;
}

// Sorting: headers of `table.sortable` are buttons. A cell sorts by data-v, else by its text; blanks
// stay last, in the order of data-w. Clicks go: best first, the other way, as given.

/** The key of a cell: [0, number or text], or [1, second value] where it is blank. */
function sortKey(cell) {
  const text = cell.dataset.v ?? cell.textContent.trim().split(" ± ")[0];
  const number = Number(text.replace("−", "-"));
  if (text === "" || text === DASH) return [1, Number(cell.dataset.w ?? NaN)];
  return [0, Number.isFinite(number) ? number : text];
}

function compareKeys(a, b, sign) {
  if (a[0] !== b[0]) return a[0] - b[0];
  const blank = (v) => Number.isNaN(v);
  if (blank(a[1]) || blank(b[1])) return blank(a[1]) - blank(b[1]);
  if (typeof a[1] === "number" && typeof b[1] === "number") return sign * (a[1] - b[1]);
  return sign * String(a[1]).localeCompare(String(b[1]), "en", { numeric: true });
}

function sortable(table) {
  const heads = [...table.tHead.rows[0].cells];
  const body = table.tBodies[0];
  const given = [...body.rows];
  heads.forEach((head, column) => {
    head.replaceChildren(el("button", { type: "button", class: "sort" }, ...head.childNodes));
    head.setAttribute("aria-sort", "none");
    head.firstChild.addEventListener("click", () => {
      const first = head.dataset.first ?? (head.classList.contains("number") ? "descending" : "ascending");
      const other = first === "descending" ? "ascending" : "descending";
      const way = { none: first, [first]: other, [other]: "none" }[head.getAttribute("aria-sort")];
      heads.forEach((each) => each.setAttribute("aria-sort", each === head ? way : "none"));
      const keyed = given.map((row) => [row, sortKey(row.cells[column])]);
      if (way !== "none") keyed.sort((a, b) => compareKeys(a[1], b[1], way === "ascending" ? 1 : -1));
      body.append(...keyed.map(([row]) => row));
    });
  });
  return table;
}

// Filters: a card ([data-names]) or row ([data-row]) is shown where all typed words are in its text.

function filter(field) {
  const words = field.value.trim().toLowerCase().split(/\s+/);
  const matches = (text) => words.every((word) => text.includes(word));
  for (const card of document.querySelectorAll(`${field.dataset.filter} [data-names]`)) {
    const named = matches(card.dataset.names);
    const rows = [...card.querySelectorAll("[data-row]")];
    rows.forEach((row) => (row.hidden = !named && !matches(row.dataset.row)));
    card.hidden = !named && rows.every((row) => row.hidden);
    for (const folded of card.querySelectorAll("details.not-run")) {
      folded.open = !!words[0] && [...folded.querySelectorAll("[data-row]")].some((row) => !row.hidden);
    }
  }
}

// The panel: where a number comes from. DATA.panels by address: {title, subtitle, facts, runs,
// values of the runs or [], value_name, peers: names of DATA.peers}.

function definitions(facts) {
  return el("dl", {}, facts.map(([name, value]) => [el("dt", {}, name), el("dd", {}, value)]));
}

function command(text, label) {
  return el("div", { class: "command" }, el("code", {}, text),
    el("button", { type: "button", class: "copy", "aria-label": `Copy ${label}` }, "Copy"));
}

/** A table in a box of its own, in which it scrolls. */
function tableBox(label, heads, rows, numbers = []) {
  const kind = (index) => (numbers.includes(index) ? "number" : null);
  const table = el("table", { class: "plain" }, el("caption", { class: "hidden" }, label),
    el("thead", {}, el("tr", {}, heads.map((head, i) => el("th", { scope: "col", class: kind(i) }, head)))),
    el("tbody", {}, rows.map((row) => el("tr", {}, row.map((cell, i) =>
      el(i ? "td" : "th", { scope: i ? null : "row", class: kind(i) }, cell))))));
  return el("div", { class: "scroll", tabindex: "0", role: "region", "aria-label": label }, table);
}

function openPanel(address) {
  const shown = DATA.panels[address];
  if (!shown) return false;
  const peers = unique(shown.peers.flatMap((name) => DATA.peers[name] ?? []));
  const detail = el("div", { class: "run-detail" });
  const pick = (key) => detail.replaceChildren(...runDetail(key, unique([key, ...peers])));
  panel.replaceChildren(
    el("div", { class: "panel-head" },
      el("div", {}, el("p", { class: "subtitle" }, shown.subtitle), el("h2", { id: "panel-title" }, shown.title)),
      el("button", { type: "button", class: "close", "aria-label": "Close" }, "×")),
    el("div", { class: "panel-body" }, shown.facts.length ? definitions(shown.facts) : null, chooser(shown, pick), detail));
  panel.querySelector(".close").addEventListener("click", () => panel.close());
  if (shown.runs.length) pick(shown.runs[0]);
  if (!panel.open) panel.showModal();
  panel.scrollTop = 0;
  history.replaceState(null, "", `#${address}`);
  return true;
}

/** One line per run; the chosen one's details stand below. */
function chooser(shown, pick) {
  if (!shown.runs.length) return el("p", {}, "It has no runs.");
  if (shown.runs.length === 1) return null;
  const scores = shown.values.length ? [shown.value_name] : ["mIoU", "Var"];
  const rows = shown.runs.map((key, index) => {
    const run = DATA.runs[key];
    const name = el("button", { type: "button", class: "link", "aria-pressed": String(index === 0) }, run?.name ?? key);
    name.addEventListener("click", () => {
      panel.querySelectorAll("[aria-pressed]").forEach((other) => other.setAttribute("aria-pressed", other === name));
      pick(key);
    });
    const values = shown.values.length ? [shown.values[index]] : scores.map((score) => run?.scores[score]);
    return [name, String(run?.seed ?? DASH), ...values.map((value) => fixed(value)), run?.commit ?? DASH];
  });
  const box = tableBox("runs behind this", ["run", "seed", ...scores, "commit"], rows, [1, 2, ...(scores.length > 1 ? [3] : [])]);
  sortable(box.firstChild);
  return el("div", {}, el("h3", {}, plural(rows.length, "run")), box);
}

/** Everything that is known of a run. */
function runDetail(key, compared) {
  const run = DATA.runs[key];
  if (!run) return [el("p", { class: "banner" }, `Run ${key} is not in the store any more.`)];
  const scores = Object.entries(run.scores).map(([name, value]) => [name, fixed(value)]);
  const table = scores.length ? sortable(tableBox("scores", ["metric", "value"], scores, [1]).firstChild) : null;
  return [
    el("h3", { class: "run-name" }, run.name), definitions(run.facts),
    run.repeat ? [el("h4", {}, "Repeat it"), command(run.repeat, "the command that repeats the run")] : [],
    run.command && run.command !== run.repeat ? [el("h4", {}, "As it was typed"), command(run.command, "the command as typed")] : [],
    configList(key, compared),
    table ? el("details", {}, el("summary", {}, `All ${scores.length} scores, percent (Var: squared percent points)`), table)
      : el("p", {}, "The store has no scores of this run."),
    run.classes.length ? [el("h4", {}, "IoU by class and region, percent"), classTable(run)] : [],
  ].flat(3);
}

/** The configuration of a run: what differs from the common one is stored. */
function configOf(run) {
  const config = { ...DATA.common_config, ...run.config };
  run.config_lacks.forEach((name) => delete config[name]);
  return config;
}

/** Keys that may differ between two runs that are the same run, such as paths. */
function isSilent(name) {
  return DATA.silent.some((silent) => name === silent || name.startsWith(`${silent}.`));
}

/** The configuration: at first what tells the compared runs apart, filtered by text. */
function configList(key, compared) {
  const config = configOf(DATA.runs[key]);
  const configs = compared.filter((each) => DATA.runs[each]).map((each) => configOf(DATA.runs[each]));
  const rows = Object.entries(config).map(([name, value]) => {
    const others = new Map();
    configs.map((each) => each[name]).filter((other) => other !== value)
      .forEach((other) => others.set(other, (others.get(other) ?? 0) + 1));
    const text = [...others].slice(0, 8).map(([other, count]) => `${other ?? "absent"} (${count})`).join(", ");
    const more = others.size > 8 ? `, and ${others.size - 8} more` : "";
    return { name, value, text: text + more, differs: others.size > 0, telling: others.size > 0 && !isSilent(name) };
  });
  const telling = rows.filter((row) => row.telling).length;
  const silent = rows.filter((row) => row.differs).length - telling;
  const only = el("input", { type: "checkbox" });
  only.checked = telling > 0;
  const field = el("input", { type: "search", placeholder: "Filter keys and values", "aria-label": "Filter keys and values" });
  const body = el("tbody");
  const draw = () => {
    const shown = rows.filter((row) => (!only.checked || row.telling) && `${row.name}=${row.value}`.toLowerCase().includes(field.value.trim().toLowerCase()));
    body.replaceChildren(...shown.map((row) => el("tr", { class: row.telling ? "differs" : null },
      el("th", { scope: "row" }, row.name), el("td", {}, el("code", {}, row.value)), el("td", { class: "muted" }, row.text))));
    if (!shown.length) body.append(el("tr", {}, el("td", { colspan: 3 }, "Nothing matches.")));
  };
  only.addEventListener("change", draw);
  field.addEventListener("input", draw);
  draw();
  const box = tableBox("configuration", ["key", "value", `other values among ${plural(configs.length, "run")}`], []);
  box.firstChild.classList.add("config");
  box.querySelector("tbody").replaceWith(body);
  return [el("h4", {}, `Configuration, ${plural(rows.length, "key")}`),
    el("div", { class: "tools" }, field, telling ? el("label", { class: "check" }, only, `only the ${telling} that differ`) : null,
      silent ? el("span", { class: "muted" }, `${silent} more ${silent === 1 ? "is" : "are"} no part of the config key`) : null), box];
}

/** Classes by regions as a heat table. */
function classTable({ classes, regions, notes }) {
  const all = classes.flatMap((row) => row.slice(2)).filter(Number.isFinite);
  const [low, high] = [Math.min(...all), Math.max(...all)];
  const box = tableBox("IoU by class and region", ["class", "image", ...regions], classes.map(([name, image, ...values]) =>
    [name, fixed(image), ...values.map((value) => fixed(value, 1))]), [...regions.keys()].map((index) => index + 2).concat(1));
  box.firstChild.classList.add("heat");
  [...box.querySelectorAll("tbody tr")].forEach((row, k) => classes[k].slice(2).forEach((value, r) => {
    if (!Number.isFinite(value)) return;
    const place = high > low ? (value - low) / (high - low) : 0.5;
    row.cells[r + 2].style.background = DATA.viridis[Math.round(31 * place)];
    row.cells[r + 2].style.color = place > 0.6 ? "#111" : "#fff";
  }));
  return el("div", {}, box, notes.map((note) => el("p", { class: "muted" }, note)));
}

// Charts: every [data-chart] is a specification of Vega-Lite in DATA.charts.

async function drawChart(holder) {
  let spec = DATA.charts[holder.dataset.chart];
  if (holder.dataset.partition) {
    // The ticked runs with these regions.
    const chosen = [...document.querySelectorAll("#runs input[data-profile]:checked")].map((box) => DATA.profiles[box.dataset.profile]);
    const values = chosen.filter(({ partition }) => partition === holder.dataset.partition).flatMap(({ rows }) => rows);
    holder.hidden = !values.length;
    if (!values.length) return;
    spec = { ...spec, data: { values } };
  }
  // ast: expressions are interpreted, as the policy runs no text; logLevel: faults alone.
  const options = { ast: true, renderer: "svg", actions: false, logLevel: 1, config: DATA.chart_config };
  holder.view = (await vegaEmbed(holder, spec, options)).view;
  holder.view.addEventListener("click", (_, item) => item?.datum?.panel && openPanel(item.datum.panel));
}

async function drawCharts() {
  for (const holder of document.querySelectorAll("[data-chart]")) {
    await new Promise((done) => setTimeout(done)); // The page can be used between two charts.
    await drawChart(holder);
  }
  document.documentElement.dataset.drawn = "yes";
}

function chooseProfile(box) {
  if (document.querySelectorAll("#runs input[data-profile]:checked").length > DATA.most_chosen) {
    box.checked = false;
    say(`At most ${DATA.most_chosen} can be compared`);
  } else document.querySelectorAll("[data-partition]").forEach(drawChart);
}

// The page as a whole.

async function copy(button) {
  const text = button.previousElementSibling.textContent;
  try {
    await navigator.clipboard.writeText(text);
  } catch (error) {
    // No clipboard on this page (some browsers from file://): the old way, inside an open dialog.
    const field = el("textarea", { class: "offscreen" });
    field.value = text;
    button.after(field);
    field.select();
    document.execCommand("copy");
    field.remove();
  }
  button.textContent = "Copied";
  say("command copied");
  setTimeout(() => (button.textContent = "Copy"), 1500);
}

/** Open what the address names: a panel, or a place inside something folded. */
function openHash() {
  let hash = location.hash.slice(1);
  try {
    hash = decodeURIComponent(hash);
  } catch (error) { /* Not written by this page ("50%"): as it is. */ }
  if (!hash || openPanel(hash)) return;
  const place = document.getElementById(hash);
  for (let node = place; node; node = node.parentElement) if (node.tagName === "DETAILS") node.open = true;
  place?.scrollIntoView({ behavior: "instant" });
}

/** Marks in the contents where the reader is. */
function followReading() {
  const links = [...document.querySelectorAll("#navigation a")];
  const passed = links.filter((link) => document.getElementById(link.hash.slice(1))?.getBoundingClientRect().top < 120);
  const current = passed.at(-1) ?? links[0];
  links.forEach((link) => (link === current ? link.setAttribute("aria-current", "location") : link.removeAttribute("aria-current")));
}

function openMenu(on) {
  document.body.classList.toggle("menu-open", on);
  document.getElementById("menu").setAttribute("aria-expanded", on);
}

document.addEventListener("click", ({ target }) => {
  const opener = target.closest?.("[data-panel]");
  if (opener) openPanel(opener.dataset.panel);
  if (target.matches?.(".copy")) copy(target);
  if (target.id === "theme") target.textContent = `Theme: ${theme({ auto: "light", light: "dark", dark: "auto" }[theme()])}`;
  if (target.id === "menu") openMenu(!document.body.classList.contains("menu-open"));
  if (target.closest?.("#navigation a")) openMenu(false);
  if (target === panel) panel.close(); // The backdrop: outside the panel's own boxes.
});
document.addEventListener("input", ({ target }) => {
  if (target.dataset.filter) filter(target);
  if (target.dataset.profile) chooseProfile(target);
  if (target.dataset.toggle) document.getElementById(target.name).classList.toggle(target.dataset.toggle);
  if (target.dataset.column) {
    document.querySelectorAll(`[data-chart^="${target.dataset.column}/"]`)
      .forEach((holder) => holder.view?.signal("column", target.value).runAsync());
  }
  if (target.id === "class-choice") document.getElementById("classes").replaceChildren(classTable(DATA.classes[target.value] ?? DATA.runs[target.value]));
});
panel.addEventListener("close", () => history.replaceState(null, "", location.href.split("#")[0]));
// Paper shows what a click would: folded parts that hold results are opened, and closed again.
addEventListener("beforeprint", () => document.querySelectorAll("main details:not(.waiting):not([open])").forEach((each) => {
  each.open = true;
  addEventListener("afterprint", () => (each.open = false), { once: true });
}));
addEventListener("hashchange", openHash);
addEventListener("scroll", () => requestAnimationFrame(followReading), { passive: true });

document.querySelectorAll("table.sortable").forEach(sortable);
document.getElementById("theme").textContent = `Theme: ${theme()}`;
document.getElementById("class-choice")?.dispatchEvent(new Event("input", { bubbles: true }));
followReading();
openHash();
addEventListener("load", drawCharts);
