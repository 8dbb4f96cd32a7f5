"""What makes a run the one that it is: its key, its files, the earlier runs it stands on."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from rgbt.checks import InputError, nearest
from rgbt.config.compose import available, compose, search_path
from rgbt.config.hydra_messages import forgotten
from rgbt.config.schema import NODES, OF_THE_RUN, check, typed
from rgbt.files.budgets import read_json
from rgbt.spec.source_code import user_code

SHARED = (
    *("seed", "runs_dir", "pretrained", "dataset", "data", "metric", "tracking"),
    *(f"trainer.{key}" for key in ("max_steps", "eval_every", "checkpoint_every", "log_every")),
    *(f"trainer.{key}" for key in ("precision", "accelerator", "threads")),
)
"""What an earlier run (`earlier_config`) has in common with the run that needs it, beside the sizes
of the scale. A duration is that of the scale unless it was typed."""

DOMAINS = ("source", "target")

NOT_IN_KEY = (
    *("name", "runs_dir", "out", "scale", "recipe", "tracking", "consistency"),
    *("dataset.root", "dataset.cache_dir", "dataset.palette", "dataset.layout", "dataset.absent"),
    *("data.num_workers", "data.on_error", "data.eval_batch_size"),
    *("data.prefetch", "data.augment", "data.cache"),
    *("trainer.accelerator", "trainer.log_every", "trainer.checkpoint_every"),
)
"""What may differ between two runs that are the same run: labels, paths, hardware, tracking, what
is measured beside, and what counts where others take it up: the sizes of `scale` and `recipe`, and
`dataset.absent` in `metric.absent`."""

LATER: dict[str, Any] = {
    "trainer.tested": "best",
    "trainer.threads": 2,
    "domains": {
        "_target_": "rgbt.data.domains.Domains",
        "source": {
            "_target_": "rgbt.data.domains.Domain",
            **{"split": "train", "view": None, "head": None, "labels": "given"},
            **{"teacher_view": None, "threshold": 0.0, "confidence": False},
        },
        **{"target": None, "target_is": None, "tested_head": "own"},
    },
}
"""Settings that came after runs had been made, with what those did: left out of the key where they
say that, so that a run has the key that it always had."""


def run_key(config: DictConfig) -> str:
    """12 hexadecimal digits that name the run: hash of the resolved configuration.

    Paths, hardware, labels and tracking (`NOT_IN_KEY`) are left out, so that the same method with
    the same seed is the same run wherever it is started from. A file of weights, or a folder of
    pseudo-labels, counts by what is in it, not by where it lies; what is made by an earlier run
    (`rgbt.training.pipeline`) by the key of that run, which need not be there yet.

    Raises:
        InputError: the file of weights or the folder of pseudo-labels is not there.
    """
    plain: dict[str, Any] = {"seed": config.seed}
    if config.model.get("weights") is not None:
        plain["weights"] = [_content("model.weights", config), *config.model.get("fresh", [])]
    plain |= {key: _canonical(config[key], key) for key in NODES}
    for name in DOMAINS:
        if plain["domains"][name] is not None:
            plain["domains"][name]["labels"] = _content(f"domains.{name}.labels", config)
    for dotted in NOT_IN_KEY:
        parent, last = _parent(plain, dotted)
        parent.pop(last, None)
    for dotted, first in LATER.items():
        parent, last = _parent(plain, dotted)
        if parent.get(last) == first:
            del parent[last]
    code = user_code(_targets(plain))
    if code:
        plain["code"] = code
    text = json.dumps(plain, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:12]


def own_code(config: DictConfig) -> dict[str, str]:
    """Digest or version of what `config` uses of the user's own code, by module.

    See `rgbt.spec.source_code.user_code`.
    """
    return dict(user_code(_targets(OmegaConf.to_container(config, resolve=True))))


def _targets(value: Any) -> Iterator[str]:
    """Every `_target_` inside plain values."""
    if isinstance(value, dict) and "_target_" in value:
        yield value["_target_"]
    children = value.values() if isinstance(value, dict) else value
    for child in children if isinstance(value, dict | list) else ():
        yield from _targets(child)


def _parent(plain: dict[str, Any], dotted: str) -> tuple[dict[str, Any], str]:
    *parents, last = dotted.split(".")
    node: dict[str, Any] = plain
    for parent in parents:
        node = node.get(parent, {})
    return node, last


def _content(key: str, config: DictConfig) -> str:
    """What stands for a file, a folder or an earlier run in the key of a run that reads it."""
    value = str(OmegaConf.select(config, key))
    reference = earlier_run(key, value)
    if reference is not None:
        experiment, checkpoint = reference
        return f"{run_key(earlier_config(config, key, experiment))}/{checkpoint}"
    if key == "model.weights":
        source = weights_file(config)
        assert source is not None, "model.weights has a value"
        with source.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    if value in ("given", "none"):
        return value
    return str(manifest_of(key, value)["digest"])


def manifest_of(key: str, folder: str) -> dict[str, Any]:
    """What a folder of pseudo-labels says of itself.

    Raises:
        InputError: it is not there, or not finished.
    """
    path = Path(folder).expanduser() / "pseudo_labels.json"
    if not path.is_file():
        raise InputError(
            f"{key}={folder}: expected given, none, experiment:NAME/best.pt, or a folder of "
            f"pseudo-labels that is finished, but there is no {path}; write it with "
            "python -m rgbt.predict ... pseudo_labels=true."
        )
    found: dict[str, Any] = read_json(path, dict[str, Any], "remove it and predict again")
    if "digest" not in found:
        raise InputError(f"{path} does not describe pseudo-labels; predict into another folder.")
    return found


def earlier_run(key: str, value: str | None) -> tuple[str, str] | None:
    """Experiment and checkpoint that "experiment:NAME/last.pt" names; None for any other value.

    Raises:
        InputError: it begins so and goes on otherwise, or there is no such experiment.
    """
    if value is None or not value.startswith("experiment:"):
        return None
    name, _, checkpoint = value.removeprefix("experiment:").rpartition("/")
    if checkpoint not in ("best.pt", "last.pt"):
        raise InputError(
            f"{key}={value}: expected experiment:NAME/best.pt or experiment:NAME/last.pt."
        )
    known = available("experiment")
    if name not in known:
        raise InputError(
            f"{key}={value}: there is no experiment '{name}'; {nearest(name, known)}. A run can be "
            f"named by its folder too: runs/<key>/{checkpoint}.{forgotten()}"
        )
    return name, checkpoint


def earlier_config(config: DictConfig, key: str, experiment: str) -> DictConfig:
    """The configuration of an earlier run: its experiment, with what both runs share.

    Shared (`SHARED`) are seed, scale, data set and how it is loaded, durations that were typed,
    device, regions, tracking, and where runs lie; of a run to start from also the network.
    Everything else is the experiment's own.

    Args:
        config: of the run that needs it.
        key: that names it, such as "model.weights".
        experiment: its name.

    Raises:
        InputError: the experiment needs itself.
    """
    if config.name == experiment:
        raise InputError(f"experiment {experiment} names itself as an earlier run.")
    earlier = _composed(experiment, config.scale.name, *search_path()).copy()
    # Whether a network has pretrained weights is said by its experiment, all else by the scale.
    shared = [*SHARED, *(f"scale.{each}" for each in config.scale if each != "pretrained")]
    if key == "model.weights":
        own = [each for each in config.model if each not in OF_THE_RUN["model"]]
        shared += [f"model.{each}" for each in own]
        earlier.model = {each: earlier.model._get_node(each) for each in OF_THE_RUN["model"]}
    for each in shared:
        *parents, last = each.split(".")
        mine: Any = OmegaConf.select(config, ".".join(parents)) if parents else config
        node = mine._get_node(last)
        value = OmegaConf.to_container(node) if OmegaConf.is_config(node) else node._value()
        OmegaConf.update(earlier, each, value, merge=False, force_add=True)
    check(earlier)
    return earlier


@cache
def _composed(experiment: str, scale: str, *search_path: str) -> DictConfig:
    """An experiment by itself; cached, because composing takes long and a chain needs it often."""
    return compose([f"+experiment={experiment}", f"scale={scale}", *search_path])


def weights_file(config: DictConfig) -> Path | None:
    """The file that `model.weights` names; of a run folder its best checkpoint. None: no weights.

    Raises:
        InputError: there is no such file, or an earlier run is not finished.
    """
    named = config.model.get("weights")
    if named is None:
        return None
    reference = earlier_run("model.weights", named)
    if reference is not None:
        experiment, checkpoint = reference
        named = (
            Path(config.runs_dir)
            / run_key(earlier_config(config, "model.weights", experiment))
            / checkpoint
        )
    path = Path(named).expanduser()
    path = path / "best.pt" if path.is_dir() else path
    if not path.is_file():
        raise InputError(
            f"model.weights={named}: there is no file {path}; give a file of weights, or the "
            "folder of a run."
        )
    return path


def _canonical(node: DictConfig, path: str) -> dict[str, Any]:
    """Values as their constructors take them: 4 and 4.0 are one value where both mean 4.0."""
    from pydantic_core import to_jsonable_python

    values = to_jsonable_python(typed(node, path, _canonical))
    return {"_target_": node["_target_"], **values}
