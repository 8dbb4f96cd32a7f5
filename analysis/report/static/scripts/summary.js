// Section 1: what the store holds.
"use strict";

function renderSummary(section) {
  const run = DATA.tables.filter((table) => table.isRun);
  section.append(
    el("p", { class: "made" }, `Made ${moment(DATA.made)} UTC from `, el("code", {}, breakable(DATA.store)), "."),
    demoBanner(), tiles(run), run.length ? overview(run) : el("p", { class: "empty" }, "No row of a table has been run yet: see the commands below the tables."),
    commits(), remarks(),
    el("p", { class: "muted command-label" }, "This page again, from the store as it is then:"),
    commandBox(DATA.command, "the command of the page"));
}

function demoBanner() {
  const demo = DATA.runs.filter((run) => run.scale === "demo").length;
  if (!demo) return "";
  const which = demo === DATA.runs.length ? "All runs are" : `${demo} of ${plural(DATA.runs.length, "run")} are`;
  return el("p", { class: "banner" }, el("strong", {}, `${which} at demo scale. `),
    "Small data and a small network: compare orders (which row is better), not values.");
}

/** The large numbers at the top. */
function tiles(run) {
  const finished = DATA.runs.filter((each) => each.status === "FINISHED").length;
  const seconds = DATA.runs.reduce((sum, each) => sum + (each.seconds ?? 0), 0);
  const scales = unique(DATA.runs.map((each) => each.scale)).filter(Boolean);
  const trials = DATA.studies.reduce((sum, study) => sum + study.trials.length, 0);
  const commitNames = unique(DATA.runs.map((each) => each.commit.replace("+", ""))).filter(Boolean);
  const word = (things, name) => (things.length === 1 ? name : `${name}s`);
  const entries = [
    [DATA.runs.length, word(DATA.runs, "run"), finishedRemark(finished), "runs"],
    [run.length, `${word(run, "table")} with runs`, `of ${DATA.tables.length} tables`, "tables"],
    [DATA.studies.length, DATA.studies.length === 1 ? "study" : "studies", plural(trials, "trial"), "searches"],
    [commitNames.length, word(commitNames, "commit"), commitRemark(), "commits"],
    [scales.length, word(scales, "scale"), scales.join(", ") || DASH, "runs"],
    [duration(seconds), "of computing", "sum over runs", "runs"],
  ];
  return el("div", { class: "tiles" }, entries.map(([value, name, more, target]) =>
    el("a", { class: "tile", href: `#${target}` }, el("strong", {}, String(value)), el("span", {}, name), el("small", {}, more))));
}

function finishedRemark(finished) {
  if (!DATA.runs.length) return "none yet";
  return finished === DATA.runs.length ? "all finished" : `${finished} finished`;
}

function commitRemark() {
  const dirty = DATA.runs.filter((run) => run.commit.endsWith("+")).length;
  return dirty ? `${plural(dirty, "run")} with uncommitted changes` : "no uncommitted changes";
}

/** One line per table with runs: how far it is, and whether it agrees with the paper. */
function overview(run) {
  const main = (table) => table.columns[mainColumn(table)];
  const best = (table, field) => bestRows(table, field).map((row) => table.rows[row]).join(", ");
  const rho = (table, name) => table.orders[name]?.[0] ?? null;
  const rhoText = (table, name) => (isNumber(rho(table, name)) ? [`${rho(table, name) > 0 ? "+" : ""}${fixed(rho(table, name))}`, el("small", { class: "muted" }, ` n=${table.orders[name][1]}`)] : DASH);
  const there = (table) => table.cells.filter((row) => row.some((cell) => isNumber(cell.mean))).length;
  const seeds = (table) => extent(table.cells.flat().map((cell) => cell.seeds || null));
  const columns = [
    { title: "table", show: (table) => [el("a", { href: `#${table.id}` }, table.name), table.extra ? [" ", el("small", { class: "muted" }, breakable(table.extra))] : null], sort: (table) => table.name },
    { title: "scale", show: (table) => el("span", { class: `badge ${table.scale}` }, table.scale || DASH), sort: (table) => table.scale },
    { title: "rows run", show: (table) => `${there(table)} of ${table.rows.length}`, sort: (table) => there(table) / table.rows.length, number: true },
    { title: "seeds", show: (table) => (seeds(table) ? unique(seeds(table)).join("–") : DASH), sort: (table) => seeds(table)?.[0], number: true },
    { title: "main column", show: (table) => breakable(main(table)), sort: main },
    { title: "order of rows, ρ", show: (table) => rhoText(table, main(table)), sort: (table) => rho(table, main(table)), number: true },
    { title: "best of ours", show: (table) => breakable(best(table, "rank") || DASH) },
    { title: "best published", show: (table) => breakable(best(table, "published_rank") || DASH) },
    { title: "same?", show: sameText, sort: (table) => Number(sameText(table) === "✓ yes"), highFirst: true, class: "same" },
  ];
  const table = sortableTable("tables with runs", columns);
  table.update(run);
  return el("div", {}, el("h3", {}, "Tables with runs"), table.box,
    el("p", { class: "muted" }, "ρ: Spearman's rank correlation between our means and the published values over n rows; +1 is the same order. ",
      "Best of ours: of the rows with all seeds. ", comparisonHint()));
}

