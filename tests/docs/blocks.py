"""Code blocks of the documentation, read by the conventions of CONTRIBUTING.md.

A fenced block has a language. A block with a title is a file that the reader creates; another block
with the same title continues that file. ``<!-- needs: MFNet -->`` on the line before a block says
that it cannot run without that.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cache, cached_property
from pathlib import Path

from markdown_it import MarkdownIt
from markdown_it.token import Token

ROOT = Path(__file__).resolve().parents[2]

TITLE = re.compile(r'title="([^"]+)"')
NEEDS = re.compile(r"<!-- *needs: *(.*?) *-->\s*\Z", re.DOTALL)
INLINE_CODE = re.compile(r"(?<!`)`([^`\n]+)`(?!`)")
LINK = re.compile(r"(?<!\\)\]\(([^()\s]+)\)")
SHOWN = 25
"""Characters of a sentence by which it is recognised: what follows may hold paths."""


class PageError(Exception):
    """Something of a page that is wrong: page, line and reason."""

    def __init__(self, place: str, reason: str) -> None:
        super().__init__(f"{place}: {reason}")


@dataclass(frozen=True)
class Block:
    """One fenced block.

    Attributes:
        page: as it is named in messages.
        line: of its fence, counted from one.
        language: first word of the fence.
        title: file that the reader creates; "": none.
        needs: what it cannot run without; "": it runs anywhere.
        text: what is between the fences.
        answer: the next block, where it is one of output below the same heading; "": none.
    """

    page: str
    line: int
    language: str
    text: str
    title: str = ""
    needs: str = ""
    answer: str = ""

    @property
    def shown(self) -> str:
        """The sentence of `answer` that the program writes to stderr, its beginning; "": none."""
        found = re.search(r"^rgbt: (.+(?:\n.+)*)", self.answer, re.MULTILINE)
        return " ".join(found[1].split())[:SHOWN] if found else ""

    def place(self, line: int = 0) -> str:
        """Page and line; `line` counts from one inside the block."""
        return f"{self.page}:{self.line + line}"


@dataclass
class Page:
    """One Markdown file, or a text as if it were one."""

    name: str
    text: str
    path: Path = field(default=Path())

    @classmethod
    def read(cls, path: Path) -> Page:
        """The page in the file `path` of the repository."""
        name = path.relative_to(ROOT) if path.is_relative_to(ROOT) else path
        return cls(str(name), path.read_text(), path)

    @cached_property
    def lines(self) -> list[str]:
        return self.text.splitlines()

    @cached_property
    def tokens(self) -> list[Token]:
        return MarkdownIt("commonmark").enable("table").parse(self.text)

    @cached_property
    def blocks(self) -> list[Block]:
        """All fenced blocks, in the order of the page."""
        blocks: list[Block] = []
        has_heading = False
        for number, token in enumerate(self.tokens):
            has_heading = has_heading or token.type == "heading_open"
            if token.type != "fence" or token.map is None:
                continue
            before = self.tokens[number - 1] if number else None
            found = NEEDS.search(before.content) if before and before.type == "html_block" else None
            language, title = token.info.partition(" ")[0], TITLE.search(token.info)
            block = Block(
                *(self.name, token.map[0] + 1, language, token.content),
                title=title[1] if title else "",
                needs=found[1] if found else "",
            )
            if blocks and language == "text" and not title and not has_heading:
                blocks[-1] = Block(**{**vars(blocks[-1]), "answer": token.content})
            blocks.append(block)
            has_heading = False
        return blocks

    @cached_property
    def fenced(self) -> set[int]:
        """Lines, from one, that belong to fenced blocks with their fences."""
        return {
            line
            for token in self.tokens
            if token.type == "fence" and token.map
            for line in range(token.map[0] + 1, token.map[1] + 1)
        }

    def prose(self) -> Iterator[tuple[int, str]]:
        """Lines outside fenced blocks, each with its number."""
        for number, line in enumerate(self.lines, 1):
            if number not in self.fenced:
                yield number, line

    def inline_code(self) -> Iterator[tuple[int, str]]:
        """Pieces of inline code in prose, each with its line."""
        for number, line in self.prose():
            yield from ((number, piece) for piece in INLINE_CODE.findall(line))

    def links(self) -> Iterator[tuple[int, str]]:
        """Targets of links and pictures, each with its line."""
        for number, line in self.prose():
            yield from ((number, target) for target in LINK.findall(INLINE_CODE.sub("", line)))

    def anchors(self) -> set[str]:
        """Names of the headings, as Git hosts and as MkDocs make them."""
        names = set()
        for number, token in enumerate(self.tokens):
            if token.type != "heading_open":
                continue
            text = re.sub(r"\]\([^)]*\)|[`*\[\]]", "", self.tokens[number + 1].content)
            words = re.sub(r"[^\w\- ]", "", text.strip().lower())
            names |= {words.replace(" ", "-"), re.sub(r"[-\s]+", "-", words)}
        return names


@cache
def pages() -> tuple[Page, ...]:
    """Pages whose blocks are checked: README, CONTRIBUTING and the pages of the site."""
    paths = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "docs/index.md"]
    paths += sorted((ROOT / "docs").glob("*/**/*.md"))
    return tuple(Page.read(path) for path in paths if path.is_file())


def tutorials_of_own_parts() -> list[Page]:
    """The pages on parts of the reader's: few and important, run by the default suite."""
    return [page for page in pages() if re.match(r"docs/tutorials/own-.*", page.name)]
