"""Hook of MkDocs: adds what is made at build time to the site.

These are the generated pages of the reference, the changelog, and formulas as MathML.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).resolve().parents[1]


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Add formulas to the Markdown and the pages of the groups to the navigation."""
    # `rgbt` and `sweeps` of this folder, and the packages beside this file.
    sys.path[:0] = [str(ROOT), str(ROOT / "docs")]
    from reference_pages.configuration import group_page_paths
    from reference_pages.formulas import mathml

    superfences = config.mdx_configs.setdefault("pymdownx.superfences", {})
    superfences["custom_fences"] = [{"name": "math", "class": "math", "format": mathml}]
    _fill(config.nav, group_page_paths())
    return config


def _fill(nav: Any, pages: list[str]) -> None:
    """Replace the entry "..." of the navigation by `pages`."""
    for entry in nav if isinstance(nav, list) else nav.values():
        if isinstance(entry, list) and "..." in entry:
            entry[entry.index("...") :] = pages
        elif isinstance(entry, list | dict):
            _fill(entry, pages)


def on_files(files: Files, *, config: MkDocsConfig) -> Files:
    """Add the generated pages to the files of docs/."""
    from reference_pages import generated_pages

    for path, text in generated_pages().items():
        files.append(File.generated(config, path, content=text))
    return files


def on_page_markdown(_markdown: str, *, page: Page, **_: Any) -> None:
    """Let the search prefer pages that answer a question to long lists that hold every word."""
    uri = page.file.src_uri
    made = uri.startswith(("results/", "reference/configuration/"))
    guide = uri.startswith(("tutorials/", "how-to/"))
    page.meta["search"] = {"boost": 0.2 if made else 3 if guide else 1}
