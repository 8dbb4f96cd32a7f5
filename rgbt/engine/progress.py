"""The progress bar of a command: what was done, speed and remaining time in one line."""

from __future__ import annotations

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    SpinnerColumn,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

# Progress goes to stderr; stdout is for results.
CONSOLE = Console(stderr=True)


def progress() -> Progress:
    """A progress display with columns for count, time left and a note (task field `note`)."""
    # Drawing ten times a second takes 2 % of a core. In a file only the last state is written.
    return Progress(
        SpinnerColumn(),
        TextColumn("{task.description:<10}", markup=False),
        BarColumn(bar_width=30),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
        TextColumn("{task.fields[note]}", markup=False),
        console=CONSOLE,
        refresh_per_second=4,
        auto_refresh=CONSOLE.is_terminal,
    )
