// Section 3: the runs, and profiles over the regions of those chosen.
"use strict";

const MOST_CHOSEN = 6;

/** Section 3. The list shows groups (means over seeds) or single runs; what is ticked is drawn below. */
function renderRuns(section) {
  if (!DATA.runs.length) return section.append(el("p", { class: "empty" }, "The store has no runs yet."));
  const state = { text: "", grouped: true, scale: "", status: "", chosen: new Map() };
  const range = extent(DATA.runs.flatMap((run) => run.region_ious)) ?? [0, 1];
  const measured = DATA.runs.filter((run) => run.region_ious.length);
  const alike = measured.filter((run) => run.partition === measured[0].partition);
  for (const group of groupsOf(alike).slice(0, MOST_CHOSEN)) state.chosen.set(group.id, group);
  const profile = chart((width) => profileChart([...state.chosen.values()], width));
  const key = el("div", { class: "key profile-key" });
  const remark = el("p", { class: "muted", role: "status" });
  const list = runTable(state, range, () => showProfile());
  const showProfile = () => {
    profile.redraw();
    key.replaceChildren(...[...state.chosen.values()].map(profileKey));
    remark.textContent = `${state.chosen.size} of at most ${MOST_CHOSEN} chosen; line: mean over the runs of a group, band: lowest to highest run.`;
  };
  const draw = () => list.update(listed(state));
  draw();
  showProfile();
  section.append(
    el("p", {}, "Click a name for commit, configuration and command. Tick up to six to compare their regions below."),
    el("div", { class: "tools" }, textFilter("Filter runs", (text) => { state.text = text; draw(); }),
      checkbox("group the seeds of a method", true, (on) => { state.grouped = on; draw(); }),
      fieldChoice("Scale", "scale", state, draw), fieldChoice("Status", "status", state, draw), heatLegend(range, "% IoU by region")),
    list.box, el("h3", { id: "region-profile" }, "IoU by region"), remark, key, profile.holder);
}

function fieldChoice(label, field, state, draw) {
  const values = unique(DATA.runs.map((run) => run[field])).filter(Boolean).sort();
  if (values.length < 2) return null;
  return choice(label, [["", "all"], ...values.map((value) => [value, value.toLowerCase()])], "", (value) => { state[field] = value; draw(); });
}

/** The groups or single runs that pass the filters, each as a group. */
function listed(state) {
  const runs = DATA.runs.filter((run) => (!state.scale || run.scale === state.scale) && (!state.status || run.status === state.status)
    && [run.name, run.key, run.experiment, run.group, ...Object.keys(run.table_rows), ...run.studies].join(" ").toLowerCase().includes(state.text));
  return state.grouped ? groupsOf(runs) : runs.map((run) => ({ id: run.key, name: run.name, runs: [run], ...profileOf([run]) }));
}

function runTable(state, range, changed) {
  const first = (group) => group.runs[0];
  const columns = [
    { title: "run", show: (group) => runName(group, state, changed), sort: (group) => group.name },
    { title: "experiment", show: (group) => first(group).experiment || DASH, sort: (group) => first(group).experiment },
    { title: "scale", show: (group) => first(group).scale || DASH, sort: (group) => first(group).scale },
    { title: "seeds", show: seedText, sort: (group) => group.runs.length, number: true },
    { title: "mIoU", show: (group) => meanText(group, "mIoU"), sort: (group) => score(group.runs, "mIoU"), number: true },
    { title: "Var", show: (group) => meanText(group, "Var"), sort: (group) => score(group.runs, "Var"), number: true, highFirst: false },
    { title: "regions", show: (group) => heatStrip(group, range), sort: (group) => group.ious[0], highFirst: true },
    { title: "started", show: (group) => moment(first(group).started), sort: (group) => first(group).started, highFirst: true, class: "moment" },
    { title: "time", show: (group) => duration(mean(group.runs.map((r) => r.seconds))), sort: (group) => mean(group.runs.map((r) => r.seconds)), number: true },
    { title: "status", show: statusSummary, sort: (group) => statusSummary(group), class: "status" },
  ];
  const table = sortableTable("runs", columns);
  table.box.classList.add("list-runs");
  return table;
}

function runName(group, state, changed) {
  const box = el("input", { type: "checkbox", "aria-label": `Compare ${group.name}` });
  box.checked = state.chosen.has(group.id);
  box.disabled = !group.ious.length;
  box.addEventListener("change", () => {
    if (box.checked && state.chosen.size >= MOST_CHOSEN) {
      box.checked = false;
      say(`At most ${MOST_CHOSEN} can be compared`);
      return;
    }
    if (box.checked) state.chosen.set(group.id, group); else state.chosen.delete(group.id);
    changed();
  });
  const open = el("button", { type: "button", class: "link" }, breakable(group.name));
  open.addEventListener("click", () => (group.runs.length > 1 ? openGroup(group) : openRun(group.runs[0].key)));
  return el("span", { class: "run-name-cell" }, box, open);
}

