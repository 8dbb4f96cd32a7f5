"""Command lines in blocks of bash: simple commands with their words, read without running them."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator
from dataclasses import dataclass

from tests.docs.blocks import Block, PageError

COMPOUND = re.compile(r"^\s*(for|while|if|case|until|trap)\b|<<|^\s*\w+\(\) *\{")
SEPARATORS = {"|", "||", "&&", ";", "&", "2>&1"}
REDIRECTIONS = {">", ">>", "<", "2>", "&>"}
ASSIGNMENT = re.compile(r"[A-Za-z_]\w*=")
PYTHON = re.compile(r"python(3(\.\d+)?)?")
VENV = re.compile(r"^\.venv/bin/")
PLACEHOLDER = re.compile(r"<[^<>]+>|\.\.\.")

MODULES = re.compile(r"(rgbt|sweeps|analysis)(\.\w+)*")


@dataclass(frozen=True)
class Line:
    """One simple command.

    Attributes:
        place: page and line.
        words: after quotes are removed; `rgbt NAME` for every way to start that command.
        variables: set for this command alone.
        alone: whether no pipe, redirection or other command is on its line.
    """

    place: str
    words: tuple[str, ...]
    variables: dict[str, str]
    alone: bool = True

    @property
    def program(self) -> str:
        return self.words[0] if self.words else ""

    @property
    def has_placeholder(self) -> bool:
        """Whether a word stands for something that the reader fills in, other than a run."""
        return any(PLACEHOLDER.search(without_runs(word)) for word in self.words)


RUN = re.compile(r"runs/<[^<>]+>")


def without_runs(text: str, folder: str = "runs/0123456789ab") -> str:
    """`text` with `folder` for every ``runs/<key>``."""
    return RUN.sub(folder, text)


def is_compound(block: Block) -> bool:
    """Whether a block is a script, with loops, functions or here-documents, run as a whole."""
    return block.text.startswith("#!") or any(
        COMPOUND.search(line) for line in block.text.splitlines()
    )


def statements(block: Block) -> Iterator[tuple[int, str]]:
    """Lines of a block that are commands, continued lines joined, each with its number."""
    joined, first, closing = "", 0, ""
    for number, line in enumerate(block.text.splitlines(), 1):
        if closing:
            closing = "" if line.strip() == closing else closing
            continue
        if not joined and (not line.strip() or line.lstrip().startswith("#")):
            continue
        first = first if joined else number
        joined += line
        if joined.endswith("\\"):
            joined = joined[:-1]
            continue
        here = re.search(r"<<-?\s*['\"]?(\w+)", joined)
        closing = here[1] if here else ""
        yield first, joined
        joined = ""
    if joined:
        raise PageError(block.place(first), "the last line of the block ends with a backslash")


def lines_of(block: Block) -> list[Line]:
    """The simple commands of a block of bash.

    Raises:
        PageError: a quote that is not closed.
    """
    return [line for number, text in statements(block) for line in _simple(block, number, text)]


def _simple(block: Block, number: int, text: str) -> Iterator[Line]:
    place = block.place(number)
    lexer = shlex.shlex(RUN.sub(lambda found: found[0].replace(" ", "_"), text), posix=True)
    lexer.whitespace_split, lexer.commenters = True, "#"
    try:
        words = [part for word in lexer for part in _cut(word)]
    except ValueError as error:
        raise PageError(place, f"the shell cannot read this line: {error}") from error
    parts: list[list[str]] = [[]]
    is_file = False
    for word in words:
        if word in SEPARATORS:
            parts.append([])
        elif word not in REDIRECTIONS and not is_file:
            parts[-1].append(word)
        is_file = word in REDIRECTIONS
    alone = not (SEPARATORS | REDIRECTIONS) & set(words)
    for part in filter(None, parts):
        yield _line(place, part, alone)


def _cut(word: str) -> list[str]:
    """A word without the semicolon that ends its command."""
    return [word[:-1], ";"] if word.endswith(";") and word != ";" else [word]


def _line(place: str, words: list[str], alone: bool) -> Line:
    variables = {}
    if words[0].startswith("("):  # a shell of its own, around the whole command
        words = [words[0].lstrip("("), *words[1:]]
        words[-1] = words[-1].removesuffix(")")
    while words and ASSIGNMENT.match(words[0]):
        name, _, value = words.pop(0).partition("=")
        variables[name] = value
    while words and words[0] in ("time", "nohup", "nice", "srun", "do", "then", "else", "env"):
        is_srun = words.pop(0) == "srun"
        while is_srun and words and words[0].startswith("-"):
            words.pop(0)
    words[:1] = [VENV.sub("", word) for word in words[:1]]
    if len(words) > 2 and PYTHON.fullmatch(words[0]) and words[1] == "-m":
        words = _module(words)
    if words and PYTHON.fullmatch(words[0]):
        words[0] = "python"
    if words and words[0].startswith("$"):  # a program in a folder that a variable names
        words[0] = words[0].rpartition("/")[2]
    return Line(place, tuple(words), variables, alone)


def _module(words: list[str]) -> list[str]:
    """``python -m rgbt.run ...`` as ``rgbt run ...``; modules of others as they are."""
    from rgbt.config.plain_command import COMMANDS

    module, rest = words[2], words[3:]
    if not MODULES.fullmatch(module):
        return words
    if module == "rgbt":
        return ["rgbt", *rest]
    known = {entry.module.removesuffix(".__main__"): name for name, entry in COMMANDS.items()}
    return ["rgbt", known.get(module, module), *rest]