/** Rows that are first in the main column by `field`, "rank" or "published_rank"; ties are several. */
function bestRows(table, field) {
  const column = mainColumn(table);
  return table.cells.flatMap((row, index) => (row[column][field] === 1 ? [index] : []));
}

/** Whether the best row is the paper's; what ours would give where that one was not run is not known. */
function sameText(table) {
  const [ours, published] = [bestRows(table, "rank"), bestRows(table, "published_rank")];
  if (!ours.length || !published.length) return DASH;
  if (ours.some((row) => published.includes(row))) return "✓ yes";
  const run = published.some((row) => isNumber(table.cells[row][mainColumn(table)].mean));
  return run ? "✗ no" : `${DASH} not run`;
}

/** Runs by commit. */
function commits() {
  const names = unique(DATA.runs.map((run) => run.commit));
  if (!names.length) return "";
  const of = (name) => DATA.runs.filter((run) => run.commit === name);
  const columns = [
    { title: "commit", show: (name) => el("code", {}, name ? commitText({ commit: name }) : "not known"), sort: (name) => name },
    { title: "runs", show: (name) => String(of(name).length), sort: (name) => of(name).length, number: true },
    { title: "first started (UTC)", show: (name) => moment(of(name).map((run) => run.started).sort()[0]), sort: (name) => of(name).map((run) => run.started).sort()[0] },
    { title: "tree", show: (name) => (name.endsWith("+") ? "with uncommitted changes" : name ? "clean" : DASH), sort: (name) => name.endsWith("+") ? 1 : 0 },
  ];
  const table = sortableTable("runs by commit", columns);
  table.update(names);
  return el("details", { id: "commits", open: names.length <= 4 }, el("summary", {}, "Commits behind the runs"), table.box);
}

function remarks() {
  if (!DATA.remarks.length) return "";
  return el("div", { class: "remarks" }, el("h3", {}, "Remarks"), el("ul", {}, DATA.remarks.map((text) => el("li", {}, text))));
}

/** Section 6. */
function renderMasks(section) {
  if (!DATA.masks.length) return section.append(el("p", { class: "empty" }, "No pictures were made."));
  section.append(el("div", { class: "pictures" }, DATA.masks.map((picture) => el("figure", {},
    el("img", { src: picture.address, alt: `${picture.title}. ${picture.caption}`, width: picture.width, height: picture.height }),
    el("figcaption", {}, el("strong", {}, picture.title), " ", picture.caption)))));
}

/** Section 7. */
function renderDifferences(section) {
  if (!DATA.differences.length) return section.append(el("p", { class: "empty" }, "No differences are listed."));
  const runs = (entry) => (entry.runs.length ? el("button", { type: "button", class: "link", onclick: () => openPanel({
    title: entry.topic, subtitle: "Paper against release", facts: el("p", {}, entry.effect), runs: entry.runs, values: [],
    hash: "", peers: entry.runs }) }, `show ${plural(entry.runs.length, "run")}`) : null);
  const columns = [
    { title: "topic", show: (entry) => entry.topic, sort: (entry) => entry.topic },
    { title: "paper", show: (entry) => entry.paper, class: "prose" },
    { title: "release", show: (entry) => entry.released, class: "prose" },
    { title: "source", show: (entry) => entry.source, sort: (entry) => entry.source, class: "source" },
    { title: "what it does here", show: (entry) => [entry.effect, " ", runs(entry)], sort: (entry) => (entry.runs.length ? 1 : 0), highFirst: true, class: "prose" },
  ];
  const table = sortableTable("paper against release", columns);
  table.box.classList.add("differences");
  table.update(DATA.differences);
  section.append(el("p", {}, "Where a paper's text and its released code differ, both are settings here. The effect is a paired difference where the store holds both."), table.box);
}
