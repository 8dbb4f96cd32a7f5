// Scales, axes and colours of the charts; everything is SVG that follows the theme through CSS.
"use strict";

/** Okabe and Ito's colours, which people with any colour vision tell apart; black is the text's. */
const COLOURS = ["#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9"];
const MARKERS = ["circle", "diamond", "square", "triangle", "cross", "down"];

/** Viridis at six places: even steps in lightness, so it also prints in grey. */
const VIRIDIS = [[68, 1, 84], [65, 68, 135], [42, 120, 142], [34, 168, 132], [122, 209, 81], [253, 231, 37]];

const redraws = [];

/** A chart that is drawn for the width there is, and again when the window changes. */
function chart(draw) {
  const holder = el("div", { class: "chart" });
  const redraw = () => holder.replaceChildren(draw(chartWidth()));
  redraws.push(redraw);
  redraw();
  return { holder, redraw };
}

/** Pixels across which a chart may take in the page as it stands. */
function chartWidth() {
  return Math.max(280, Math.min(980, document.getElementById("main").clientWidth - 44));
}

/** A picture; where marks in it can be reached, a group, as nothing inside a picture is read out. */
function drawing(width, height, label, ...children) {
  const attributes = { width, height, viewBox: `0 0 ${width} ${height}`, "aria-label": label };
  const made = svg("svg", attributes, svg("title", {}, label), children);
  made.setAttribute("role", made.querySelector("[tabindex]") ? "group" : "img");
  return made;
}

/** Round steps that cover [low, high] with about `count` ticks. */
function ticks(low, high, count = 5) {
  const raw = (high - low || 1) / count;
  const power = 10 ** Math.floor(Math.log10(raw));
  const step = [1, 2, 5, 10].map((m) => m * power).find((s) => s >= raw * 0.99);
  const first = Math.ceil(low / step - 1e-9);
  const last = Math.floor(high / step + 1e-9);
  return Array.from({ length: last - first + 1 }, (_, i) => Number(((first + i) * step).toPrecision(12)));
}

/** A linear scale from values, widened by 6 %, to pixels. */
function linear(values, from, to) {
  const [low, high] = extent(values) || [0, 1];
  const margin = (high - low || Math.abs(high) || 1) * 0.06;
  const domain = [low - margin, high + margin];
  const scale = (v) => from + ((v - domain[0]) / (domain[1] - domain[0])) * (to - from);
  return Object.assign(scale, { domain, range: [from, to] });
}

/** Ticks below a panel, with lines across it. */
function xAxis(scale, top, bottom, title) {
  const wanted = Math.max(2, Math.round(Math.abs(scale.range[1] - scale.range[0]) / 70));
  const marks = ticks(...scale.domain, wanted).map((value) => [
    svg("line", { class: "grid", x1: scale(value), x2: scale(value), y1: top, y2: bottom }),
    svg("text", { class: "tick", x: scale(value), y: bottom + 15, "text-anchor": "middle" }, short(value)),
  ]);
  const middle = (scale.range[0] + scale.range[1]) / 2;
  return [marks, svg("text", { class: "axis", x: middle, y: bottom + 33, "text-anchor": "middle" }, title)];
}

/** Ticks left of a panel, with lines across it, and the title above its left end. */
function yAxis(scale, left, right, title) {
  const marks = ticks(...scale.domain, 5).map((value) => [
    svg("line", { class: "grid", x1: left, x2: right, y1: scale(value), y2: scale(value) }),
    svg("text", { class: "tick", x: left - 6, y: scale(value) + 4, "text-anchor": "end" }, short(value)),
  ]);
  const top = Math.min(...scale.range) - 10;
  return [marks, svg("text", { class: "axis", x: 4, y: top, "text-anchor": "start" }, title)];
}

/** A mark around (x, y): shapes differ, so that colour is not needed to tell them apart. */
function marker(kind, x, y, size, attributes) {
  const s = size;
  const paths = {
    diamond: `M${x} ${y - s * 1.3}L${x + s * 1.3} ${y}L${x} ${y + s * 1.3}L${x - s * 1.3} ${y}Z`,
    square: `M${x - s} ${y - s}H${x + s}V${y + s}H${x - s}Z`,
    triangle: `M${x} ${y - s * 1.2}L${x + s * 1.2} ${y + s}H${x - s * 1.2}Z`,
    down: `M${x} ${y + s * 1.2}L${x + s * 1.2} ${y - s}H${x - s * 1.2}Z`,
    cross: `M${x - s} ${y - s}L${x + s} ${y + s}M${x + s} ${y - s}L${x - s} ${y + s}`,
  };
  if (kind === "circle") return svg("circle", { cx: x, cy: y, r: s, ...attributes });
  return svg("path", { d: paths[kind], ...attributes });
}

/** Cut `text` to about `pixels`; the whole stands in a title. */
function cutText(text, pixels, attributes) {
  const letters = Math.max(4, Math.floor(pixels / 7.1));
  const shown = text.length > letters ? `${text.slice(0, letters - 1)}…` : text;
  return svg("text", attributes, shown, shown === text ? null : svg("title", {}, text));
}

/** Colours of a heat map over [low, high]: {background, ink}. */
function heat(value, [low, high]) {
  if (!isNumber(value)) return { background: "transparent", ink: "inherit" };
  const place = high > low ? Math.min(1, Math.max(0, (value - low) / (high - low))) : 0.5;
  const at = Math.min(VIRIDIS.length - 2, Math.floor(place * (VIRIDIS.length - 1)));
  const share = place * (VIRIDIS.length - 1) - at;
  const rgb = VIRIDIS[at].map((v, i) => Math.round(v + (VIRIDIS[at + 1][i] - v) * share));
  const light = (0.299 * rgb[0] + 0.587 * rgb[1] + 0.114 * rgb[2]) / 255;
  return { background: `rgb(${rgb.join(" ")})`, ink: light > 0.52 ? "#111" : "#fff" };
}

/** The colour scale as a bar with its ends. */
function heatLegend(range, unit) {
  const stops = VIRIDIS.map((rgb) => `rgb(${rgb.join(" ")})`).join(", ");
  return el("div", { class: "legend-bar" }, el("span", {}, fixed(range[0], 1)),
    el("i", { style: `background: linear-gradient(90deg, ${stops})` }),
    el("span", {}, `${fixed(range[1], 1)} ${unit}`));
}
