// Section 5: searches, grids and lists.
"use strict";

for (const study of DATA.studies) study.id = placeName("study", study.name);

function renderSearches(section) {
  if (!DATA.studies.length) return section.append(el("p", { class: "empty" }, "The store has no studies yet."));
  section.append(...DATA.studies.map(studyCard));
}

/** States are the collector's words: complete, pruned, failed, running, waiting. */
function isComplete(trial) {
  return trial.state === "complete" && trial.values.length > 0 && trial.values.every(isNumber);
}

function studyCard(study) {
  const counts = unique(study.trials.map((trial) => trial.state))
    .map((state) => `${study.trials.filter((trial) => trial.state === state).length} ${state}`);
  const wanted = study.objectives.map((name, i) => `${study.maximize[i] ? "highest" : "lowest"} ${name}`).join(", ");
  const drawn = study.trials.some(isComplete)
    ? chart((width) => (study.objectives.length > 1 ? frontChart(study, width) : historyChart(study, width))).holder
    : el("p", { class: "empty" }, "No trial is complete yet.");
  return el("article", { id: study.id, class: "table-card" },
    el("h3", {}, study.name, " ", el("span", { class: "badge" }, study.kind)),
    el("p", { class: "caption" }, `Wanted: ${wanted}. ${plural(study.trials.length, "trial")}: ${counts.join(", ")}.`),
    drawn, trialTable(study),
    study.note ? el("details", {}, el("summary", {}, "Report of the study"), el("div", { class: "markdown" }, markdown(study.note))) : null,
    study.command ? [el("p", { class: "muted command-label" }, "Begun by:"), commandBox(study.command, "the command of the study")] : null);
}

function openTrial(study, trial) {
  const facts = [["state", trial.state],
    ...study.objectives.map((name, index) => [name, fixed(trial.values[index])]),
    ...Object.entries(trial.params).map(([key, value]) => [key, el("code", {}, value)])];
  openPanel({
    title: `Trial ${trial.number}`, subtitle: `Study ${study.name}`,
    facts: el("dl", {}, facts.map(([name, value]) => [el("dt", {}, breakable(name)), el("dd", {}, value)])),
    runs: trial.runs, values: [], hash: `trial=${encodeURIComponent(`${study.id}/${trial.number}`)}`,
    peers: unique(study.trials.flatMap((other) => other.runs)),
  });
}

function trialTable(study) {
  const params = unique(study.trials.flatMap((trial) => Object.keys(trial.params)));
  const button = (trial) => el("button", { type: "button", class: "link", onclick: () => openTrial(study, trial) }, String(trial.number));
  const front = study.objectives.length > 1 ? "front" : "best";
  const columns = [
    { title: "trial", show: button, sort: (trial) => trial.number },
    { title: "state", show: (trial) => trial.state, sort: (trial) => trial.state },
    ...study.objectives.map((name, index) => ({ title: name, show: (trial) => fixed(trial.values[index]),
      sort: (trial) => trial.values[index], number: true, highFirst: study.maximize[index] })),
    { title: front, show: (trial) => (trial.on_front ? "★" : ""), sort: (trial) => (trial.on_front ? 1 : 0), highFirst: true },
    ...params.map((name) => ({ title: breakable(name), show: (trial) => trial.params[name] ?? DASH,
      sort: (trial) => asNumber(trial.params[name]), number: areNumbers(study, name), highFirst: false, class: "param" })),
  ];
  const start = { column: study.objectives.length > 1 ? 2 + study.objectives.length : 2, descending: study.objectives.length > 1 || study.maximize[0] };
  const table = sortableTable(`trials of ${study.name}`, columns, { sort: start, rowClass: (trial) => (trial.on_front ? "front" : null) });
  const draw = (text) => table.update(study.trials.filter((trial) =>
    [trial.number, trial.state, ...Object.entries(trial.params).flat()].join(" ").toLowerCase().includes(text)));
  draw("");
  return el("details", { open: study.trials.length <= 40 }, el("summary", {}, `Trials (${study.trials.length})`),
    el("div", { class: "tools" }, textFilter("Filter trials", draw)), table.box);
}

