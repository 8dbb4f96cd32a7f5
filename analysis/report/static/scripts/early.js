// Runs in the head, before anything is painted: a remembered theme must not flash.
"use strict";

/** The remembered theme; "auto" follows the system. */
function rememberedTheme() {
  try {
    return localStorage.getItem("rgbt-theme") || "auto";
  } catch (error) {
    return "auto"; // Pages from file:// may be refused storage.
  }
}

/** Show a theme ("auto", "light" or "dark") and remember it where that is allowed. */
function applyTheme(theme) {
  if (theme === "auto") delete document.documentElement.dataset.theme;
  else document.documentElement.dataset.theme = theme;
  try {
    localStorage.setItem("rgbt-theme", theme);
  } catch (error) {
    // Refused: the theme holds until the page is closed.
  }
}

applyTheme(rememberedTheme());
