"""The pages of the documentation, by the conventions of CONTRIBUTING.md.

A fenced block has a language. A block with a title is a file that the reader creates; another block
with the same title continues it. ``<!-- needs: MFNet -->`` on the line before a block says that it
cannot run without that.
"""

from __future__ import annotations

import ast
import math
import os
import re
import subprocess
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

import yaml

ROOT = Path(__file__).resolve().parents[2]
LANGUAGES = {"bash", "python", "yaml", "text", "json", "toml", "bibtex", "math", "csv", "jinja"}
CODE_COLUMNS, PROSE_COLUMNS = 100, 120
INLINE_CODE = re.compile(r"(?<!`)`([^`\n]+)`(?!`)")
LINK = re.compile(r"(?<!\\)\]\(([^()\s]+)\)")
NEEDS = re.compile(r"<!-- *needs: *(.*?) *-->")
PATH = re.compile(
    r"(?:rgbt|sweeps|analysis|conf|docs|tests|hydra_plugins)/[\w./-]+\.(?:py|yaml|md|j2|js|css|csv)"
)
NAMED = re.findall(r"- (\S+\.md)$", (ROOT / "mkdocs.yml").read_text(), re.MULTILINE)
MADE = [re.escape(each) for each in NAMED if not (ROOT / "docs" / each).exists()]
GENERATED = re.compile(
    rf"docs/({'|'.join(MADE)}|reference/configuration/[\w-]+\.md|results/.*\.md)"
)
"""Pages that exist in the built site alone, and results: `make docs` checks the links to them."""


@dataclass
class Block:
    """One fenced block; `line` is that of its fence, `answer` the block of output below it."""

    line: int
    language: str
    title: str
    needs: str
    text: str
    answer: str = ""

    @property
    def mistake(self) -> str:
        """The beginning of the sentence with which the program answers a mistake; "": none."""
        found = re.search(r"^rgbt: (.+(?:\n.+)*)", self.answer, re.MULTILINE)
        return " ".join(found[1].split())[:25] if found else ""


@dataclass
class Page:
    """A Markdown file: its blocks, and its prose by line."""

    path: Path
    blocks: list[Block] = field(default_factory=list)
    prose: dict[int, str] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """Path in the repository."""
        return os.path.relpath(self.path, ROOT)

    @classmethod
    def read(cls, path: Path) -> Page:
        """Raises AssertionError for a fence that is not closed."""
        page, block, needs, follows = cls(path), None, "", False
        for number, line in enumerate(path.read_text().splitlines(), 1):
            if block is None and line.startswith("```"):
                language, _, rest = line[3:].partition(" ")
                title = re.search(r'title="([^"]+)"', rest)
                block = Block(number, language, title[1] if title else "", needs, "")
            elif block is None:
                page.prose[number] = line
                found = NEEDS.search(line)
                needs = found[1] if found else needs if not line.strip() else ""
                follows = follows and not line.startswith("#")
            elif line.rstrip() == "```":
                if follows and block.language == "text" and not block.title:
                    page.blocks[-1].answer = block.text
                page.blocks.append(block)
                block, needs, follows = None, "", True
            else:
                block.text += line + "\n"
        assert block is None, f"{page.name}: a block is not closed"
        return page

    @property
    def anchors(self) -> set[str]:
        """Names of the headings, as Git hosts and as MkDocs make them."""
        names = set()
        for line in self.prose.values():
            if line.startswith("#"):
                text = re.sub(r"\]\([^)]*\)|[`*\[\]#]", "", line).strip().lower()
                words = re.sub(r"[^\w\- ]", "", text)
                names |= {words.replace(" ", "-"), re.sub(r"[-\s]+", "-", words)}
        return names


@cache
def pages() -> tuple[Page, ...]:
    """README, CONTRIBUTING and the pages of the site."""
    paths = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "docs/index.md"]
    return tuple(Page.read(path) for path in [*paths, *sorted((ROOT / "docs").glob("*/**/*.md"))])


