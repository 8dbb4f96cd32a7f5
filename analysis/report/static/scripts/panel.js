// The panel at the side: where a number comes from.
"use strict";

const panel = document.getElementById("panel");
let opener = null;

/**
 * Show the runs behind something.
 * shown: {title, subtitle, facts: nodes, runs: keys, values: by run or [], valueName, hash,
 * peers: keys of the runs that configurations are compared with}.
 */
function openPanel(shown) {
  opener = panel.open ? opener : document.activeElement;
  const close = el("button", { type: "button", class: "close", "aria-label": "Close" }, "×");
  close.addEventListener("click", () => panel.close());
  const detail = el("div", { class: "run-detail" });
  const pick = (key) => detail.replaceChildren(...runDetail(key, shown.peers));
  panel.replaceChildren(
    el("div", { class: "panel-head" },
      el("div", {}, el("p", { class: "subtitle" }, shown.subtitle), el("h2", { id: "panel-title" }, shown.title)), close),
    el("div", { class: "panel-body" }, shown.facts, runChooser(shown, pick), detail));
  if (shown.runs.length) pick(shown.runs[0]);
  if (!panel.open) panel.showModal();
  panel.scrollTop = 0;
  setHash(shown.hash);
}

panel.addEventListener("click", (event) => {
  if (event.target === panel) panel.close(); // The backdrop: outside the panel's own boxes.
});

panel.addEventListener("close", () => {
  setHash("");
  opener?.focus();
});

/** The address of what is open, without a jump and without a step in the history. */
function setHash(hash) {
  const base = location.href.split("#")[0];
  history.replaceState(null, "", hash ? `${base}#${hash}` : base);
}

/** The panel of one run alone. */
function openRun(key) {
  const run = RUNS.get(key);
  const peers = DATA.tables.map(runsOfTable).filter((keys) => keys.includes(key)).flat();
  const same = DATA.runs.filter((other) => run && other.experiment === run.experiment).map((r) => r.key);
  openPanel({
    title: run ? run.name : key, subtitle: "Run", facts: null, runs: [key], values: [],
    hash: `run=${encodeURIComponent(key)}`, peers: peers.length ? peers : same,
  });
}

function runsOfTable(table) {
  return unique(table.cells.flat().flatMap((cell) => cell.runs));
}

/** One line per run; the chosen one's details stand below. */
function runChooser(shown, pick) {
  if (!shown.runs.length) return el("p", {}, "No run stands behind it.");
  if (shown.runs.length === 1) return null;
  const values = new Map(shown.runs.map((key, index) => [key, shown.values[index]]));
  const buttons = [];
  const button = (key) => {
    const made = el("button", { type: "button", class: "link", "aria-pressed": String(key === shown.runs[0]) },
      RUNS.get(key)?.name ?? key);
    made.addEventListener("click", () => {
      buttons.forEach((other) => other.setAttribute("aria-pressed", other === made));
      pick(key);
    });
    buttons.push(made);
    return made;
  };
  const columns = [
    { title: "run", show: button, sort: (key) => RUNS.get(key)?.name },
    { title: "seed", show: (key) => String(RUNS.get(key)?.seed ?? DASH), sort: (key) => RUNS.get(key)?.seed, number: true },
    ...(shown.values.length
      ? [{ title: shown.valueName, show: (key) => fixed(values.get(key)), sort: (key) => values.get(key), number: true }]
      : ["mIoU", "Var"].map((name) => scoreColumn(name))),
    { title: "commit", show: (key) => commitText(RUNS.get(key)), sort: (key) => RUNS.get(key)?.commit },
  ];
  const table = sortableTable("runs behind this", columns);
  table.update(shown.runs);
  return el("div", {}, el("h3", {}, plural(shown.runs.length, "run")), table.box);
}

function scoreColumn(name) {
  const value = (key) => RUNS.get(key)?.scores[name];
  return { title: name, show: (key) => fixed(value(key)), sort: value, number: true };
}

/** Ten letters of the commit, with the mark for uncommitted changes. */
function commitText(run) {
  if (!run?.commit) return DASH;
  const dirty = run.commit.endsWith("+");
  return `${run.commit.replace("+", "").slice(0, 10)}${dirty ? "+" : ""}`;
}

const STATUS = { FINISHED: "✓ finished", RUNNING: "… running", FAILED: "✗ failed", KILLED: "✗ killed" };

function statusText(run) {
  return STATUS[run.status] ?? run.status;
}

