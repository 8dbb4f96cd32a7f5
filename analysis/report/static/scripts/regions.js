// Region heat maps drawn to scale, and classes by region.
"use strict";

const MAP = { width: 240, height: 180 };

/** "ring9_released_3_4" -> {kind: "ring", count: 9}; null if it is none of ours. */
function partitionOf(name) {
  const found = /^(ring|vertical|horizontal)(\d+)(?:_released_3_4)?$/.exec(name);
  return found && { kind: found[1], count: Number(found[2]) };
}

/** What a region is called where it has a place: "centre", "edge", "left", ... */
function placeWord(kind, index, count) {
  const ends = { ring: ["centre", "edge"], vertical: ["left", "right"], horizontal: ["top", "bottom"] }[kind];
  return index === 0 ? ends[0] : index === count - 1 ? ends[1] : "";
}

/** Rectangle of region `index` in a 4:3 picture; rings: nested, of areas (r + 1) / R, drawn outermost first. */
function regionBox({ kind, count }, index, { width, height }) {
  if (kind === "vertical") return { x: (width * index) / count, y: 0, width: width / count, height };
  if (kind === "horizontal") return { x: 0, y: (height * index) / count, width, height: height / count };
  const side = Math.sqrt((index + 1) / count);
  return { x: (width * (1 - side)) / 2, y: (height * (1 - side)) / 2, width: width * side, height: height * side };
}

/** Where the number of a region goes and how much room it has: rings have theirs in the upper band. */
function numberPlace(partition, index, size) {
  const box = regionBox(partition, index, size);
  const inner = partition.kind === "ring" && index > 0 ? regionBox(partition, index - 1, size) : null;
  const room = inner ? inner.y - box.y : box.height;
  return { x: box.x + box.width / 2, y: box.y + room / 2, room, width: box.width };
}

/** One map: rectangles with their numbers where there is room. */
function regionMap(partition, values, range, label) {
  const order = values.map((_, index) => index).reverse();
  const shapes = order.map((index) => svg("rect", {
    ...regionBox(partition, index, MAP), fill: heat(values[index], range).background, class: "region" },
  svg("title", {}, `region ${index + 1}: ${fixed(values[index])}`)));
  const texts = order.map((index) => {
    const place = numberPlace(partition, index, MAP);
    if (place.room < 12 || place.width < 24) return null;
    const size = Math.min(12, place.room - 0.5);
    return svg("text", { x: place.x, y: place.y + size * 0.36, "font-size": size, "text-anchor": "middle",
      style: `fill: ${heat(values[index], range).ink}` }, fixed(values[index], 1));
  });
  return drawing(MAP.width, MAP.height, label, shapes, texts);
}

/** Runs that share a method, split and partition: [{name, runs, ious, lows, highs, sds}]. */
function groupsOf(runs) {
  const groups = new Map();
  for (const run of runs) {
    const name = run.group || run.experiment || run.name;
    const id = [name, run.scale, run.split, run.partition, run.dataset, run.unscored].join("|");
    if (!groups.has(id)) groups.set(id, { id, name, runs: [] });
    groups.get(id).runs.push(run);
  }
  return [...groups.values()].map((group) => ({ ...group, ...profileOf(group.runs) }));
}

/** Mean, ends and standard deviation of each region over runs. */
function profileOf(runs) {
  const count = Math.max(0, ...runs.map((run) => run.region_ious.length));
  const byRegion = Array.from({ length: count }, (_, r) => runs.map((run) => run.region_ious[r]));
  const ends = byRegion.map((values) => extent(values) || [null, null]);
  return { ious: byRegion.map(mean), sds: byRegion.map(deviation),
    lows: ends.map((e) => e[0]), highs: ends.map((e) => e[1]) };
}

function score(runs, name) {
  return mean(runs.map((run) => run.scores[name]));
}

function regionCard(group, range) {
  const { partition: name, split } = group.runs[0];
  const partition = partitionOf(name);
  const seeds = plural(group.runs.length, "run");
  const list = group.ious.map((value, index) => {
    const place = placeWord(partition.kind, index, group.ious.length);
    return el("li", {}, el("i", { style: `background: ${heat(value, range).background}` }),
      el("span", {}, `${index + 1}${place ? ` ${place}` : ""}`), el("b", {}, fixed(value)),
      el("small", {}, isNumber(group.sds[index]) ? `± ${fixed(group.sds[index])}` : ""));
  });
  const open = el("button", { type: "button", class: "link" }, group.name);
  open.addEventListener("click", () => openGroup(group));
  return el("figure", { class: "region-card" }, el("figcaption", {}, open,
    el("small", {}, `${name}, ${split}, ${seeds}; mIoU ${fixed(score(group.runs, "mIoU"))}, Var ${fixed(score(group.runs, "Var"))}`)),
  el("div", { class: "region-row" }, regionMap(partition, group.ious, range, `${group.name}: IoU of ${name}`), el("ol", { class: "region-list" }, list)));
}

