"""The command ``rgbt prepare``, which copies the files of an official download and checks them.

    rgbt prepare dataset=mfnet    source=ir_seg_dataset.zip      out=/data/MFNet
    rgbt prepare dataset=pst900   source=PST900_RGBT_Dataset.zip out=/data/PST900
    rgbt prepare dataset=kp       source=KAIST labels=labels     out=/data/KP
    rgbt prepare dataset=freiburg source=downloads               out=/data/Freiburg

Progress goes to stderr, the report of `rgbt.data.check` to stdout. The download is only read.
"""

from __future__ import annotations

import sys
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from rich.console import Console
from rich.progress import Progress

from rgbt.checks import InputError, check_choice
from rgbt.config.options import Help
from rgbt.config.plain_command import PlainCommand
from rgbt.data.check import check_and_print
from rgbt.data.prepare.copying import check_out, copy
from rgbt.data.prepare.download import SourceFiles
from rgbt.data.prepare.plans import PREPARATIONS, Download

OPTIONAL = ("labels", "lists")


@dataclass(frozen=True)
class Options:
    """Options of the command."""

    dataset: Annotated[str, Help("data set: mfnet, pst900, kp or freiburg")]
    source: Annotated[
        Path,
        Help(
            "download: a zip archive, or the folder into which it was unpacked. For kp the folder "
            "of KAIST; for freiburg the folder with train.zip and test.zip"
        ),
    ]
    out: Annotated[Path, Help("new folder outside the download")]
    labels: Annotated[
        Path | None,
        Help("kp: folder or archive with the labels of MS-UDA, if the source has none"),
    ] = None
    lists: Annotated[
        Path | None,
        Help(
            "mfnet and kp: folder of split lists to use instead of those of the download or the "
            "set numbers"
        ),
    ] = None

    @property
    def paths(self) -> dict[str, Path]:
        """The paths that are read, by option."""
        given = {key: getattr(self, key) for key in ("source", *OPTIONAL)}
        return {key: path for key, path in given.items() if path is not None}


def main(options: Options, overrides: list[str]) -> int:
    """Copy the required files of a download to a new folder and check them."""
    del overrides  # none has an effect
    name, out, paths = options.dataset, options.out, options.paths
    check_choice("dataset", name, PREPARATIONS)
    reader, plan, archives, accepted = PREPARATIONS[name]
    for key in paths:
        if key in OPTIONAL and key not in accepted:
            raise InputError(f"{key} has no effect for dataset={name}; omit it.")
    check_out(out, tuple(paths.values()))
    with ExitStack() as opened:
        sources = {
            key: opened.enter_context(SourceFiles(path, key, archives))
            for key, path in paths.items()
        }
        items = plan(Download(**sources))
        origin = {"dataset": name, **{key: str(path.resolve()) for key, path in paths.items()}}
        with Progress(console=Console(stderr=True)) as progress:
            task = progress.add_task("copying", total=sum(item.size for item in items))
            copy(items, out, origin, lambda size: progress.advance(task, size))
    code = check_and_print(reader(str(out)))
    sys.stdout.write(f"prepared: dataset={name} dataset.root={out}\n")
    return code


entry = PlainCommand(Options, main, heeds=())

if __name__ == "__main__":
    entry()
