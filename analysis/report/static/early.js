// Runs in the head, before anything is painted: a remembered theme must not flash.
"use strict";

/** The theme; "auto" follows the system. Pages from file:// may be refused storage. */
function theme(chosen) {
  let name = chosen ?? "auto";
  try {
    name = chosen ?? localStorage.getItem("rgbt-theme") ?? "auto";
    localStorage.setItem("rgbt-theme", name);
  } catch (error) { /* Refused: the theme holds until the page is closed. */ }
  if (name === "auto") delete document.documentElement.dataset.theme;
  else document.documentElement.dataset.theme = name;
  return name;
}

theme();
