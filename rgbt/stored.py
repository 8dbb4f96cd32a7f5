"""A run that lies in its folder, opened again: its configuration and its best weights."""

from __future__ import annotations

from pathlib import Path

import hydra
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from rgbt.checks import InputError, nearest
from rgbt.config import NODES, check, conf_dir, flatten, register_resolvers
from rgbt.engine.checkpoint import load_checkpoint, load_weights
from rgbt.session import Session, open_session

FIXED = ("model",)
"""What a stored run cannot be asked to change: the weights belong to it."""


def find_run(run: str, runs_dir: Path) -> Path:
    """The folder of a run given as a folder, a config key, or an MLflow run id.

    Raises:
        InputError: there is no such run.
    """
    for folder in (Path(run), runs_dir / run):
        if (folder / "config.yaml").is_file():
            return folder.resolve()
    for sent in sorted(runs_dir.glob("*/mlflow.json")):
        if f'"{run}"' in sent.read_text():
            return sent.parent.resolve()
    raise InputError(
        f"run={run}: neither a run folder (with a config.yaml), nor a key or an MLflow run id in "
        f"{runs_dir.resolve()}; list that folder to see the runs, or name another with runs_dir=..."
    )


def open_run(folder: Path, overrides: list[str]) -> Session:
    """Session of a stored run with its best weights.

    Args:
        folder: the run folder.
        overrides: Hydra overrides of the stored configuration. ``dataset=mfnet`` replaces the
            whole node by that file of ``conf/dataset/``; ``data.eval_batch_size=1`` one value.

    Raises:
        InputError: overrides that do not fit, no checkpoint, other classes than trained.
    """
    config = OmegaConf.load(folder / "config.yaml")
    assert isinstance(config, DictConfig), "a stored configuration is a mapping"
    trained = list(config.dataset.classes) if "classes" in config.dataset else None
    register_resolvers()
    _override(config, overrides)
    config.trainer.init_from = None
    check(config)
    session = open_session(config)
    if trained is not None and trained != list(session.dataset.classes):
        raise InputError(
            f"{folder} was trained with the classes {', '.join(trained)}, but "
            f"{session.dataset.name} has {', '.join(session.dataset.classes)}."
        )
    best = folder / "best.pt"
    load_weights(session.model, load_checkpoint(best)["model"], best)
    return session


def _override(config: DictConfig, overrides: list[str]) -> None:
    """Apply overrides in place: groups first, then single values."""
    pairs = [_pair(item) for item in overrides]
    groups = {key for key, _ in pairs if key in NODES}
    for group in groups:
        own = [f"{key}={value}" for key, value in pairs if key.split(".")[0] == group]
        with hydra.initialize_config_dir(str(conf_dir()), version_base="1.3"):
            composed = hydra.compose("config", own)
        # Values that refer to other nodes are settled here: the stored scale may be another one.
        missing = OmegaConf.missing_keys(composed[group])
        if missing:
            name = min(missing)
            raise InputError(f"'{group}.{name}' has no value; give one with {group}.{name}=...")
        config[group] = OmegaConf.to_container(composed[group], resolve=True)
    known = flatten(config)
    for key, value in pairs:
        if key.split(".")[0] in groups:
            continue
        if key.split(".")[0] in FIXED or key not in known:
            raise InputError(f"'{key}' cannot be changed of a stored run; {nearest(key, known)}.")
        try:
            OmegaConf.update(config, key, _parsed(value))
        except OmegaConfBaseException as error:
            raise InputError(f"{key}={value}: {str(error).splitlines()[0]}") from error


def _pair(item: str) -> tuple[str, str]:
    key, _, value = item.lstrip("+").partition("=")
    return key, value


def _parsed(value: str) -> object:
    return OmegaConf.to_container(OmegaConf.from_dotlist([f"v={value}"]))["v"]  # type: ignore[index,call-overload]
