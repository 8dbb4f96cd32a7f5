"""Pages are well formed, their commands exist, and they can be followed with short trainings."""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
import traceback
from collections.abc import Iterator
from contextlib import redirect_stdout
from dataclasses import replace
from io import StringIO
from pathlib import Path
from typing import Any

import pytest

from rgbt.config.compose import check_keys, compose
from rgbt.config.options import readable_paths
from rgbt.config.overrides import composing
from rgbt.config.plain_command import COMMANDS
from tests.docs.pages import ROOT, Block, Page, difference, filled, pages, problems_of, write
from tests.docs.small import ENOUGH, SMOKE
from tests.forked_python import PYTHON

pytestmark = pytest.mark.docs

MAX_SECONDS = 300
OWN_IMAGES = "your images"
"""What a block needs that the tutorial on own data sets makes: conf/dataset/mine.yaml."""

SETUP = re.compile(r"^\s*(pip|git clone|source|make|python3? -m venv|\.venv/bin/pip)\b.*$", re.M)
"""Lines that install; the reader has a working installation."""


def runnable(page: Page) -> list[Block]:
    """Blocks that a reader without data, weights or servers can run."""
    found = [each for each in page.blocks if each.language in ("bash", "python")]
    return [each for each in found if not each.needs and not each.title]


@pytest.mark.parametrize("page", pages(), ids=lambda page: page.name)
def test_page_is_well_formed(page: Page) -> None:
    assert list(problems_of(page)) == []


@pytest.mark.parametrize("page", pages(), ids=lambda page: page.name)
def test_commands_exist_and_runs_that_need_more_compose(page: Page) -> None:
    own = any(block.title.startswith("conf/") for block in page.blocks)
    for block in page.blocks:
        if block.language != "bash":
            continue
        text = filled(block.text, "runs/0123456789ab").replace("\\\n", " ")
        for words in _commands(text):
            assert words[0] in COMMANDS or words[0].startswith("-"), (block.line, words)
            if block.needs not in ("", OWN_IMAGES) and words[0] == "run" and not own:
                _composes(words[1:])


def _commands(text: str) -> Iterator[list[str]]:
    """The words behind ``rgbt`` of every line."""
    for line in text.splitlines():
        found = re.match(r"\s*(?:\w+=\S+ )*(?:srun [-\w= ]*)?rgbt (\S.*)", line)
        if found:
            yield shlex.split(re.split(r" (?:[|&;>]|2>)", found[1])[0], comments=True)


def _composes(words: list[str]) -> None:
    own = ("-", "hydra", "corruption.", "weights.", "predictions.", "pretrained.", "${")
    kept = [
        w for w in readable_paths(words) if not w.startswith(own) and w.rpartition("=")[2] != "x"
    ]
    grids = [word for word in kept if re.search(r"=[^\[{]*,|\(", word)]
    with composing(kept):
        check_keys(compose([word for word in kept if word not in grids]))


