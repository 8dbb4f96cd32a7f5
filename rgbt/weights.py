"""Inspect files of weights, and export the weights of a run.

Nothing in a file is executed. Exit code 1: the file does not fit the network.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from omegaconf import DictConfig, OmegaConf

from rgbt.checkpoints.layout import Facts
from rgbt.checkpoints.read import Contents
from rgbt.checks import InputError
from rgbt.config.common_options import Checkpoint, RunsDir, Trust
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
    trust: Trust = ""


def inspect(options: InspectOptions, overrides: list[str]) -> int:
    """Describe a file of weights and which parameters of a network it would set.

    Overrides choose the network: model=mask2former_tiny model.fresh=[sem_seg_head].
    """
    import torch

    from rgbt.checkpoints.load import plan_for
    from rgbt.checkpoints.read import read
    from rgbt.checkpoints.recognise import recognise
    from rgbt.checkpoints.report import PLAN_HEADER, facts_view, plan_rows
    from rgbt.checkpoints.starts import start_lines
    from rgbt.runs.run_spec import file_digest
    from rgbt.tables import TextTable
    from rgbt.terminal import path_lines, print_rich, rich_table

    contents = read(options.file)
    facts = recognise(contents)
    more = []
    if not contents.ours:
        digest = file_digest(options.file)
        more = start_lines(facts, options.file.name, digest, available("experiment"))
    print_rich(facts_view(contents, facts, more))
    found = _network(contents, facts, overrides, parse_trust(options.trust))
    if found is None:
        return 0
    node, name = found
    try:
        with torch.device("meta"):  # no memory for its weights, where it can be built so
            network = build(node)
    except (NotImplementedError, RuntimeError):
        network = build(node)
    _, plan, remarks = plan_for(network, contents, tuple(node.get("fresh") or ()))
    print_rich(rich_table(TextTable(f"into {name}", PLAN_HEADER, plan_rows(plan))))
    if remarks:
        print_rich(path_lines([("remark", remark) for remark in remarks]))
    return 0 if plan.fits else 1


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


@dataclass(frozen=True)
class ExportOptions:
    """Options of `export`."""

    run: Annotated[str, Help("run folder, config key or MLflow run id")]
    format: Annotated[
        str,
        Help("safetensors (names of rgbt), released or released_temporal (as the authors load it)"),
    ]
    out: Annotated[Path, Help("new file; an existing file is never overwritten")]
    checkpoint: Checkpoint = "best"
    runs_dir: RunsDir = Path("runs")


def export(options: ExportOptions, overrides: list[str]) -> int:
    """Write the weights of a run."""
    from rgbt.assembly.session import differences
    from rgbt.checkpoints.layout import family_named
    from rgbt.checkpoints.read import read
    from rgbt.checkpoints.release import CONVENTIONS, save
    from rgbt.runs.folder import find_run
    from rgbt.terminal import info, plain_text, print_rich

    del overrides  # none is heeded
    folder = find_run(options.run, options.runs_dir)
    model = read_settings(folder / "config.yaml").get("model", {})
    if not isinstance(model.get("_target_"), str):
        raise InputError(f"{folder}/config.yaml: 'model' must be a mapping with `_target_`.")
    contents = read(folder / f"{options.checkpoint}.pt")
    family = family_named(model["_target_"])
    note = {
        "network": model["_target_"],
        "family": family,
        "inputs": json.dumps(model.get("inputs")),
        "settings": json.dumps({k: v for k, v in model.items() if k not in NOT_SETTINGS}),
        "run": folder.name,
        "checkpoint": options.checkpoint,
        "step": str(contents.settings.get("step", 0)),
    }
    remark = save(options.out, options.format, family, contents.tensors, note)
    others = differences(model, CONVENTIONS.get((options.format, family), ()))
    if others:
        info(f"scores will differ in the authors' code, which uses {' '.join(others)}.")
    if remark:
        info(f"{remark}.")
    print_rich(plain_text(str(options.out)))
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
