"""A run opened again from its folder, or a network opened with weights from a file."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from rgbt.build.session import Session, names_key, open_session
from rgbt.checks import InputError, check_choice, nearest
from rgbt.config.compose import compose, flatten, register_resolvers
from rgbt.config.schema import check
from rgbt.config.stored_config import load_config
from rgbt.data.label_map import LabelMap
from rgbt.engine.checkpoint import load_checkpoint, restore_weights, step_of
from rgbt.files.yaml_files import parse_yaml
from rgbt.metrics.counts import Counts
from rgbt.spec.run_key import own_code, run_key, weights_file
from rgbt.tracking.folder import RunFolder, find_run
from rgbt.tracking.formats import read_marker
from rgbt.tracking.terminal import tell

CHECKPOINTS = ("best", "last")
GROUPS = ("dataset", "metric", "consistency")
CHANGEABLE = (
    *("dataset", "data", "metric", "consistency", "transform.test_short_edge"),
    *("trainer.accelerator", "trainer.threads", "trainer.precision"),
)
"""What may be changed of a stored run: where images come from and how they are counted."""


@dataclass(frozen=True)
class Stored:
    """A trained network, opened.

    Attributes:
        session: its objects; the network holds the trained weights.
        step: the optimiser step at which these were reached; 0 where the file does not say.
        folder: where what is made from it is put unless another place is named.
        label: what it is called in tables.
    """

    session: Session
    step: int
    folder: Path
    label: str


def open_trained(
    run: str,
    runs_dir: Path,
    overrides: list[str],
    checkpoint: str = "best",
    label_map: LabelMap | None = None,
    trust: Collection[str] = (),
) -> Stored:
    """What ``run=`` names; without, the network of `overrides` with `model.weights`.

    Args:
        run: folder, config key or MLflow run id; "" for none.
        runs_dir: where runs lie.
        overrides: of the stored configuration, or (without a run) of the configuration at
            scale=paper, such as model=mfnet model.weights=final.pth dataset.root=/data/MFNet.
        checkpoint: "best" or "last" of a run.
        label_map: from the classes of the network to those of the data set, where they differ.
        trust: see `open_run`.

    Raises:
        InputError: no such run; no weights; settings that do not fit.
    """
    if run:
        return open_run(find_run(run, runs_dir), overrides, checkpoint, label_map, trust)
    config = compose(["scale=paper", f"runs_dir={runs_dir}", *overrides])
    source = weights_file(config)
    if source is None:
        raise InputError(
            "'run' has no value; give one with run=..., or a network with weights from a file: "
            "model=mfnet model.weights=final.pth dataset.root=/data/MFNet."
        )
    check(config)
    if checkpoint != "best":
        raise InputError(f"checkpoint={checkpoint} is one of a run; name that with run=...")
    session = open_session(config, label_map)
    if session.weights is not None and session.weights.fresh:
        raise InputError(
            f"{source} does not hold the whole network, the rest would be random: "
            f"{session.weights.sentence()}; train it first with python -m rgbt.run."
        )
    # Copies of a data set in other places may hold other images.
    place = f"{run_key(config)}-{session.dataset.fingerprint()[:8]}"
    return Stored(session, 0, runs_dir / "evaluations" / place, source.name)


def open_run(
    folder: Path,
    overrides: list[str],
    checkpoint: str = "best",
    label_map: LabelMap | None = None,
    trust: Collection[str] = (),
) -> Stored:
    """Session of a stored run with its weights.

    Args:
        folder: the run folder.
        overrides: of the stored configuration (`CHANGEABLE`). ``dataset=mfnet`` replaces the whole
            node by that file of ``conf/dataset/``; ``data.eval_batch_size=1`` one value.
        checkpoint: "best" by the selection split, or "last".
        label_map: from the classes it was trained with to those of the data set, where they differ.
        trust: modules that the stored configuration may name (`rgbt.config.stored_config`).

    Raises:
        InputError: a target that is not trusted, overrides that do not fit, no checkpoint, other
            classes than trained.
    """
    register_resolvers()
    config = load_config(folder / "config.yaml", trust)
    defaults = compose([])
    for key, value in _plain(defaults).items():
        if key not in config:  # a run of before there was any
            config[key] = value
    for key, value in _plain(defaults.data).items():
        if key not in config.data:
            config.data[key] = value
    if config.trainer.threads is None:  # of before it had a number: one thread per core
        config.trainer.threads = defaults.trainer.threads
    if "absent" not in config.dataset:  # a run from before data sets had a convention
        config.dataset.absent = config.metric.get("absent", "exclude")
    _warn_of_other_code(folder, config)
    trained_on = config.dataset.get("name")
    _override(config, [_pair(item) for item in overrides])
    config.model.weights = None  # the checkpoint holds them all
    check(config)
    check_choice("checkpoint", checkpoint, CHECKPOINTS)
    weights = folder / f"{checkpoint}.pt"
    if not weights.is_file():
        raise InputError(
            f"{folder} has no {weights.name}: the run has not come to its first evaluation; rerun "
            "its command to resume it"
            + (", or take checkpoint=last." if (folder / "last.pt").is_file() else ".")
        )
    payload = load_checkpoint(weights)
    session = open_session(config, label_map)
    for path in sorted(folder.glob("counts_*.npz"))[:1]:
        trained = Counts.load(path).classes
        if label_map is None and trained != tuple(session.dataset.classes):
            raise InputError(
                f"{folder} was trained with the classes {', '.join(trained)}, but "
                f"{session.dataset.name} has {', '.join(session.dataset.classes)}; rgbt.predict "
                "can map them with label_map=..."
            )
    restore_weights(session.model, payload["model"], weights)
    _tell_other_splits(folder, trained_on, session)
    return Stored(session, step_of(payload, weights), folder / "evaluations", config.name)


def _warn_of_other_code(folder: Path, config: DictConfig) -> None:
    """Say so where the user's own code is not what the run was trained with."""
    now = own_code(config)
    entries = RunFolder(folder).provenance() if now else []
    before = entries[-1].get("own_code") if entries else None
    if before is not None and before != now:
        modules = sorted(name for name in {*before, *now} if before.get(name) != now.get(name))
        tell(
            f"warning: {', '.join(modules)} changed after {folder.name} was trained; what is "
            "computed now is not what this run made. Restore the code, or train again."
        )