@pytest.fixture(scope="session")
def finished(forks: dict[str, str], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with one finished run, for pages that begin with one."""
    runs = tmp_path_factory.mktemp("finished") / "runs"
    words = ["+experiment=grbm", f"runs_dir={runs}", "tracking=none", *SMOKE, ENOUGH]
    command = [*PYTHON.split(), "-m", "rgbt.run", *words]
    subprocess.run(command, check=True, capture_output=True, env=os.environ | forks)
    return runs


@pytest.mark.slow
@pytest.mark.parametrize("page", [p for p in pages() if runnable(p)], ids=lambda page: page.name)
def test_page_can_be_followed(
    page: Page, tmp_path: Path, finished: Path, forks: dict[str, str]
) -> None:
    """Every block in order: bash in one shell after the other, Python in one process."""
    reader = Reader(page, tmp_path / "reader", finished, forks)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(reader.folder)
        patch.setenv("MPLBACKEND", "agg")
        for block in with_own_images(page):
            problem = reader.follow(block)
            assert not problem, f"{page.name}:{block.line}: {problem}"


def with_own_images(page: Page) -> Iterator[Block]:
    """The blocks of a page; before one that needs images of the reader, those that make some."""
    for block in page.blocks:
        if block.needs == OWN_IMAGES:
            tutorial = Page.read(ROOT / "docs" / "tutorials" / "own-data-set.md")
            last = next(n for n, text in tutorial.prose.items() if text.startswith("## 4"))
            first = next(n for n, text in tutorial.prose.items() if text.startswith("## 2"))
            yield from (each for each in tutorial.blocks if first < each.line < last)
            block = replace(block, needs="")
        yield block


class Reader:
    """Follows one page in an empty folder."""

    def __init__(self, page: Page, folder: Path, finished: Path, forks: dict[str, str]) -> None:
        self.folder, self.state = folder, folder.parent / "state"
        tools = folder.parent / "bin"
        for each in (folder, tools):
            each.mkdir()
        newest = f"[ -d runs ] || cp -r {finished} runs; ls -td runs/*/result.json | head -1"
        scripts = {
            "rgbt": f'exec {PYTHON} -m tests.docs.small "$@"',
            "newest": f'dirname "$({newest})"',
        }
        for name, text in scripts.items():
            (tools / name).write_text(f"#!/bin/sh\n{text}\n")
            (tools / name).chmod(0o755)
        self.environment = {
            **os.environ,
            **forks,
            "PATH": os.pathsep.join(
                [str(tools), str(Path(sys.executable).parent), os.environ["PATH"]]
            ),
            "PYTHONPATH": f"{ROOT}{os.pathsep}{folder}",
            "RGBT_PAGE": str(page.path),
        }
        self.names: dict[str, Any] = {"__name__": "__main__"}

    def follow(self, block: Block) -> str:
        """What went wrong; "": nothing."""
        if block.title:
            write(block, self.folder)
        elif not block.needs and block.language == "python":
            return self._python(block)
        elif not block.needs and block.language == "bash":
            return self._bash(block)
        return ""

    def _bash(self, block: Block) -> str:
        text = filled(SETUP.sub("", block.text)).replace("python -m rgbt ", "rgbt ")
        text = re.sub(r"python3? -m rgbt\.run\b", "rgbt run", text)
        # What a block exports and where it ends is where the next one begins.
        script = (
            f"[ -f {self.state} ] && . {self.state}\nset -e\n{text}\nexport -p > {self.state}\n"
        )
        script += f"pwd > {self.state}.folder\n"
        done = subprocess.run(
            ["bash", "-c", script],
            cwd=self.folder,
            env=self.environment,
            timeout=MAX_SECONDS,
            capture_output=True,
            text=True,
        )
        if not done.returncode:
            self.folder = Path(Path(f"{self.state}.folder").read_text().strip())
        shown = block.mistake
        if done.returncode and not (shown and shown in " ".join(done.stderr.split())):
            return f"exit code {done.returncode}\n{done.stdout[-1500:]}\n{done.stderr[-1500:]}"
        return ""

    def _python(self, block: Block) -> str:
        text = block.text
        if "runs/<" in text:
            newest = subprocess.run(["newest"], cwd=self.folder, env=self.environment, **OUTPUT)
            text = filled(text, newest.stdout.strip())
        printed = StringIO()
        try:
            with redirect_stdout(printed):
                exec(compile(text, f"line {block.line}", "exec"), self.names)
        except (Exception, SystemExit):
            return traceback.format_exc(limit=-3)
        # Scores of a training of two steps are others than those of the page.
        trained = (self.folder / "runs").exists()
        return "" if trained or not block.answer else difference(block.answer, printed.getvalue())


OUTPUT: dict[str, Any] = {"capture_output": True, "text": True, "check": True}


BAD = {
    "two\n\n# Again\n": "2 headings",
    "See [this](gone.md).\n": "leads to no file",
    "See [this](#gone).\n": "leads to no heading",
    "See `rgbt/nothing.py`.\n": "not a file",
    "x " * 70 + "\n": "140 characters",
    "```shell\nls\n```\n": "language 'shell'",
    "```bash\nfor\n```\n": "syntax error",
    "```bash\nmake dmo\n```\n": "no target 'dmo'",
    "```python\nx = (\n```\n": "was never closed",
    "```yaml\na: [1\n```\n": "expected ',' or ']'",
}


@pytest.mark.parametrize("text", BAD)
def test_problem_of_a_page_is_found(text: str, tmp_path: Path) -> None:
    path = tmp_path / "page.md"
    path.write_text(f"# Title\n\n{text}")
    (problem,) = problems_of(Page.read(path))
    assert BAD[text] in problem


@pytest.mark.parametrize(
    ("shown", "printed", "equal"),
    [
        ("mIoU 61.30\n58.99", "mIoU 61.31 58.99", True),
        ("mIoU 61.30", "mIoU 63.30", False),
        ("a b", "a c", False),
        ("a", "a b", False),
        ("a b", "a", False),
        ("a\n...", "a b", True),
    ],
)
def test_printed_words_are_compared(shown: str, printed: str, equal: bool) -> None:
    assert (difference(shown, printed) == "") is equal


def test_reader_stops_at_a_mistake(tmp_path: Path) -> None:
    path = tmp_path / "page.md"
    path.write_text(
        "# T\n\n```bash\nexport A=1\nmkdir sub; cd sub\n```\n\n"
        "```bash\ntest $A = 1; ls ../sub\n```\n\n"
        "```bash\nls nothing\n```\n\n```python\nb = 2\n```\n\n```python\nprint(b)\n```\n\n"
        "```text\n3\n```\n"
    )
    page = Page.read(path)
    reader = Reader(page, tmp_path / "reader", tmp_path, {})
    found = [reader.follow(block) for block in page.blocks]
    assert [bool(each) for each in found] == [False, False, True, False, True, False]
