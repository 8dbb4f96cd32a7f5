"""The command ``rgbt check``, which reads a whole data set and reports its problems.

    rgbt check dataset=mfnet dataset.root=...
    rgbt check dataset=kp dataset.root=...

Progress goes to stderr, the report to stdout. Exit code 0: no problem, 1: problems, 2: wrong input.
"""

from __future__ import annotations

import os

from omegaconf import DictConfig
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from rgbt.checks import InputError
from rgbt.config.command import command
from rgbt.config.component import build
from rgbt.data.file_dataset import FileDataset
from rgbt.data.report import DatasetReport, SplitReport, check_dataset, read_lists

WIDTH_WITHOUT_TERMINAL = 120


@command()
def main(config: DictConfig, _overrides: list[str]) -> int:
    """Check ``config.dataset``; returns 1 if there are problems."""
    dataset = build(config.dataset)
    if not isinstance(dataset, FileDataset):
        raise InputError(
            f"dataset: {type(dataset).__name__} cannot be checked, because it is not a "
            "rgbt.data.file_dataset.FileDataset. Choose dataset=mfnet, freiburg, synth or another "
            "file of conf/dataset, or derive your class from FileDataset."
        )
    return check_and_print(dataset)


def check_and_print(dataset: FileDataset) -> int:
    """Read a data set and print the report; returns 1 if there are problems."""
    with Progress(console=Console(stderr=True)) as progress:
        lists, _, _ = read_lists(dataset)
        task = progress.add_task("reading", total=len(set().union(*lists.values())))
        report = check_dataset(
            dataset,
            num_threads=os.cpu_count() or 1,
            advance=lambda: progress.advance(task),
        )
    print_report(dataset, report)
    return 1 if report.problems else 0


def print_report(dataset: FileDataset, report: DatasetReport) -> None:
    """Write the report to stdout: two tables, then one line per note and per problem."""
    console = Console()
    if not console.is_terminal:
        console = Console(width=WIDTH_WITHOUT_TERMINAL)
    title = f"{dataset.name} ({dataset.title}): {dataset.root}"
    console.print(title, soft_wrap=True, markup=False)
    if report.splits:
        console.print(split_table(report.splits))
        labelled = (split for split in report.splits if split.pixels.any())
        own = tuple(split for split in labelled if not dataset.repeats(split.split))
        console.print(class_table(own, (*dataset.classes, "ignored")))
    for kind, lines in (("note", report.notes), ("problem", report.problems)):
        for line in lines:
            console.print(f"{kind}: {line}", soft_wrap=True, markup=False, highlight=False)
    console.print(f"{len(report.problems)} problem(s), {len(report.notes)} note(s).")


def split_table(splits: tuple[SplitReport, ...]) -> Table:
    """Numbers of names and sizes, one row per split."""
    table = Table("split", "names", "read", "day", "night", "mirrored", "unlabelled", "sizes")
    for split in splits:
        numbers = (split.num_names, split.num_read, split.num_day, split.num_night)
        sizes = ", ".join(f"{h}x{w} ({count})" for (h, w), count in sorted(split.sizes.items()))
        others = (split.num_flipped, split.num_unlabelled)
        table.add_row(split.split, *map(str, (*numbers, *others)), sizes)
    return table


def class_table(splits: tuple[SplitReport, ...], names: tuple[str, ...]) -> Table:
    """Percent of pixels and number of images, one row per class."""
    table = Table("class", *(f"{split.split} pixels (images)" for split in splits))
    for index, name in enumerate(names):
        cells = [_cell(split, index) for split in splits]
        if name != "ignored" or any(split.images[index] for split in splits):
            table.add_row(name, *cells)
    return table


def _cell(split: SplitReport, index: int) -> str:
    share = split.pixels[index] / max(1, split.pixels.sum())
    return f"{share:8.3%} ({split.images[index]})"


if __name__ == "__main__":
    main()
