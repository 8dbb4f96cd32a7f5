"""Pages, help texts and descriptions of configuration files use the words of the field."""

from __future__ import annotations

import importlib
import inspect
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest
import yaml

from rgbt.config.options import help_text
from rgbt.config.plain_command import COMMANDS, CommandGroup, PlainCommand
from tests.docs.pages import INLINE_CODE, ROOT, Page, pages

pytestmark = pytest.mark.docs

HYDRA_COMMANDS = ("run", "check", "masks")
"""Commands whose arguments are all overrides."""

LINK_TARGET = re.compile(r"\]\([^)]*\)|<[^<>]+>|https?://\S+")


@dataclass(frozen=True)
class Word:
    """An expression that is not used, and what is written instead."""

    word: str
    write: str
    only: str = ""

    @property
    def pattern(self) -> re.Pattern[str]:
        return re.compile(self.word, re.IGNORECASE)


WORDS = [
    Word(**entry) for entry in yaml.safe_load((Path(__file__).parent / "words.yaml").read_text())
]


def problems_of(lines: Iterator[tuple[str, str]], *, page: bool) -> list[str]:
    """Words of `lines`, each with its place, that are not used."""
    return [
        f"{place}: '{found[0]}'; write: {word.write}"
        for place, line in lines
        for word in WORDS
        if page or not word.only
        for found in word.pattern.finditer(line)
    ]


def of_page(page: Page) -> Iterator[tuple[str, str]]:
    """Lines of prose, without code, targets of links and tags."""
    for number, line in page.prose.items():
        if line.startswith(":::"):  # a name of the Python API
            continue
        yield f"{page.name}:{number}", LINK_TARGET.sub("]", INLINE_CODE.sub("", line))


def of_help(name: str) -> Iterator[tuple[str, str]]:
    """Lines of ``rgbt NAME --help``."""
    yield f"rgbt --help ({name})", COMMANDS[name].about
    if name in HYDRA_COMMANDS:
        return
    entry = importlib.import_module(COMMANDS[name].module).entry
    members = [entry] if isinstance(entry, PlainCommand) else list(entry.commands.values())
    if isinstance(entry, CommandGroup):
        members += [entry.default] if entry.default else []
    for member in members:
        text = help_text(name, member.options, inspect.getdoc(member.main) or "")
        # Lines are joined: an expression may be broken between two.
        yield f"rgbt {name} --help", " ".join(text.split())


def of_configuration(path: Path) -> Iterator[tuple[str, str]]:
    """The comment at the beginning of a file of conf/."""
    lines = path.read_text().splitlines()
    for number, line in enumerate(lines, 1):
        if not line.startswith("#"):
            return
        yield f"{path.relative_to(ROOT)}:{number}", line


@pytest.mark.parametrize("page", pages(), ids=lambda page: page.name)
def test_page_uses_the_words_of_the_field(page: Page) -> None:
    problems = problems_of(of_page(page), page=True)
    assert not problems, "\n" + "\n".join(problems)


def test_help_uses_the_words_of_the_field() -> None:
    lines = (line for name in COMMANDS for line in of_help(name))
    problems = problems_of(lines, page=False)
    assert not problems, "\n" + "\n".join(problems)


def test_configuration_uses_the_words_of_the_field() -> None:
    files = sorted((ROOT / "conf").rglob("*.yaml"))
    problems = problems_of((line for path in files for line in of_configuration(path)), page=False)
    assert not problems, "\n" + "\n".join(problems)


@pytest.mark.parametrize(
    ("line", "found"),
    [
        ("A run that stands on another run.", "'stands on'; write: depends on"),
        ("Killed and given again, the command goes on.", "'Killed and given again'; write: Rerun"),
        ("The training goes on.", "'goes on'; write: continues, resumes"),
        ("The network is told which.", "'is told'; write: is given, is set to"),
        ("A masker of one's own.", "'of one's own'; write: your own, a custom ..."),
        ("The run knows its seed.", "'run knows'; write: a verb of what"),
        ("Download the dataset.", "'dataset'; write: data set"),
        ("The optimiser of the paper.", "'optimiser'; write: optimizer"),
    ],
)
def test_word_that_is_not_used_is_named(line: str, found: str) -> None:
    page = Page(Path("page.md"), prose={3: line})
    assert any(f"page.md:3: {found}" in each for each in problems_of(of_page(page), page=True))


def test_code_and_links_are_no_prose() -> None:
    page = Page(Path("page.md"), prose={1: "`dataset=mfnet`, [data](dataset.md)"})
    assert problems_of(of_page(page), page=True) == []
