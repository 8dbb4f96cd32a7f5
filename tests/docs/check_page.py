"""Everything about a page that can be checked without running it."""

from __future__ import annotations

import ast
import os
import re
from collections.abc import Iterator
from pathlib import Path
from unittest.mock import patch

import pytest
import yaml

from tests.docs.blocks import ROOT, Block, Page, PageError
from tests.docs.command_lines import check_line
from tests.docs.reader_folder import export, reading_in, write_titled
from tests.docs.shell import Line, is_compound, lines_of

LANGUAGES = {"bash", "python", "yaml", "text"}
NOT_RUN = {"json", "toml", "bibtex", "latex", "html", "csv", "diff", "markdown", "jinja", "math"}
CODE_COLUMNS = 100
"""Lines of code have fewer characters."""

PROSE_COLUMNS = 120
"""Lines of Markdown outside tables have at most as many; 100 is what pages aim at."""

REPOSITORY_PATH = re.compile(
    r"(?:rgbt|sweeps|analysis|conf|docs|tests|hydra_plugins)/[\w./-]+\.(?:py|yaml|md|j2|js|css|csv)"
)
NAMED = re.findall(r"- (\S+\.md)$", (ROOT / "mkdocs.yml").read_text(), re.MULTILINE)
MADE = [re.escape(each) for each in NAMED if not (ROOT / "docs" / each).exists()]
GENERATED = re.compile(
    rf"docs/({'|'.join(MADE)}|reference/configuration/[\w-]+\.md|results/.*\.md)"
)
"""Pages of the navigation that exist only in the built site, those of the groups of the
configuration, and results; `make docs` checks the links to them."""


def problems_of(page: Page, folder: Path) -> list[str]:
    """What is wrong with a page, one sentence each with page and line.

    Args:
        page: to check.
        folder: empty; the files of titled blocks are written there.
    """
    checks = (layout(page), paths(page), links(page), blocks(page, folder))
    return [problem for check in checks for problem in check]


def layout(page: Page) -> Iterator[str]:
    """Lines that are too long, headings and fences."""
    titles = [token for token in page.tokens if token.type == "heading_open" and token.tag == "h1"]
    if len(titles) != 1:
        yield f"{page.name}: {len(titles)} headings of level one; expected one"
    for number, line in page.prose():
        is_table = line.lstrip().startswith("|")
        is_link = " " not in line.strip().removeprefix("- ")
        if len(line) > PROSE_COLUMNS and not is_table and not is_link:
            yield f"{page.name}:{number}: {len(line)} characters; expected at most {PROSE_COLUMNS}"
        if line.startswith("!!!"):
            yield f"{page.name}:{number}: Git hosts do not show admonitions; write prose"
    for block in page.blocks:
        for number, line in enumerate(block.text.splitlines(), 1):
            if len(line) >= CODE_COLUMNS and block.language != "math":
                yield (
                    f"{block.place(number)}: {len(line)} characters of code; expected fewer than "
                    f"{CODE_COLUMNS}"
                )
        if block.language not in LANGUAGES | NOT_RUN:
            named = f"language '{block.language}'" if block.language else "no language"
            yield (
                f"{block.place()}: a block with {named}; expected "
                f"{', '.join(sorted(LANGUAGES | NOT_RUN))}"
            )


def paths(page: Page) -> Iterator[str]:
    """Inline code that looks like a file of the repository and is none."""
    created = {block.title for block in page.blocks}
    for number, piece in page.inline_code():
        is_path = REPOSITORY_PATH.fullmatch(piece) and not GENERATED.fullmatch(piece)
        if is_path and piece not in created and not (ROOT / piece).exists():
            yield f"{page.name}:{number}: `{piece}` is not a file of this repository"


def links(page: Page) -> Iterator[str]:
    """Relative links whose file or heading is missing."""
    for number, target in page.links():
        if re.match(r"[a-z]+:", target):
            continue
        name, _, anchor = target.partition("#")
        path = (page.path.parent / name).resolve() if name else page.path
        inside = os.path.relpath(path, ROOT)
        if GENERATED.fullmatch(inside) and page.path.parent != ROOT:
            continue
        if name and not path.exists():
            yield f"{page.name}:{number}: the link {target} leads to no file"
        elif anchor and (page if path == page.path else Page.read(path)).anchors().isdisjoint(
            {anchor}
        ):
            yield f"{page.name}:{number}: the link {target} leads to no heading of {inside}"


def blocks(page: Page, folder: Path) -> Iterator[str]:
    """Blocks in the order of the page: files are written, commands are checked."""
    with reading_in(folder) as variables:
        for block in page.blocks:
            try:
                if block.title:
                    write_titled(block, folder)
                    _use_own_files(folder, variables)
            except PageError as error:
                yield str(error)
            yield from _of_block(block, folder, variables)


def _use_own_files(folder: Path, variables: pytest.MonkeyPatch) -> None:
    """Compose with the reader's files, wherever the page says that they are."""
    if (folder / "conf").is_dir():
        variables.setenv("RGBT_CONF", str(folder / "conf"))


def _of_block(block: Block, folder: Path, variables: pytest.MonkeyPatch) -> Iterator[str]:
    if block.language == "python":
        yield from _python(block)
    elif block.language == "yaml":
        yield from _yaml(block)
    elif block.language == "bash":
        yield from _bash(block, folder, variables)


def _python(block: Block) -> Iterator[str]:
    try:
        ast.parse(block.text)
    except SyntaxError as error:
        yield f"{block.place(error.lineno or 0)}: Python cannot read this: {error.msg}"


def _yaml(block: Block) -> Iterator[str]:
    try:
        yaml.safe_load(block.text)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        reason = getattr(error, "problem", None) or error
        yield f"{block.place(mark.line + 1 if mark else 0)}: YAML cannot read this: {reason}"


def _bash(block: Block, folder: Path, variables: pytest.MonkeyPatch) -> Iterator[str]:
    try:
        lines = lines_of(block)
    except PageError as error:
        yield str(error)
        return
    for line in lines:
        problem = _of_line(line, block.needs, script=bool(block.title) or is_compound(block))
        # A page may show a mistake with the sentence that answers it.
        if problem and not (block.shown and block.shown in problem):
            yield problem
        if line.program == "export" and not any("RGBT_CONF" in word for word in line.words):
            export(line, folder, variables)


def _of_line(line: Line, needs: str, *, script: bool) -> str:
    with patch.dict(os.environ, line.variables):
        try:
            check_line(line, needs, script=script)
        except PageError as error:
            return str(error)
    return ""