function seedText(group) {
  const seeds = group.runs.map((run) => run.seed).filter((seed) => seed !== null).sort((a, b) => a - b);
  return seeds.length ? seeds.join(", ") : DASH;
}

function meanText(group, name) {
  const sd = deviation(group.runs.map((run) => run.scores[name]));
  return [fixed(score(group.runs, name)), isNumber(sd) ? el("small", { class: "muted" }, ` ± ${fixed(sd)}`) : null];
}

/** A cell per region: colour, and the number for those who point at it or print. */
function heatStrip(group, range) {
  if (!group.ious.length) return DASH;
  const cells = group.ious.map((value, index) => {
    const { background, ink } = heat(value, range);
    return el("i", { style: `background: ${background}; color: ${ink}`, title: `region ${index + 1}: ${fixed(value)}` }, fixed(value, 0));
  });
  return el("span", { class: "heat-strip" }, cells);
}

/** "✓ finished"; with counts where the runs of a group are not alike. Lines break between the states. */
function statusSummary(group) {
  const states = unique(group.runs.map(statusText));
  if (states.length === 1) return states[0];
  const counted = states.map((text) => `${text} (${group.runs.filter((run) => statusText(run) === text).length})`);
  return counted.map((text) => text.replaceAll(" ", "\u00a0")).join(", ");
}

function profileKey(group, index) {
  const colour = COLOURS[index];
  const mark = svg("svg", { width: 26, height: 14, "aria-hidden": "true" }, svg("line", { x1: 0, x2: 26, y1: 7, y2: 7, stroke: colour, "stroke-width": 2 }),
    marker(MARKERS[index], 13, 7, 4, { fill: colour, stroke: colour, "stroke-width": 1.5 }));
  return el("span", {}, mark, `${group.name} (${plural(group.runs.length, "run")})`);
}

/** Lines over the regions with a band from the lowest to the highest run. */
function profileChart(groups, width) {
  const drawn = groups.map((group, index) => ({ ...group, index })).filter((group) => group.ious.length);
  if (!drawn.length) return el("p", { class: "empty" }, "Tick runs in the list to compare their regions.");
  const partitions = unique(drawn.map((group) => group.runs[0].partition));
  return el("div", {}, partitions.map((name) => [el("h4", {}, name),
    partitionProfile(drawn.filter((group) => group.runs[0].partition === name), width)]));
}

/** The profiles of one partition: regions of another one are other places. */
function partitionProfile(drawn, width) {
  const height = 330;
  const count = Math.max(...drawn.map((group) => group.ious.length));
  const x = linear([1, count], 52, width - 18);
  const y = linear(drawn.flatMap((group) => [...group.lows, ...group.highs]), height - 46, 34);
  const kind = partitionOf(drawn[0].runs[0].partition)?.kind;
  const word = (r) => (kind ? placeWord(kind, r, count) : "");
  const axis = Array.from({ length: count }, (_, r) =>
    svg("text", { class: "tick", x: x(r + 1), y: height - 26, "text-anchor": "middle" }, `${r + 1}`,
      word(r) ? svg("tspan", { x: x(r + 1), dy: 14 }, word(r)) : null));
  const label = svg("text", { class: "axis", x: (x(1) + x(count)) / 2, y: height - 10, "text-anchor": "middle" }, "region");
  return drawing(width, height, `IoU by region, ${drawn[0].runs[0].partition}`, yAxis(y, 46, width - 12, "IoU, percent"), axis, label,
    drawn.map((group) => profileBand(group, x, y)), drawn.map((group) => profileLine(group, x, y)));
}

function profileBand(group, x, y) {
  if (group.runs.length < 2) return null;
  const up = group.highs.map((value, r) => `${x(r + 1)} ${y(value)}`);
  const down = group.lows.map((value, r) => `${x(r + 1)} ${y(value)}`).reverse();
  return svg("path", { d: `M${[...up, ...down].join("L")}Z`, fill: COLOURS[group.index], opacity: 0.13 });
}

function profileLine(group, x, y) {
  const colour = COLOURS[group.index];
  const points = group.ious.map((value, r) => ({ value, r })).filter(({ value }) => isNumber(value));
  const path = points.map(({ value, r }) => `${x(r + 1)} ${y(value)}`).join("L");
  const title = ({ value, r }) => svg("title", {}, `${group.name}, region ${r + 1}: ${fixed(value)}`);
  return [svg("path", { d: `M${path}`, fill: "none", stroke: colour, "stroke-width": 2 }),
    points.map((point) => {
      const mark = marker(MARKERS[group.index], x(point.r + 1), y(point.value), 4.2, { fill: colour, stroke: colour, "stroke-width": 1.6 });
      mark.append(title(point));
      return mark;
    })];
}
