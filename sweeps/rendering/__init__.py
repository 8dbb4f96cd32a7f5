"""Formats of a scored table: terminal, Markdown, CSV, LaTeX, figure."""
