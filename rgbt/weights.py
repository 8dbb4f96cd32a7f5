"""Inspect files of weights, and export the weights of a run.

    rgbt weights inspect FILE [model=...]
    rgbt weights export run=runs/KEY format=safetensors out=FILE

Nothing in a file is executed. Exit code 0: done, 1: the file does not fit the network, 2: wrong
input.
"""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from omegaconf import DictConfig, OmegaConf

from rgbt.checkpoints.layout import Facts
from rgbt.checkpoints.read import Contents
from rgbt.checks import InputError
from rgbt.config.common_options import Checkpoint, RunsDir
from rgbt.config.component import build
from rgbt.config.compose import available, compose
from rgbt.config.options import Help
from rgbt.config.plain_command import CommandGroup, PlainCommand
from rgbt.config.stored_config import check_targets, parse_trust, read_settings

NOT_SETTINGS = ("_target_", "weights", "fresh", "inputs")


@dataclass(frozen=True)
class InspectOptions:
    """Options of `inspect`."""

    file: Annotated[Path, Help("file of weights, from rgbt or a released one")]
    trust: Annotated[
        str,
        Help(
            "your own modules that define the network of the run: trust=my_lab; their code is "
            "executed"
        ),
    ] = ""


def inspect(options: InspectOptions, overrides: list[str]) -> int:
    """Describe a file of weights and which parameters of a network it would set.

    Overrides choose the network: model=mask2former_tiny model.fresh=[sem_seg_head]. Without
    overrides it is the network that fits, or that of the run to which the file belongs.
    """
    from rich.text import Text

    from rgbt.checkpoints.load import plan_for
    from rgbt.checkpoints.read import read
    from rgbt.checkpoints.recognise import recognise
    from rgbt.checkpoints.report import PLAN_HEADER, facts_view, plan_rows
    from rgbt.tracking.tables import TextTable
    from rgbt.tracking.terminal import print_rich, rich_table

    contents = read(options.file)
    facts = recognise(contents)
    more = [] if contents.ours else _starts(options.file, facts)
    print_rich(facts_view(contents, facts, more))
    found = _network(contents, facts, overrides, parse_trust(options.trust))
    if found is None:
        return 0
    node, name = found
    _, plan, remarks = plan_for(_built(node), contents, tuple(node.get("fresh") or ()))
    print_rich(rich_table(TextTable(f"into {name}", PLAN_HEADER, plan_rows(plan))))
    print_rich(Text("".join(f"remark  {remark}\n" for remark in remarks), end=""))
    return 0 if plan.fits else 1


def _starts(file: Path, facts: Facts) -> list[tuple[str, str]]:
    """What `rgbt.checkpoints.starts` says about a file."""
    from rgbt.checkpoints.starts import start_lines
    from rgbt.spec.run_key import file_digest

    return start_lines(facts, file.name, file_digest(file), available("experiment"))


def _network(
    contents: Contents, facts: Facts, overrides: list[str], trust: tuple[str, ...]
) -> tuple[DictConfig, str] | None:
    """The network of the file and its name; None where nothing says which."""
    beside = contents.path.parent / "config.yaml"
    if not overrides and contents.ours and beside.is_file():
        model = read_settings(beside).get("model")
        if model is None:
            return None
        check_targets({"model": model}, trust, str(beside), group="model")
        return OmegaConf.create({"model": model}).model, str(beside)
    if not any(word.startswith("model=") for word in overrides):
        known = {f"model={name}" for name in available("model")}
        usual = next((each for each in facts.fits if each[0] in known), ())
        if not usual:
            return None
        overrides = [*usual, *overrides]
    if facts.classes and not any(word.startswith("model.num_classes=") for word in overrides):
        overrides = [*overrides, f"model.num_classes={facts.classes}"]
    return compose(overrides).model, " ".join(overrides)


def _built(node: DictConfig) -> Any:
    """The network without memory for its weights, where it can be built so."""
    import torch

    try:
        with torch.device("meta"):
            return build(node)
    except (NotImplementedError, RuntimeError):
        return build(node)


@dataclass(frozen=True)
class ExportOptions:
    """Options of `export`."""

    run: Annotated[str, Help("run folder, config key or MLflow run id")]
    format: Annotated[
        str,
        Help(
            "safetensors (names of this project), released (as the authors' code loads them), "
            "released_temporal (CMX as the temporal paper's code loads it)"
        ),
    ]
    out: Annotated[Path, Help("new file; an existing file is never overwritten")]
    checkpoint: Checkpoint = "best"
    runs_dir: RunsDir = Path("runs")


def export(options: ExportOptions, overrides: list[str]) -> int:
    """Write the weights of a run."""
    from rgbt.build.initial_weights import differences
    from rgbt.checkpoints.layout import family_named
    from rgbt.checkpoints.read import read
    from rgbt.checkpoints.release import CONVENTIONS, save
    from rgbt.tracking.run_folder import find_run
    from rgbt.tracking.terminal import info

    del overrides  # none is heeded
    folder = find_run(options.run, options.runs_dir)
    file = folder / "config.yaml"
    model = read_settings(file).get("model", {})
    if not isinstance(model.get("_target_"), str):
        raise InputError(f"{file}: 'model' must be a mapping with `_target_`.")
    contents = read(folder / f"{options.checkpoint}.pt")
    family = family_named(model["_target_"])
    settings = {key: value for key, value in model.items() if key not in NOT_SETTINGS}
    note = {
        "network": model["_target_"],
        "family": family,
        "inputs": json.dumps(model.get("inputs")),
        "settings": json.dumps(settings),
        "run": folder.name,
        "checkpoint": options.checkpoint,
        "step": str(contents.settings.get("step", 0)),
    }
    remark = save(options.out, options.format, family, contents.tensors, note)
    others = differences(model, CONVENTIONS.get((options.format, family), ()))
    if others:
        info(
            f"the authors' code uses {' '.join(others)}, but this run used other settings, so its "
            "scores will differ in the authors' code."
        )
    if remark:
        info(f"{remark}.")
    sys.stdout.write(f"{options.out}\n")
    return 0


entry = CommandGroup(
    __doc__,
    {
        "inspect": PlainCommand(InspectOptions, inspect, name="rgbt weights inspect", first="file"),
        "export": PlainCommand(ExportOptions, export, heeds=(), name="rgbt weights export"),
    },
)

if __name__ == "__main__":
    entry()
