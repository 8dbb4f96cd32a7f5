"""One HTML file of the own results and of the Markdown pages; it loads nothing."""

from __future__ import annotations

import base64
import hashlib
import html
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined

TEMPLATES = Path(__file__).with_name("templates")

FOLDED = re.compile(r'^(<details markdown="1"><summary>[^<]*</summary>|</details>)$', re.MULTILINE)
PICTURE = re.compile(r'<img src="([^"]*)" alt="([^"]*)" />')


def html_page(own: Mapping[str, Any], rest: str, not_run: str, images: Mapping[str, bytes]) -> str:
    """Return the page: `own` (`sweeps.show.own`), then texts in Markdown with their `images`."""
    script = (TEMPLATES / "sort.js").read_text()
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    shell = Environment(
        loader=FileSystemLoader(TEMPLATES),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    page = shell.get_template("page.html.j2")
    texts = {"rest": _rendered(rest, images), "not_run": _rendered(not_run, images)}
    return page.render(**own, **texts, script=script, hash=f"sha256-{digest}")


def _rendered(text: str, images: Mapping[str, bytes]) -> str:
    """Markdown as HTML, with headings one level lower than written and figures inside."""
    from markdown_it import MarkdownIt

    from analysis.figures.page import inline

    text = re.sub(r"<!--.*?-->\n", "", text)
    reader = MarkdownIt("commonmark", {"html": False}).enable("table")
    body = ""
    for place, part in enumerate(FOLDED.split(text)):  # every second part is a tag
        if place % 2:
            body += part.replace(' markdown="1"', "")
            continue
        tokens = reader.parse(part)
        for token in tokens:
            if token.type.startswith("heading"):
                token.tag = f"h{int(token.tag[1]) + 1}"
        body += reader.renderer.render(tokens, reader.options, {})
    body = body.replace("<table>", '<div class="scroll"><table>')
    body = body.replace("</table>", "</table></div>")
    numbers = {name: number for number, name in enumerate(images, start=1000)}

    def drawn(found: re.Match[str]) -> str:
        name, title = map(html.unescape, found.groups())
        if name not in images:  # in a text of a run: nothing is loaded
            return found[2]
        return f'<div class="scroll">{inline(images[name], title, numbers[name])}</div>'

    return PICTURE.sub(drawn, body)
