"""Print messages and progress on stderr, and tables and paths on stdout.

Control characters of names are never printed.
"""

from __future__ import annotations

import os
import shlex
import shutil
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from datetime import timedelta
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from rich import box
from rich.cells import cell_len
from rich.console import Console, Group, JustifyMethod, RenderableType
from rich.table import Table
from rich.text import Text

from rgbt.checks import without_controls
from rgbt.tables import LABEL, ResultTables, TextTable, result_grids

if TYPE_CHECKING:  # --help does not wait for it
    from rich.progress import Progress

Item = TypeVar("Item")

# Progress goes to stderr; stdout is for results.
CONSOLE = Console(stderr=True)

# Seconds between two lines of progress in a log.
PAUSE_S = 10.0

# Number of columns where stdout is no terminal: a file takes lines of any length.
WIDTH = 10_000

# Smallest width of a broken label; a key takes 12 columns and stays whole.
SHORTEST = 16


def info(sentence: str) -> None:
    """Print a message to stderr."""
    sys.stderr.write(f"rgbt: {without_controls(sentence)}\n")


def warn(sentence: str) -> None:
    """Print a warning to stderr."""
    info(f"warning: {sentence}")


def progress() -> Progress:
    """Make a progress display with columns for count, time left and a note (task field `note`)."""
    from rich import progress as columns

    # Drawing ten times a second takes 2 % of a core. In a file it would be one long line.
    return columns.Progress(
        columns.SpinnerColumn(),
        columns.TextColumn("{task.description:<10}", markup=False),
        columns.BarColumn(bar_width=30),
        columns.MofNCompleteColumn(),
        columns.TimeElapsedColumn(),
        columns.TextColumn("left"),
        columns.TimeRemainingColumn(),
        columns.TextColumn("{task.fields[note]}", markup=False),
        console=CONSOLE,
        refresh_per_second=4,
        disable=not CONSOLE.is_terminal,
    )


@contextmanager
def counting(what: str, total: int) -> Iterator[Callable[[], None]]:
    """Show a bar, or a line every `PAUSE_S` s in a log; yields a function to call `total` times."""
    began = written = time.monotonic()
    done = 0
    with progress() as bar:
        task = bar.add_task(what, total=total, note="")

        def advance() -> None:
            nonlocal done, written
            done += 1
            bar.advance(task)
            now = time.monotonic()
            if bar.disable and now - written >= PAUSE_S:
                written = now
                left = timedelta(seconds=round((now - began) * (total - done) / done))
                # No message (`info`): the last one is why a job of a sweep failed.
                sys.stderr.write(without_controls(f"{what} {done} of {total}, {left} left\n"))

        yield advance


def tracked(items: Iterable[Item], what: str, total: int) -> Iterator[Item]:
    """Yield `items`, and show how many of them are done (`counting`)."""
    with counting(what, total) as advance:
        for item in items:
            yield item
            advance()


def print_rich(renderable: RenderableType, *, width: int = WIDTH) -> None:
    """Print results to stdout; no line of text and no number is cut.

    `width` is that of a file. With another than `WIDTH`, lines of text are broken there too.
    """
    console = Console(width=None if sys.stdout.isatty() else width)
    console.print(renderable, soft_wrap=width == WIDTH)


def plain_text(text: str, style: str = "") -> Text:
    """Return text as it is: no markup, no control characters."""
    return Text(without_controls(text), style)


def path_lines(paths: Sequence[tuple[str, str]]) -> Text:
    """List paths, commands and addresses, one "name  path" pair per line."""
    width = max(len(name) for name, _ in paths)
    return plain_text("\n".join(f"{name:<{width}}  {path}" for name, path in paths))


def shell_command(*words: str) -> str:
    """Write a command of rgbt so that it can be pasted into the shell that started this process.

    That is ``rgbt ...`` where the shell finds this environment's own one, else its path from the
    working folder (``.venv/bin/rgbt ...``), or Python itself where rgbt was not installed.
    """
    script = Path(sys.executable).parent / "rgbt"
    found = shutil.which("rgbt")
    if found is not None and script.exists() and Path(found).samefile(script):
        start = ["rgbt"]
    else:
        python = _from_here(Path(sys.executable))
        start = [_from_here(script)] if script.exists() else [python, "-m", "rgbt"]
    return shlex.join([*start, *words])


def _from_here(path: Path) -> str:
    """Write a path relative to the working folder if that is shorter and leads nowhere else."""
    here = Path(os.environ.get("PWD") or Path.cwd())
    return str(path.relative_to(here)) if path.is_relative_to(here) else str(path)


def result_view(
    tables: ResultTables, folder: Path, links: Sequence[tuple[str, str]]
) -> RenderableType:
    """Show tables and paths of a finished run; `links` as its tracker answered."""
    paths = path_lines([("run folder", str(folder)), *links])
    return Group(*map(rich_table, result_grids(tables)), paths)


def rich_table(grid: TextTable) -> RenderableType:
    """Lay out a grid: labels left and broken where they do not fit, numbers right and whole."""
    table = Table(box=box.SIMPLE_HEAD)
    for index, (name, *cells) in enumerate(zip(grid.header, *grid.rows, strict=True)):
        is_label = index == 0 or any(map(LABEL.match, cells))
        longest = max(map(cell_len, (*cells, *name.split())), default=0)
        least = min(longest, SHORTEST) if is_label else longest
        side: JustifyMethod = "left" if is_label else "right"
        table.add_column(plain_text(name), justify=side, overflow="fold", min_width=least)
    for row in grid.rows:
        table.add_row(*map(plain_text, row))
    # The table's own title would be broken at the width of the table.
    title = [plain_text(grid.title, "bold")] if grid.title else []
    return Group(*title, table, *(plain_text(f" {note}", "dim") for note in grid.notes))