function openGroup(group) {
  const keys = group.runs.map((run) => run.key);
  openPanel({ title: group.name, subtitle: "Group of runs", facts: null, runs: keys, values: [],
    hash: `run=${encodeURIComponent(keys[0])}`, peers: DATA.runs.map((run) => run.key) });
}

/** Classes by regions as a heat table, mean over the runs. */
function classTable(runs) {
  const { classes, partition, unscored } = runs[0];
  const cells = classes.map((_, k) => runs[0].class_region_ious[k].map((_, r) => mean(runs.map((run) => run.class_region_ious[k]?.[r]))));
  const range = extent(cells.flat()) || [0, 1];
  const kind = partitionOf(partition)?.kind;
  const heads = cells[0].map((_, r) => el("th", { scope: "col", class: "number" }, `${r + 1} ${placeWord(kind ?? "ring", r, cells[0].length)}`));
  const rows = classes.map((name, k) => el("tr", {}, el("th", { scope: "row" }, unscored.includes(name) ? `${name} (not in means)` : name),
    el("td", { class: "number" }, fixed(score(runs, `class/${name}`))), cells[k].map((value) => heatCell(value, range))));
  const head = el("tr", {}, el("th", { scope: "col" }, "class"), el("th", { scope: "col", class: "number" }, "image"), heads);
  const table = scrollBox("IoU by class and region", el("table", { class: "plain heat" }, el("thead", {}, head), el("tbody", {}, rows)));
  const notes = [...new Set(runs.flatMap((run) => run.notes))];
  return el("div", {}, table, notes.map((note) => el("p", { class: "muted" }, note)));
}

function heatCell(value, range) {
  const { background, ink } = heat(value, range);
  return el("td", { class: "number", style: `background: ${background}; color: ${ink}` }, fixed(value, 1));
}

const MAPS_AT_FIRST = 24;

/** Section 4. */
function renderRegions(section) {
  const runs = DATA.runs.filter((run) => run.region_ious.length && partitionOf(run.partition));
  if (!runs.length) return section.append(el("p", { class: "empty" }, "No run in the store has scores by region yet."));
  const groups = groupsOf(runs);
  const range = extent(groups.flatMap((group) => group.ious));
  const grid = el("div", { class: "region-grid" });
  const draw = (text, all) => {
    const wanted = groups.filter((group) => `${group.name} ${group.runs[0].partition}`.toLowerCase().includes(text));
    grid.replaceChildren(...wanted.slice(0, all ? undefined : MAPS_AT_FIRST).map((group) => regionCard(group, range)));
    if (all || wanted.length <= MAPS_AT_FIRST) return;
    const more = el("button", { type: "button" }, `Show all ${wanted.length} groups`);
    more.addEventListener("click", () => draw(text, true));
    grid.append(more);
  };
  draw("", false);
  section.append(
    el("p", {}, "IoU of each region in percent, mean over the runs of a group (± standard deviation). Regions are drawn to scale and share one colour scale."),
    el("div", { class: "tools" }, textFilter("Filter groups", (text) => draw(text, false)), heatLegend(range, "% IoU")),
    grid, el("h3", {}, "Classes by region"), classChooser(groups));
}

function classChooser(groups) {
  const withClasses = groups.filter((group) => group.runs.every((run) => run.class_region_ious.length));
  if (!withClasses.length) return el("p", { class: "empty" }, "No run has scores by class and region.");
  const choices = withClasses.flatMap((group) => [
    { name: group.runs.length > 1 ? `${group.name} (mean of ${group.runs.length})` : group.runs[0].name, runs: group.runs },
    ...(group.runs.length > 1 ? group.runs.map((run) => ({ name: `\u2003${run.name}`, runs: [run] })) : []),
  ]);
  const holder = el("div");
  const show = (index) => holder.replaceChildren(classTable(choices[index].runs));
  show(0);
  const select = choice("Group or run", choices.map((c, index) => [String(index), c.name]), "0", (index) => show(Number(index)));
  return el("div", {}, el("div", { class: "tools" }, select), holder);
}
