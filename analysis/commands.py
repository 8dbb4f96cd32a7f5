"""What the commands of the analysis have in common: options, tables and files."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar

from annotated_types import Interval

from rgbt.checks import InputError
from rgbt.config.options import Help
from rgbt.config.overrides import built
from rgbt.cores import usable_cores
from rgbt.files.atomic import check_writable, write_atomic
from rgbt.metrics.metric import MAX_REGIONS, Absent
from rgbt.tables import ABSENT, TextTable, csv_text, number
from rgbt.terminal import path_lines, print_rich

if TYPE_CHECKING:  # --help answers without waiting for pandas, SciPy and OpenCV
    import pandas as pd

    from analysis.uncertainty import Resampling
    from rgbt.dataset import LabelledDataset

T = TypeVar("T")

# Largest value of a count that has no other limit.
MOST = 1_000_000

Resamples = Annotated[int, Interval(ge=100, le=MOST), Help("number of resamples of the images")]

Level = Annotated[float, Help("confidence level of the intervals, between 0 and 1")]

Blocks = Annotated[
    Literal["auto", "none", "sequence"] | Annotated[int, Interval(ge=1, le=MOST)],
    Help("images resampled together: auto, none, sequence, or a number of neighbouring frames"),
]

Regions = Annotated[int, Interval(ge=1, le=MAX_REGIONS), Help("number of regions of equal area")]

Archive = Annotated[Path, Help("folder of archived runs")]


@dataclass(frozen=True, kw_only=True)
class DrawOptions:
    """How images are drawn anew for intervals."""

    level: Level = 0.95
    resamples: Resamples = 10_000
    blocks: Blocks = "auto"
    seed: Annotated[int, Interval(ge=0, le=MOST), Help("seed of the resampling")] = 0

    def settings(self, absent: Absent | None = None) -> Resampling:
        """Return the settings of the resampling; InputError: a level out of range."""
        from analysis.uncertainty import Resampling

        return Resampling(
            resamples=self.resamples,
            level=self.level,
            blocks=self.blocks,
            seed=self.seed,
            absent=absent,
        )


def check_out(out: Path | None) -> None:
    """Refuse a folder that cannot be written (InputError), before any work."""
    if out is not None:
        check_writable(f"out={out}", out)


def dataset_of(overrides: Sequence[str]) -> LabelledDataset:
    """Build the data set that overrides choose; InputError: none is chosen, or wrong settings."""
    # Without this the images of another data set would be scored against the embedded one.
    if not any(word.startswith("dataset=") for word in overrides):
        raise InputError(
            "no data set is named; set dataset=mfnet dataset.root=/data/MFNet, or dataset=synth "
            "for the embedded data set."
        )
    dataset: LabelledDataset = built("dataset", overrides)
    return dataset


def in_threads(work: Callable[..., T], *arguments: Iterable[Any]) -> Iterator[T]:
    """Yield ``map(work, *arguments)`` by a thread per core, for work outside of Python's lock.

    The first error cancels calls that have not started.
    """
    with ThreadPoolExecutor(usable_cores()) as pool:
        try:
            yield from pool.map(work, *arguments)
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise


def text_table(title: str, frame: pd.DataFrame, notes: Sequence[str] = ()) -> TextTable:
    """Show a frame as text: its index as labels, then its columns; numbers with two decimals."""
    labels = [str(name or "") for name in frame.index.names]
    rows = [tuple(map(_cell, row)) for row in frame.reset_index().itertuples(index=False)]
    return TextTable(title, (*labels, *map(str, frame.columns)), tuple(rows), tuple(notes))


def tidy_csv(frame: pd.DataFrame) -> str:
    """Write a frame without its index as CSV, eight digits; nothing where a value is missing."""
    rows = [[*frame.columns]]
    for row in frame.astype(object).where(frame.notna(), "").to_numpy():
        rows.append([f"{cell:.8g}" if isinstance(cell, float) else cell for cell in row])
    return csv_text(rows)


def write_files(out: Path | None, files: Mapping[str, str | pd.DataFrame]) -> None:
    """Write texts, and frames as CSV, under their names into the folder, if one is named."""
    if out is None:
        return
    out.mkdir(parents=True, exist_ok=True)
    for name, content in files.items():
        text = content if isinstance(content, str) else tidy_csv(content)
        write_atomic(out / name, text.encode())
    print_rich(path_lines([("files", f"{out}/ ({', '.join(files)})")]))


def _cell(value: Hashable) -> str:
    if isinstance(value, float):
        return number(value)
    return ABSENT if value is None else str(value)
