"""Look at files of weights, and write those of a run.

    python -m rgbt.weights inspect FILE [model=...]
    python -m rgbt.weights export run=runs/KEY format=safetensors out=FILE

Nothing in a file is executed. Exit code 0: done, 1: the file does not fit the network, 2: wrong
input.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from rgbt.checkpoints.layout import Facts
from rgbt.checkpoints.read import Contents
from rgbt.checks import InputError, check_choice, nearest
from rgbt.config.command import plain_command
from rgbt.config.component import build
from rgbt.config.compose import compose, conf_dir
from rgbt.config.stored_config import check_targets, parse_trust, read_settings

INSPECT = {"file": None, "trust": ""}
EXPORT = {"run": None, "format": None, "out": None, "checkpoint": "best", "runs_dir": "runs"}
CHECKPOINTS = ("best", "last")
NOT_SETTINGS = ("_target_", "weights", "fresh", "inputs")


def inspect(arguments: dict[str, str], overrides: list[str]) -> int:
    """Say what a file is and what it would do to a network.

    FILE      of weights, ours or a released one
    overrides the network, such as model=mask2former_tiny model.fresh=[sem_seg_head]; without, the
              one that fits, or the one of the run that the file belongs to
    trust     modules of yours with the network of that run: trust=my_lab; their code is run
    """
    from rich.text import Text

    from rgbt.checkpoints.load import plan_for
    from rgbt.checkpoints.read import read
    from rgbt.checkpoints.recognise import recognise
    from rgbt.checkpoints.view import PLAN_HEADER, facts_view, plan_rows
    from rgbt.tracking.tables import Grid
    from rgbt.tracking.terminal import rich_table, show

    contents = read(Path(arguments["file"]))
    facts = recognise(contents)
    show(facts_view(contents, facts))
    found = _network(contents, facts, overrides, parse_trust(arguments["trust"]))
    if found is None:
        return 0
    node, name = found
    _, plan, remarks = plan_for(_built(node), contents, tuple(node.get("fresh") or ()))
    show(rich_table(Grid(f"into {name}", PLAN_HEADER, plan_rows(plan))))
    show(Text("".join(f"remark  {remark}\n" for remark in remarks), end=""))
    return 0 if plan.fits else 1


def _network(
    contents: Contents, facts: Facts, overrides: list[str], trust: tuple[str, ...]
) -> tuple[DictConfig, str] | None:
    """The network that is asked about and its name; None where nothing says which."""
    beside = contents.path.parent / "config.yaml"
    if not overrides and contents.ours and beside.is_file():
        model = read_settings(beside).get("model")
        if model is None:
            return None
        check_targets({"model": model}, trust, str(beside), group="model")
        return OmegaConf.create({"model": model}).model, str(beside)
    if not any(word.startswith("model=") for word in overrides):
        usual = next((each for each in facts.fits if _is_there(each)), ())
        if not usual:
            return None
        overrides = [*usual, *overrides]
    if facts.classes and not any(word.startswith("model.num_classes=") for word in overrides):
        overrides = [*overrides, f"model.num_classes={facts.classes}"]
    return compose(overrides).model, " ".join(overrides)


def _is_there(overrides: tuple[str, ...]) -> bool:
    model = overrides[0].removeprefix("model=")
    return (conf_dir() / "model" / f"{model}.yaml").is_file()


def _built(node: DictConfig) -> Any:
    """The network without memory for its weights, where it can be built so."""
    import torch

    try:
        with torch.device("meta"):
            return build(node)
    except (NotImplementedError, RuntimeError):
        return build(node)


def export(arguments: dict[str, str], overrides: list[str]) -> int:
    """Write the weights of a run.

    run         run folder, config key or MLflow run id
    format      safetensors (names of this project), released (as the authors' code loads them),
                released_temporal (CMX as the temporal paper's code loads it)
    out         the new file; one that exists is left alone
    checkpoint  best (by the selection split) or last
    """
    from rgbt.build.initial_weights import differences
    from rgbt.checkpoints.layout import family_named
    from rgbt.checkpoints.read import read
    from rgbt.checkpoints.release import CONVENTIONS, save
    from rgbt.tracking.folder import find_run
    from rgbt.tracking.terminal import tell

    for word in overrides:
        raise InputError(
            f"'{word}': expected one of the keys of this command; "
            f"{nearest(word.partition('=')[0], EXPORT)}."
        )
    check_choice("checkpoint", arguments["checkpoint"], CHECKPOINTS)
    folder = find_run(arguments["run"], Path(arguments["runs_dir"]))
    model = _model(folder / "config.yaml")
    contents = read(folder / f"{arguments['checkpoint']}.pt")
    family = family_named(model._target_)
    plain: Any = OmegaConf.to_container(model, resolve=True)
    settings = {key: value for key, value in plain.items() if key not in NOT_SETTINGS}
    note = {
        "network": plain["_target_"],
        "family": family,
        "inputs": json.dumps(plain.get("inputs")),
        "settings": json.dumps(settings),
        "run": folder.name,
        "checkpoint": arguments["checkpoint"],
        "step": str(contents.settings.get("step", 0)),
    }
    out = Path(arguments["out"])
    remark = save(out, arguments["format"], family, contents.tensors, note)
    others = differences(model, CONVENTIONS.get((arguments["format"], family), ()))
    if others:
        tell(
            f"the authors' code does {' '.join(others)}, this run did something else; there its "
            "scores will not be ours."
        )
    if remark:
        tell(f"{remark}.")
    sys.stdout.write(f"{out}\n")
    return 0


def _model(path: Path) -> DictConfig:
    """Settings of a stored network, for what is written of them; nothing is built from them."""
    settings = read_settings(path)
    if not isinstance(settings.get("model", {}).get("_target_"), str):
        raise InputError(f"{path}: 'model' must be a mapping with `_target_`.")
    config: DictConfig = OmegaConf.create(settings).model
    return config


def main() -> None:
    """Run the command that the first word names."""
    commands = {"inspect": plain_command(INSPECT, inspect), "export": plain_command(EXPORT, export)}
    name, *words = sys.argv[1:] or [""]
    if name in ("-h", "--help"):
        sys.stdout.write(f"{(__doc__ or '').strip()}\n")
        sys.exit(0)
    if name not in commands:
        sys.stderr.write(
            f"rgbt: expected a command, got '{name}'; {nearest(name, commands)}, such as "
            "python -m rgbt.weights inspect FILE.\n"
        )
        sys.exit(2)
    if name == "inspect" and words and not words[0].startswith(("file=", "-")):
        words[0] = f"file={words[0]}"
    sys.argv[1:] = words
    commands[name]()


if __name__ == "__main__":
    main()