/** Everything that is known of a run. */
function runDetail(key, peers) {
  const run = RUNS.get(key);
  if (!run) return [el("p", { class: "banner" }, `Run ${key} is not in the store any more.`)];
  const uncommitted = run.commit.endsWith("+") ? " (with uncommitted changes)" : "";
  const facts = [
    ["status", statusText(run)], ["config key", el("code", {}, run.key)], ["MLflow run", el("code", {}, run.run_id || DASH)],
    ["commit", el("span", {}, el("code", {}, run.commit || DASH), uncommitted)],
    ["started (UTC)", moment(run.started)], ["duration", duration(run.seconds)], ["host", run.host || DASH],
    ["scale, seed", `${run.scale || DASH}, ${run.seed ?? DASH}`], ["experiment, group", `${run.experiment || DASH}, ${run.group || DASH}`],
    ["dataset", el("code", { class: "long" }, run.dataset || DASH)],
    ["scored on", `${run.split || DASH}, ${plural(run.images, "image")}, ${run.partition || "no partition"}`],
    ["tables", Object.entries(run.table_rows).map(([table, row]) => `${table}: ${row}`).join("; ") || DASH],
    ["studies", run.studies.join(", ") || DASH],
  ];
  return [
    el("h3", { class: "run-name" }, run.name),
    el("dl", {}, facts.map(([name, value]) => [el("dt", {}, name), el("dd", {}, value)])),
    run.repeat ? [el("h4", {}, "Repeat it"), commandBox(run.repeat, "the command that repeats the run")] : [],
    run.command && run.command !== run.repeat ? [el("h4", {}, "As it was typed"), commandBox(run.command, "the command as typed")] : [],
    configList(run, peers), scoreList(run),
    run.class_region_ious.length ? [el("h4", {}, "IoU by class and region, percent"), classTable([run])] : [],
  ].flat(3);
}

/** Keys in which the compared runs are not all alike: key -> Map(value -> how many runs). */
function differingKeys(keys) {
  const runs = unique(keys).map((key) => RUNS.get(key)).filter(Boolean);
  const found = new Map();
  for (const key of unique(runs.flatMap((run) => Object.keys(run.config)))) {
    const counts = new Map();
    for (const run of runs) counts.set(run.config[key], (counts.get(run.config[key]) ?? 0) + 1);
    if (counts.size > 1) found.set(key, counts);
  }
  return found;
}

/** Keys that may differ between two runs that are the same run, such as paths. */
function isSilent(key) {
  return DATA.silent.some((silent) => key === silent || key.startsWith(`${silent}.`));
}

/** The configuration: on request what tells the compared runs apart alone, filtered by text. */
function configList(run, peers) {
  const differing = differingKeys([run.key, ...peers]);
  const telling = new Set([...differing.keys()].filter((key) => !isSilent(key)));
  const silent = differing.size - telling.size;
  const body = el("tbody");
  const state = { text: "", only: telling.size > 0 };
  const draw = () => {
    const keys = Object.keys(run.config).filter((key) =>
      (!state.only || telling.has(key)) && `${key}=${run.config[key]}`.toLowerCase().includes(state.text));
    body.replaceChildren(...keys.map((key) => configRow(run, key, differing.get(key), telling.has(key))));
    if (!keys.length) body.append(el("tr", {}, el("td", { colspan: 3 }, "Nothing matches.")));
  };
  draw();
  const filter = textFilter("Filter keys and values", (text) => { state.text = text; draw(); });
  const only = checkbox(`only the ${telling.size} that differ`, state.only, (on) => { state.only = on; draw(); });
  const head = el("tr", {}, ["key", "value", `other values among ${plural(unique(peers).length, "run")}`].map((t) => el("th", { scope: "col" }, t)));
  return [el("h4", {}, `Configuration, ${Object.keys(run.config).length} keys`),
    el("div", { class: "tools" }, filter, telling.size ? only : null, silent ? el("span", { class: "muted" }, `${silent} more ${silent === 1 ? "is" : "are"} no part of the config key`) : null),
    scrollBox("configuration", el("table", { class: "plain config" }, el("thead", {}, head), body))];
}

function configRow(run, key, counts, telling) {
  const others = [...(counts ?? [])].filter(([value]) => value !== run.config[key]);
  const text = others.slice(0, 8).map(([value, count]) => `${value ?? "absent"} (${count})`).join(", ");
  return el("tr", { class: telling ? "differs" : null },
    el("th", { scope: "row" }, breakable(key)), el("td", {}, el("code", {}, breakable(run.config[key]))),
    el("td", { class: "muted" }, others.length > 8 ? `${text}, and ${others.length - 8} more` : text));
}

function scoreList(run) {
  const names = Object.keys(run.scores);
  if (!names.length) return el("p", {}, "The store has no scores of this run.");
  const columns = [
    { title: "metric", show: (name) => name, sort: (name) => name },
    { title: "value", show: (name) => fixed(run.scores[name]), sort: (name) => run.scores[name], number: true },
  ];
  const table = sortableTable("scores", columns);
  table.update(names);
  return el("details", {}, el("summary", {}, `All ${names.length} scores, percent (Var: squared percent points)`), table.box);
}
