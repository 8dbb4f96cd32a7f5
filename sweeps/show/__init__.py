"""Formats of a judged table: terminal, Markdown, CSV, LaTeX, figures, pages of results."""
