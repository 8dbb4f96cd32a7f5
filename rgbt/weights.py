"""Inspect files of weights, and export the weights of a run.

Nothing in a file is executed. Exit code 1: the file does not fit the network.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from omegaconf import OmegaConf

from rgbt.checks import InputError, one_line
from rgbt.config.common_options import Checkpoint, RunsDir, Trust
from rgbt.config.component import build
from rgbt.config.compose import available, compose
from rgbt.config.options import Help
from rgbt.config.plain_command import CommandGroup, PlainCommand
from rgbt.config.stored_config import check_targets, parse_trust, read_settings
from rgbt.terminal import plain_text

NOT_SETTINGS = ("_target_", "weights", "fresh", "inputs")


@dataclass(frozen=True)
class InspectOptions:
    """Options of `inspect`."""

    file: Annotated[Path, Help("file of weights, from rgbt or a released one")]
    trust: Trust = ""


def inspect(options: InspectOptions, overrides: list[str]) -> int:
    """Describe a file of weights, and say what it sets in a network.

    Overrides choose the network: model=mask2former_tiny model.fresh=[sem_seg_head]. Without any it
    is the network of the run that the file is in.
    """
    import torch

    from rgbt.checkpoints.files import read
    from rgbt.checkpoints.load import plan_for, recognised
    from rgbt.files.plain_files import file_digest
    from rgbt.runs.starts import start_lines
    from rgbt.terminal import path_lines, print_rich

    contents, path = read(options.file), options.file
    kinds = sorted(
        {str(tensor.dtype).removeprefix("torch.") for tensor in contents.tensors.values()}
    )
    digest = file_digest(path)
    lines = [
        ("file", f"{path} ({path.stat().st_size / 1e6:.1f} MB)"),
        ("what", recognised(contents) or "unknown"),
        ("tensors", f"{len(contents.tensors)} ({', '.join(kinds)})"),
        ("names", ", ".join([*map(one_line, list(contents.tensors)[:4]), "..."])),
        *((f"note {one_line(key)}", one_line(text)) for key, text in contents.note.items()),
        ("sha256", digest),
        *start_lines(path.name, digest, available("experiment")),
    ]
    print_rich(path_lines(lines))
    beside = path.parent / "config.yaml"
    if overrides:
        node = compose(overrides).model
    elif contents.ours and beside.is_file():
        model = read_settings(beside).get("model")
        check_targets({"model": model}, parse_trust(options.trust), str(beside), group="model")
        node = OmegaConf.create({"model": model}).model
    else:
        return 0
    try:
        with torch.device("meta"):  # no memory for its weights, where it can be built so
            network = build(node)
    except (NotImplementedError, RuntimeError):
        network = build(node)
    plan = plan_for(network, contents, tuple(node.get("fresh") or ()))
    print_rich(plain_text(plan.sentence()))
    if plan.convention:
        print_rich(path_lines([("trained with", " ".join(plan.convention))]))
    return int(bool(plan.problems))


@dataclass(frozen=True)
class ExportOptions:
    """Options of `export`."""

    run: Annotated[str, Help("run folder, config key or MLflow run id")]
    format: Annotated[str, Help("safetensors (names of rgbt) or released (as the authors load it)")]
    out: Annotated[Path, Help("new file; an existing file is never overwritten")]
    checkpoint: Checkpoint = "best"
    runs_dir: RunsDir = Path("runs")


def export(options: ExportOptions, overrides: list[str]) -> int:
    """Write the weights of a run."""
    from rgbt.assembly.session import differences
    from rgbt.checkpoints.files import read
    from rgbt.checkpoints.kinds import family_named
    from rgbt.checkpoints.release import convention_of, save
    from rgbt.runs.folder import find_run
    from rgbt.terminal import info, print_rich

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
    save(options.out, options.format, family, contents.tensors, note)
    others = differences(model, convention_of(options.format, family))
    if others:
        info(f"scores will differ in the authors' code, which uses {' '.join(others)}.")
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
