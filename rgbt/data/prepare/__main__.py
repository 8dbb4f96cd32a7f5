"""Command that copies the needed files of an official download, then checks them.

    python -m rgbt.data.prepare dataset=mfnet    source=ir_seg_dataset.zip      out=/data/MFNet
    python -m rgbt.data.prepare dataset=pst900   source=PST900_RGBT_Dataset.zip out=/data/PST900
    python -m rgbt.data.prepare dataset=kp       source=KAIST labels=labels     out=/data/KP
    python -m rgbt.data.prepare dataset=freiburg source=downloads               out=/data/Freiburg

Progress goes to stderr, the report of `rgbt.data.check` to stdout. The download is only read.
"""

from __future__ import annotations

import sys
from contextlib import ExitStack
from pathlib import Path

from hydra.utils import get_object
from omegaconf import OmegaConf
from rich.console import Console
from rich.progress import Progress

from rgbt.checks import InputError, check_choice, nearest
from rgbt.config.compose import conf_dir
from rgbt.data.check import check_and_print
from rgbt.data.prepare.copying import Item, check_out, claimed, write_all
from rgbt.data.prepare.download import SourceFiles
from rgbt.data.prepare.plans import Download, Preparable

OWN = {"dataset": None, "source": None, "out": None, "labels": "", "lists": ""}
OPTIONAL = ("labels", "lists")


def preparable() -> dict[str, Preparable]:
    """File of conf/dataset -> class of the data set, of those that declare a preparation."""
    nodes = {path.stem: OmegaConf.load(path) for path in sorted(conf_dir().glob("dataset/*.yaml"))}
    classes = {
        name: get_object(node._target_) for name, node in nodes.items() if "_target_" in node
    }
    return {name: each for name, each in classes.items() if isinstance(each, Preparable)}


def main(arguments: dict[str, str], others: list[str]) -> int:
    """Copy the needed files of a download to a new folder and check them; it can be resumed.

    dataset   mfnet, pst900, kp or freiburg
    source    the download: a zip archive, or the folder into which it was unpacked; for kp the
              folder of KAIST, for freiburg the folder with train.zip and test.zip
    out       a new folder outside the download
    labels    kp: folder or archive of the labels of MS-UDA, if the source has none
    lists     mfnet and kp: folder of lists, used instead of those of the download or set numbers
    """
    if others:
        raise InputError(f"'{others[0]}' is no argument; {nearest(others[0], OWN)}.")
    name, out = arguments["dataset"], Path(arguments["out"])
    classes = preparable()
    check_choice("dataset", name, classes)
    preparation = classes[name].preparation
    given = {key: arguments[key] for key in ("source", *OPTIONAL) if arguments[key]}
    for key in given:
        if key in OPTIONAL and key not in preparation.options:
            raise InputError(f"{key} has no effect for dataset={name}; omit it.")
    paths = {key: Path(path) for key, path in given.items()}
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


if __name__ == "__main__":
    from rgbt.config.command import plain_command

    plain_command(OWN, main)()
