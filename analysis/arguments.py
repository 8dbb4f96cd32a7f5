"""Options that several commands of the analysis have in common, and the files that they write."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from annotated_types import Interval

from rgbt.checks import InputError
from rgbt.config.command import built
from rgbt.config.options import Help
from rgbt.files.atomic import write_atomic
from rgbt.tables import csv_text
from rgbt.terminal import path_lines, print_rich

if TYPE_CHECKING:
    from rgbt.dataset import LabelledDataset

MOST = 1_000_000
"""Largest value of a count that has no other limit."""

Resamples = Annotated[int, Interval(ge=100, le=MOST), Help("number of resamples of the images")]

Level = Annotated[float, Help("confidence level of the intervals, between 0 and 1")]

Blocks = Annotated[
    Literal["auto", "none", "sequence"] | Annotated[int, Interval(ge=1, le=MOST)],
    Help("images resampled together: auto, none, sequence, or a number of neighbouring frames"),
]

Archive = Annotated[Path, Help("folder of archived runs")]

Draws = Annotated[int, Interval(ge=0, le=2**31), Help("seed of the resampling")]


def check_out(out: Path | None) -> None:
    """Refuse a folder that cannot be written (InputError), before any work."""
    if out is None:
        return
    there = next(each for each in (out.absolute(), *out.absolute().parents) if each.exists())
    if not there.is_dir():
        raise InputError(f"out={out}: {there} is a file; choose a folder.")
    if not os.access(there, os.W_OK):
        raise InputError(f"out={out}: {there} is not writable; choose another folder.")


def write_tables(
    out: Path | None, name: str, markdown: str, rows: Iterable[Sequence[object]]
) -> None:
    """Write ``name.md`` and ``name.csv`` (header first) into the folder, if one is named."""
    if out is None:
        return
    out.mkdir(parents=True, exist_ok=True)
    known = [["" if cell != cell else cell for cell in row] for row in rows]
    write_atomic(out / f"{name}.md", markdown.encode())
    write_atomic(out / f"{name}.csv", csv_text(known).encode())
    print_rich(path_lines([("files", f"{out}/ ({name}.md, {name}.csv)")]))


def dataset_of(overrides: Sequence[str]) -> LabelledDataset:
    """The data set that overrides choose; InputError: none is chosen, or wrong settings."""
    # Without this the images of another data set would be scored against the embedded one.
    if not any(word.startswith("dataset=") for word in overrides):
        raise InputError(
            "no data set is named; set dataset=mfnet dataset.root=/data/MFNet, or dataset=synth "
            "for the embedded data set."
        )
    dataset: LabelledDataset = built("dataset", overrides)
    return dataset
