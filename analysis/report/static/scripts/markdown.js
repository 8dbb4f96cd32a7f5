// As much Markdown as the reports of studies use, as elements: text stays text.
"use strict";

/** Blocks of `text`: headings, tables, lists, fenced code, paragraphs. */
function markdown(text) {
  const lines = text.split("\n");
  const blocks = [];
  while (lines.length) {
    if (!lines[0].trim()) lines.shift();
    else if (lines[0].startsWith("```")) blocks.push(fenced(lines));
    else if (/^#{1,6} /.test(lines[0])) blocks.push(el("h4", {}, inline(lines.shift().replace(/^#+ /, ""))));
    else if (/^\s*\|/.test(lines[0])) blocks.push(markdownTable(take(lines, /^\s*\|/)));
    else if (/^\s*[-*] /.test(lines[0])) blocks.push(markdownList(take(lines, /^\s*[-*] |^\s{2,}\S/)));
    else blocks.push(el("p", {}, inline(take(lines, /^(?!```|#{1,6} |\s*\||\s*[-*] )\s*\S/).join(" "))));
  }
  return blocks;
}

/** Remove and return the lines at the start that match; at least one. */
function take(lines, pattern) {
  const taken = [lines.shift()];
  while (lines.length && pattern.test(lines[0])) taken.push(lines.shift());
  return taken;
}

function fenced(lines) {
  lines.shift();
  const code = [];
  while (lines.length && !lines[0].startsWith("```")) code.push(lines.shift());
  lines.shift();
  return el("pre", {}, el("code", {}, code.join("\n")));
}

function markdownTable(lines) {
  const split = (line) => line.trim().replace(/^\||\|$/g, "").split(/(?<!\\)\|/).map((cell) => cell.trim().replaceAll("\\|", "|"));
  const rows = lines.map(split).filter((row) => !row.every((cell) => /^:?-+:?$/.test(cell)));
  const [head, ...body] = rows;
  const classOf = (index) => (index ? "number" : null);
  return scrollBox("table of the report", el("table", { class: "plain" },
    el("thead", {}, el("tr", {}, head.map((cell, i) => el("th", { scope: "col", class: classOf(i) }, inline(cell))))),
    el("tbody", {}, body.map((row) => el("tr", {}, row.map((cell, i) => el(i ? "td" : "th", { class: classOf(i) }, inline(cell))))))));
}

function markdownList(lines) {
  const items = [];
  for (const line of lines) {
    if (/^\s*[-*] /.test(line)) items.push(line.replace(/^\s*[-*] /, ""));
    else items[items.length - 1] += ` ${line.trim()}`;
  }
  return el("ul", {}, items.map((item) => el("li", {}, inline(item))));
}

/** **bold** and `code`. */
function inline(text) {
  return text.split(/(`[^`]+`|\*\*[^*]+\*\*)/).filter(Boolean).map((part) => {
    if (/^`[^`]+`$/.test(part)) return el("code", {}, part.slice(1, -1));
    if (/^\*\*[^*]+\*\*$/.test(part)) return el("strong", {}, part.slice(2, -2));
    return part;
  });
}