/** "0.002" as a number, "uniform" as it is. */
function asNumber(text) {
  return text !== undefined && text !== "" && Number.isFinite(Number(text)) ? Number(text) : text;
}

function areNumbers(study, name) {
  return study.trials.every((trial) => !trial.params[name] || typeof asNumber(trial.params[name]) === "number");
}

/** A trial that can be clicked and reached with the keyboard. */
function trialMark(study, trial, x, y, best) {
  const label = `Trial ${trial.number}: ${study.objectives.map((name, i) => `${name} ${fixed(trial.values[i])}`).join(", ")}`;
  const mark = marker(best ? "circle" : "square", x, y, best ? 6 : 3.6, { class: best ? "trial front" : "trial", tabindex: "0", role: "button",
    "aria-label": label, onclick: () => openTrial(study, trial),
    onkeydown: (event) => { if (event.key === "Enter" || event.key === " ") { event.preventDefault(); openTrial(study, trial); } } });
  mark.append(svg("title", {}, label));
  return mark;
}

/** The first two objectives against each other; the front as a staircase. */
function frontChart(study, width) {
  const height = 340;
  const trials = study.trials.filter(isComplete);
  const x = linear(trials.map((trial) => trial.values[0]), 56, width - 18);
  const y = linear(trials.map((trial) => trial.values[1]), height - 48, 34);
  const front = trials.filter((trial) => trial.on_front).sort((a, b) => a.values[0] - b.values[0]);
  const arrow = (index) => `${study.objectives[index]} (${study.maximize[index] ? "higher" : "lower"} is better)`;
  const others = trials.filter((trial) => !trial.on_front);
  const more = study.objectives.length > 2 ? `; ${study.objectives.length - 2} more in the table` : "";
  return drawing(width, height, `${study.name}: ${study.objectives.slice(0, 2).join(" against ")}`,
    xAxis(x, 34, height - 48, arrow(0) + more), yAxis(y, 50, width - 12, arrow(1)),
    study.objectives.length === 2 ? svg("path", { class: "front-line", d: stairs(front, study.maximize, x, y) }) : null,
    others.map((trial) => trialMark(study, trial, x(trial.values[0]), y(trial.values[1]), false)),
    front.map((trial) => [trialMark(study, trial, x(trial.values[0]), y(trial.values[1]), true),
      svg("text", { class: "trial-number", x: x(trial.values[0]) + 9, y: y(trial.values[1]) - 7 }, String(trial.number))]));
}

/** What the front attains: between two of its points one holds the worse value of both. */
function stairs(front, maximize, x, y) {
  return front.map((trial, index) => {
    const [px, py] = [x(trial.values[0]), y(trial.values[1])];
    if (index === 0) return `M${px} ${py}`;
    return maximize[0] ? `V${py}H${px}` : `H${px}V${py}`;
  }).join("");
}

/** One objective by trial, and the best so far. */
function historyChart(study, width) {
  const height = 300;
  const trials = study.trials.filter(isComplete);
  const x = linear(trials.map((trial) => trial.number), 56, width - 18);
  const y = linear(trials.map((trial) => trial.values[0]), height - 48, 34);
  const better = study.maximize[0] ? Math.max : Math.min;
  let best = trials[0].values[0];
  const steps = trials.map((trial, index) => {
    best = better(best, trial.values[0]);
    return index ? `H${x(trial.number)}V${y(best)}` : `M${x(trial.number)} ${y(best)}`;
  });
  return drawing(width, height, `${study.name}: ${study.objectives[0]} by trial`,
    xAxis(x, 34, height - 48, "trial"), yAxis(y, 50, width - 12, `${study.objectives[0]} (line: best so far)`),
    svg("path", { class: "front-line", d: steps.join("") }),
    trials.map((trial) => trialMark(study, trial, x(trial.number), y(trial.values[0]), trial.on_front)));
}