def problems_of(page: Page) -> Iterator[str]:
    """What is wrong with a page and can be seen without running it, each with its line."""
    titles = [line for line in page.prose.values() if line.startswith("# ")]
    if len(titles) != 1:
        yield f"{len(titles)} headings of level one"
    created = {block.title for block in page.blocks}
    by_command = any("Made by `make results`" in line for line in page.prose.values())
    for number, line in page.prose.items():
        is_one_word = " " not in line.strip().removeprefix("- ")
        is_made = by_command or line.lstrip().startswith("|") or "<!-- results:" in line
        if len(line) > PROSE_COLUMNS and not is_made and not is_one_word:
            yield f"{number}: {len(line)} characters"
        for code in INLINE_CODE.findall(line):
            is_path = PATH.fullmatch(code) and not GENERATED.fullmatch(code)
            if is_path and code not in created and not (ROOT / code).exists():
                yield f"{number}: `{code}` is not a file of this repository"
        yield from (f"{number}: {each}" for each in _broken_links(page, line))
    for block in page.blocks:
        if block.language not in LANGUAGES:
            yield f"{block.line}: a block of language '{block.language}'"
        if any(len(line) >= CODE_COLUMNS for line in block.text.splitlines()):
            yield f"{block.line}: a line of code with {CODE_COLUMNS} characters or more"
        yield from (f"{block.line}: {each}" for each in _unreadable(block))


def _broken_links(page: Page, line: str) -> Iterator[str]:
    for target in LINK.findall(INLINE_CODE.sub("", line)):
        name, _, anchor = target.partition("#")
        path = (page.path.parent / name).resolve() if name else page.path
        generated = GENERATED.fullmatch(os.path.relpath(path, ROOT)) and page.path.parent != ROOT
        if re.match(r"[a-z]+:", target) or generated:
            continue
        if not path.exists():
            yield f"the link {target} leads to no file"
        elif anchor and anchor not in Page.read(path).anchors:
            yield f"the link {target} leads to no heading"


def _unreadable(block: Block) -> Iterator[str]:
    try:
        if block.language == "python":
            ast.parse(block.text)
        elif block.language == "yaml":
            yaml.safe_load(block.text)
        elif block.language == "bash":
            done = subprocess.run(
                ["bash", "-n"], input=filled(block.text), text=True, capture_output=True
            )
            if done.returncode:
                yield done.stderr
            targets = re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE)
            for target in re.findall(r"^make ([\w-]+)", block.text, re.MULTILINE):
                if target not in targets:
                    yield f"make has no target '{target}'"
    except (SyntaxError, yaml.YAMLError) as error:
        yield str(error)


def write(block: Block, folder: Path) -> None:
    """Write the file of a titled block, or continue it."""
    path = folder / block.title
    assert path.resolve().is_relative_to(folder.resolve()), block.title
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a") as file:
        file.write(block.text)


def filled(text: str, run: str = "$(newest)") -> str:
    """Bash with a finished run for every ``runs/<key>`` and a word for what else is in <>."""
    return re.sub(r"(?<![<\w])<[a-z][^<>\n]*>", "x", re.sub(r"runs/<[^<>]+>", run, text))


def difference(shown: str, printed: str) -> str:
    """The first word in which two outputs differ; "": none. Numbers may differ by 1 %.

    After "..." in `shown`, anything may follow.
    """
    number = r"[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?"
    expected, found = shown.partition("...")[0].split(), printed.split()
    for one, other in zip(expected, [*found, *[""] * len(expected)], strict=False):
        pairs = list(zip(re.findall(number, one), re.findall(number, other), strict=False))
        near = all(math.isclose(float(a), float(b), rel_tol=0.01, abs_tol=0.02) for a, b in pairs)
        if re.sub(number, "0", one) != re.sub(number, "0", other) or not near:
            return f"the page shows '{one}', the block prints '{other}'"
    rest = found[len(expected) :] if "..." not in shown else []
    return f"the block also prints '{rest[0]}'" if rest else ""
