"""Command that copies the needed files of an official download, then checks them.

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

from hydra.utils import get_object
from omegaconf import OmegaConf
from rich.console import Console
from rich.progress import Progress

from rgbt.checks import InputError, check_choice
from rgbt.config.compose import conf_dir
from rgbt.config.options import Help
from rgbt.config.plain_command import PlainCommand
from rgbt.data.check import check_and_print
from rgbt.data.prepare.copying import Item, check_out, claimed, write_all
from rgbt.data.prepare.download import SourceFiles
from rgbt.data.prepare.plans import Download, Preparable

OPTIONAL = ("labels", "lists")


def preparable() -> dict[str, Preparable]:
    """File of conf/dataset -> class of the data set, of those that declare a preparation."""
    nodes = {path.stem: OmegaConf.load(path) for path in sorted(conf_dir().glob("dataset/*.yaml"))}
    classes = {
        name: get_object(node._target_) for name, node in nodes.items() if "_target_" in node
    }
    return {name: each for name, each in classes.items() if isinstance(each, Preparable)}


@dataclass(frozen=True)
class Options:
    """What to prepare, and where."""

    dataset: Annotated[str, Help("mfnet, pst900, kp or freiburg")]
    source: Annotated[
        Path,
        Help(
            "the download: a zip archive, or the folder into which it was unpacked; for kp the "
            "folder of KAIST, for freiburg the folder with train.zip and test.zip"
        ),
    ]
    out: Annotated[Path, Help("a new folder outside the download")]
    labels: Annotated[
        Path | None,
        Help("kp: folder or archive of the labels of MS-UDA, if the source has none"),
    ] = None
    lists: Annotated[
        Path | None,
        Help("mfnet and kp: folder of lists, used instead of those of the download or set numbers"),
    ] = None

    @property
    def paths(self) -> dict[str, Path]:
        """The paths that are read, by option."""
        given = {key: getattr(self, key) for key in ("source", *OPTIONAL)}
        return {key: path for key, path in given.items() if path is not None}


def main(options: Options, overrides: list[str]) -> int:
    """Copy the needed files of a download to a new folder and check them; it can be resumed."""
    del overrides  # none has an effect
    name, out, paths = options.dataset, options.out, options.paths
    classes = preparable()
    check_choice("dataset", name, classes)
    preparation = classes[name].preparation
    for key in paths:
        if key in OPTIONAL and key not in preparation.options:
            raise InputError(f"{key} has no effect for dataset={name}; omit it.")
    plan = {"dataset": name, **{key: str(path.resolve()) for key, path in paths.items()}}
    check_out(out, tuple(paths.values()), plan)
    with ExitStack() as opened:
        sources = {
            key: opened.enter_context(SourceFiles(path, key, preparation.archives))
            for key, path in paths.items()
        }
        items = preparation.plan(Download(**sources))
        opened.enter_context(claimed(out, plan))
        _copy(items, out)
    code = check_and_print(classes[name](str(out)))
    sys.stdout.write(f"prepared: dataset={name} dataset.root={out}\n")
    return code


def _copy(items: list[Item], out: Path) -> None:
    with Progress(console=Console(stderr=True)) as progress:
        task = progress.add_task("copying", total=sum(item.size for item in items))
        write_all(items, out, lambda size: progress.advance(task, size))


entry = PlainCommand(Options, main, heeds=())

if __name__ == "__main__":
    entry()
