// What all sections share: the data, elements, numbers, copying.
"use strict";

const DATA = unpacked(JSON.parse(document.getElementById("data").textContent));
const RUNS = new Map(DATA.runs.map((run) => [run.key, run]));

/** Undo the packing of page.py: a run keeps only what differs from the common configuration. */
function unpacked(data) {
  for (const run of data.runs) {
    const config = { ...data.common_config, ...run.config };
    for (const key of run.config_lacks) delete config[key];
    run.config = config;
  }
  return data;
}

/** An element. Attributes named on... are listeners; children are nodes or text, never markup. */
function el(tag, attributes = {}, ...children) {
  return filled(document.createElement(tag), attributes, children);
}

/** The same in SVG. */
function svg(tag, attributes = {}, ...children) {
  return filled(document.createElementNS("http://www.w3.org/2000/svg", tag), attributes, children);
}

function filled(node, attributes, children) {
  for (const [name, value] of Object.entries(attributes)) {
    if (value === null || value === undefined || value === false) continue;
    if (name.startsWith("on")) node.addEventListener(name.slice(2), value);
    else node.setAttribute(name, value === true ? "" : value);
  }
  const there = children.flat(Infinity).filter((child) => child !== null && child !== undefined);
  node.append(...there);
  return node;
}

/** Text in which long names may break after _ / . and before brackets. */
function breakable(text) {
  const parts = String(text).split(/(?<=[_/.=,])/);
  return parts.flatMap((part, index) => (index ? [el("wbr"), part] : [part]));
}

const DASH = "–";

function isNumber(value) {
  return typeof value === "number" && Number.isFinite(value);
}

/** A number with a real minus sign; a dash where there is none. */
function fixed(value, decimals = 2) {
  return isNumber(value) ? value.toFixed(decimals).replace("-", "−") : DASH;
}

/** With its sign, and an arrow so that colour is never the only mark. */
function signed(value, decimals = 2) {
  if (!isNumber(value)) return DASH;
  const text = fixed(Math.abs(value), decimals);
  if (Number(text) === 0) return `= ${text}`;
  return value > 0 ? `▲ +${text}` : `▼ −${text}`;
}

/** At most four significant digits, for values of unknown size. */
function short(value) {
  return isNumber(value) ? String(Number(value.toPrecision(4))).replace("-", "−") : DASH;
}

function plural(count, word) {
  return `${count} ${word}${count === 1 ? "" : "s"}`;
}

function mean(values) {
  const there = values.filter(isNumber);
  return there.length ? there.reduce((a, b) => a + b, 0) / there.length : null;
}

/** Standard deviation with n - 1; null for fewer than two values. */
function deviation(values) {
  const there = values.filter(isNumber);
  if (there.length < 2) return null;
  const middle = mean(there);
  return Math.sqrt(there.reduce((sum, v) => sum + (v - middle) ** 2, 0) / (there.length - 1));
}

/** [lowest, highest], or null of nothing. */
function extent(values) {
  const there = values.filter(isNumber);
  return there.length ? [Math.min(...there), Math.max(...there)] : null;
}

function unique(values) {
  return [...new Set(values)];
}

/** "2026-11-21T11:42:01+00:00" as "2026-11-21 11:42". */
function moment(iso) {
  return iso ? iso.slice(0, 16).replace("T", " ") : DASH;
}

function duration(seconds) {
  if (!isNumber(seconds)) return DASH;
  if (seconds < 60) return `${Math.round(seconds)} s`;
  const minutes = Math.round(seconds / 60);
  return minutes < 60 ? `${minutes} min` : `${Math.floor(minutes / 60)} h ${minutes % 60} min`;
}

/** What stands behind # for something with this name. */
function slug(...parts) {
  return parts.join("-").replace(/[^A-Za-z0-9]+/g, "-").replace(/^-|-$/g, "").toLowerCase();
}

const taken = new Set();

/** A slug that nothing else on the page has: "a=1" and "a=-1" are written alike. */
function placeName(...parts) {
  const wanted = slug(...parts);
  let name = wanted;
  for (let number = 2; taken.has(name); number += 1) name = `${wanted}-${number}`;
  taken.add(name);
  return name;
}

/** Tell people who cannot see the change. */
function say(text) {
  document.getElementById("said").textContent = text;
}

async function copy(text) {
  try {
    await navigator.clipboard.writeText(text);
  } catch (error) {
    // No clipboard on this page (some browsers from file://): the old way, inside an open dialog.
    const field = el("textarea", { class: "offscreen" });
    field.value = text;
    (document.querySelector("dialog[open]") || document.body).append(field);
    field.select();
    document.execCommand("copy");
    field.remove();
  }
}

/** A command in a box, with a button that copies it. */
function commandBox(text, label = "command") {
  const button = el("button", { type: "button", class: "copy", "aria-label": `Copy ${label}` }, "Copy");
  button.addEventListener("click", async () => {
    await copy(text);
    button.textContent = "Copied";
    say(`${label} copied`);
    setTimeout(() => (button.textContent = "Copy"), 1500);
  });
  return el("div", { class: "command" }, el("code", {}, text), button);
}

/** A labelled field; `input` is told each change. */
function textFilter(label, onInput) {
  const field = el("input", { type: "search", placeholder: label, "aria-label": label });
  field.addEventListener("input", () => onInput(field.value.trim().toLowerCase()));
  return field;
}

function checkbox(label, checked, onChange) {
  const box = el("input", { type: "checkbox" });
  box.checked = checked;
  box.addEventListener("change", () => onChange(box.checked));
  return el("label", { class: "check" }, box, label);
}

/** A choice; `options` are [value, text]. */
function choice(label, options, selected, onChange) {
  const entries = options.map(([value, text]) => el("option", { value, selected: value === selected }, text));
  const select = el("select", {}, entries);
  select.addEventListener("change", () => onChange(select.value));
  return el("label", { class: "choice" }, `${label} `, select);
}

/** A box in which a wide table scrolls alone; keyboards can scroll it too. */
function scrollBox(label, table) {
  return el("div", { class: "scroll", tabindex: "0", role: "region", "aria-label": label }, table);
}
