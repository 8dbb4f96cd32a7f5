"""A scored table for people: terminal, Markdown, CSV, LaTeX, figure."""