def _tell_other_splits(folder: Path, trained_on: str | None, session: Session) -> None:
    """Say so where the data set that a run was trained on is divided otherwise by now.

    Lists that were changed, or shares that are drawn anew as files come and go: images of the
    training may be among those that are measured.
    """
    if trained_on is None or session.config.dataset.get("name") != trained_on:
        return
    try:
        now, before = names_key(session), read_marker(folder)
    except (InputError, OSError):
        return  # nothing to compare with
    if before is not None and now != before["names"]:
        tell(
            f"the splits of {session.dataset.name} ({session.dataset.root}) are not those that "
            f"{folder.name} was trained with: what is measured now may hold images of its training."
        )


def _plain(node: DictConfig) -> dict[str, Any]:
    """Values, with every reference to others replaced; those that must be given are left out."""
    found = OmegaConf.to_container(node, resolve=True)
    assert isinstance(found, dict)
    return {str(key): value for key, value in found.items() if value != "???"}


def _override(config: DictConfig, pairs: list[tuple[str, str]]) -> None:
    """Apply overrides in place: groups first, then single values.

    Absent classes count by the convention of the data set that is measured, unless the run or
    `pairs` set ``metric.absent`` by hand. A partition of a user's own class may lack the setting.
    """
    absent = config.metric.get("absent")
    by_hand = absent not in (None, config.dataset.absent)
    search = [f"{key}={value}" for key, value in pairs if key == "hydra.searchpath"]
    pairs = [pair for pair in pairs if pair[0] != "hydra.searchpath"]
    for key, _ in pairs:
        if not _is_changeable(_place(key)):
            raise InputError(
                f"'{key}' cannot be changed of a stored run; {nearest(key, CHANGEABLE)}."
            )
    groups = [key for key, _ in pairs if key in GROUPS]
    for group in groups:
        own = [f"{key}={value}" for key, value in pairs if _place(key).split(".")[0] == group]
        composed = compose([*own, *search])[group]
        for name in OmegaConf.missing_keys(composed):
            raise InputError(f"'{name}' has no value; give one with {name}=...")
        config[group] = OmegaConf.to_container(composed, resolve=True)
    known = flatten(config)
    for key, value in pairs:
        if _place(key).split(".")[0] in groups:
            continue
        # A mapping such as dataset.shares is one value, and may be replaced as one.
        if key not in known and not any(each.startswith(f"{key}.") for each in known):
            node = key.partition(".")[0]
            open_ones = [each for each in known if _is_changeable(each)]
            near = [each for each in open_ones if each.startswith(f"{node}.")]
            raise InputError(
                f"'{key}' is not a key of this run; {nearest(key, near or open_ones)}."
            )
        OmegaConf.update(config, key, parse_yaml(value, key))
    is_typed = "metric.absent" in [_place(key) for key, _ in pairs]
    if "absent" in config.metric and not is_typed:
        config.metric.absent = absent if by_hand else config.dataset.get("absent", "exclude")


def _is_changeable(place: str) -> bool:
    return any(place == each or place.startswith(f"{each}.") for each in CHANGEABLE)


def _place(key: str) -> str:
    """Where in the configuration an override works: camera@consistency.view.camera goes there."""
    return key.rpartition("@")[2]


def _pair(item: str) -> tuple[str, str]:
    key, _, value = item.lstrip("+").partition("=")
    return key, value
