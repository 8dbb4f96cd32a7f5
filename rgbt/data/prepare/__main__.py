"""Command that turns an official download into the files that are read, then checks them.

    python -m rgbt.data.prepare dataset=mfnet    source=ir_seg_dataset.zip      out=/data/MFNet
    python -m rgbt.data.prepare dataset=pst900   source=PST900_RGBT_Dataset.zip out=/data/PST900
    python -m rgbt.data.prepare dataset=kp       source=KAIST labels=labels     out=/data/KP
    python -m rgbt.data.prepare dataset=freiburg source=downloads               out=/data/Freiburg

Progress goes to stderr, the report of `rgbt.data.check` to stdout. The download is only read.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, NamedTuple

from rich.console import Console
from rich.progress import Progress

from rgbt.checks import InputError
from rgbt.config.options import Help
from rgbt.config.plain_command import PlainCommand
from rgbt.data.check import print_report
from rgbt.data.dataset import LabelledDataset
from rgbt.data.freiburg import Freiburg
from rgbt.data.kp import KP
from rgbt.data.mfnet import MFNet
from rgbt.data.prepare.copying import Item, check_out, claimed, write_all
from rgbt.data.prepare.kp import plan_kp
from rgbt.data.prepare.plans import Given, plan_freiburg, plan_mfnet, plan_pst900
from rgbt.data.prepare.source import Source
from rgbt.data.pst900 import PST900
from rgbt.data.report.dataset import check_dataset, num_listed

OPTIONAL = ("labels", "lists")


@dataclass(frozen=True)
class Options:
    """What to prepare, and where."""

    dataset: Annotated[Literal["mfnet", "pst900", "kp", "freiburg"], Help("its name")]
    source: Annotated[
        Path,
        Help(
            "the download: a zip archive, or the folder into which it was unpacked; for kp the "
            "folder of KAIST, for freiburg the folder that holds train.zip and test.zip"
        ),
    ]
    out: Annotated[Path, Help("a new folder outside of it")]
    labels: Annotated[
        Path | None,
        Help("kp: folder or archive of the labels of MS-UDA, where the source has none"),
    ] = None
    lists: Annotated[
        Path | None,
        Help("mfnet and kp: folder of lists to use instead of the download's, or of set numbers"),
    ] = None

    @property
    def paths(self) -> dict[str, Path]:
        """The paths that are read, by option."""
        given = {key: getattr(self, key) for key in ("source", *OPTIONAL)}
        return {key: path for key, path in given.items() if path is not None}


class Kind(NamedTuple):
    """What is known about preparing a data set.

    Attributes:
        plan: what to write of a download.
        reads: the data set in a prepared folder.
        archives: names of archives that are opened where a folder holds them.
        takes: which of `OPTIONAL` have a meaning.
    """

    plan: Callable[[Given], list[Item]]
    reads: Callable[[str], LabelledDataset]
    archives: str
    takes: tuple[str, ...] = ()


KINDS = {
    "mfnet": Kind(plan_mfnet, MFNet, r"ir_seg_dataset.*\.zip", ("lists",)),
    "pst900": Kind(plan_pst900, PST900, r"pst900.*\.zip"),
    "kp": Kind(plan_kp, KP, r"(set\d\d|.*labels.*)\.zip", ("labels", "lists")),
    "freiburg": Kind(plan_freiburg, Freiburg, r"(train|test)\.zip"),
}


def main(options: Options, overrides: list[str]) -> int:
    """Copy what is read of a download into a new folder, and check it. Called again, it resumes."""
    del overrides  # none is heeded
    name, out, paths = options.dataset, options.out, options.paths
    kind = KINDS[name]
    for key in paths:
        if key in OPTIONAL and key not in kind.takes:
            raise InputError(f"{key} has no meaning for dataset={name}; leave it out.")
    plan = {"dataset": name, **{key: str(path.resolve()) for key, path in paths.items()}}
    check_out(out, tuple(paths.values()), plan)
    with ExitStack() as opened:
        sources = {
            key: opened.enter_context(Source(path, key, kind.archives))
            for key, path in paths.items()
        }
        items = kind.plan(Given(**sources))
        opened.enter_context(claimed(out, plan))
        _copy(items, out)
    return _check(kind.reads(str(out)), f"dataset={name} dataset.root={out}")


def _copy(items: list[Item], out: Path) -> None:
    with Progress(console=Console(stderr=True)) as progress:
        task = progress.add_task("copying", total=sum(item.size for item in items))
        write_all(items, out, lambda size: progress.advance(task, size))


def _check(dataset: LabelledDataset, words: str) -> int:
    with Progress(console=Console(stderr=True)) as progress:
        task = progress.add_task("reading", total=num_listed(dataset))
        report = check_dataset(
            dataset, num_threads=os.cpu_count() or 1, advance=lambda: progress.advance(task)
        )
    print_report(dataset, report)
    sys.stdout.write(f"prepared: {words}\n")
    return 1 if report.problems else 0


entry = PlainCommand(Options, main, heeds=())

if __name__ == "__main__":
    entry()
