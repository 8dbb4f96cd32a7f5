"""What a run needs of earlier runs: trained here, before it, where it is missing.

A configuration names them by their experiment: ``model.weights=experiment:NAME/last.pt`` starts
from the end of that run (the stage before, or another task), ``domains.target.labels=
experiment:NAME/best.pt`` learns from what its network predicts. Seed, scale and data set are those
of the run that asks (`rgbt.spec.run_key.SHARED`), so that a run of seed 2 stands on runs of seed 2.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from omegaconf import DictConfig, OmegaConf

from rgbt.checks import InputError
from rgbt.config.stored_config import targets
from rgbt.data.domains import GIVEN, NONE
from rgbt.data.pseudo_labels import MANIFEST
from rgbt.files.atomic import is_held
from rgbt.spec.naming import TAGS
from rgbt.spec.run_key import DOMAINS, SHARED, earlier_config, earlier_run, run_key
from rgbt.tracking.folder import RunFolder
from rgbt.tracking.other_code import other_code
from rgbt.tracking.terminal import tell

LOOK_S = 1.0
"""Between two looks at a run that another process trains."""

Train = Callable[[DictConfig, Sequence[str]], None]
"""Brings a run to its end (see `rgbt.training.train`)."""

Rehearse = Callable[[DictConfig], None]
"""Refuses what would go wrong after the earlier runs (see `rgbt.build.training_setup.rehearse`)."""


@dataclass(frozen=True)
class Earlier:
    """A run that another one needs.

    Attributes:
        key: dotted key of the configuration that names it.
        experiment: its experiment.
        checkpoint: "best.pt" or "last.pt".
        config: its configuration.
    """

    key: str
    experiment: str
    checkpoint: str
    config: DictConfig

    @cached_property
    def folder(self) -> Path:
        """Its run folder."""
        return Path(self.config.runs_dir) / run_key(self.config)

    @property
    def is_finished(self) -> bool:
        """Whether it has its result."""
        return (self.folder / "result.json").exists()


def earlier_runs(config: DictConfig) -> Iterator[Earlier]:
    """The runs that a configuration names, in the order in which it does."""
    for key in ("model.weights", *(f"domains.{name}.labels" for name in DOMAINS)):
        found = _named_by(key, config)
        if found is not None:
            yield found


def _named_by(key: str, config: DictConfig) -> Earlier | None:
    reference = earlier_run(key, OmegaConf.select(config, key))
    if reference is None:
        return None
    return Earlier(key, *reference, earlier_config(config, key, reference[0]))


def finish_earlier(
    config: DictConfig, train: Train, rehearse: Rehearse, words: Sequence[str]
) -> None:
    """Train what `config` needs and is not finished, and what that needs, and predict its labels.

    A run that another process trains is waited for.

    Args:
        config: composed and checked.
        train: see `Train`.
        rehearse: see `Rehearse`; called before anything is trained.
        words: overrides of `config` as they were typed, for the names of the earlier runs.

    Raises:
        InputError: see `rehearse` and `train`; where an earlier run is wrong, it is named.
    """
    labels = [labels_folder(config, name) for name in DOMAINS if config.domains[name] is not None]
    are_there = all(each is None or (each / MANIFEST).is_file() for each in labels)
    needed = list(earlier_runs(config))
    if not (are_there and all(earlier.is_finished for earlier in needed)):
        rehearse(config)
    for earlier in needed:
        typed = [f"+experiment={earlier.experiment}", *_shared(words, earlier.key)]
        if not earlier.is_finished:
            with _naming(earlier, config):
                finish_earlier(earlier.config, train, rehearse, typed)
                tell(
                    f"{config.name} needs a run of {earlier.experiment} ({earlier.key}), which "
                    f"comes first: {earlier.folder}"
                )
                _finish(earlier, train, typed)
        if earlier.key != "model.weights":
            _write_labels(earlier, config, earlier.key.split(".")[1])


def warn_of_other_code(needed: Sequence[Earlier]) -> None:
    """Say which finished runs that a run needs were made by other code: fresh=true keeps them."""
    for earlier in needed:
        made_by = other_code(RunFolder(earlier.folder)) if earlier.is_finished else None
        if made_by is not None:
            tell(
                f"warning: the upstream run {earlier.folder} ({earlier.key}) was made by other "
                f"code ({made_by}) and is used as it is; to train it again, run "
                f"+experiment={earlier.experiment} with fresh=true."
            )


def reads_pretrained(config: DictConfig) -> bool:
    """Whether `config`, or a run that it stands on, starts from the file `pretrained`."""
    return config.model.get("weights") == config.pretrained or any(
        reads_pretrained(earlier.config) for earlier in earlier_runs(config)
    )


def labels_folder(config: DictConfig, name: str) -> Path | None:
    """The folder of pseudo-labels of a domain; None where it takes no pseudo-labels."""
    node = config.domains[name]
    earlier = _named_by(f"domains.{name}.labels", config)
    if earlier is not None:
        words = [node.split, node.teacher_view or "default"]
        words += [earlier.checkpoint.removesuffix(".pt")]
        words += [f"{node.threshold:g}"] if node.threshold else []
        return earlier.folder / "pseudo_labels" / "_".join(words)
    return None if node.labels in (GIVEN, NONE) else Path(node.labels).expanduser()


def _shared(words: Sequence[str], key: str) -> list[str]:
    """Those of the typed overrides that hold for an earlier run as well."""
    groups = ("scale", "dataset", "metric", *(("model",) if key == "model.weights" else ()))
    own = ("model.weights", "model.fresh")
    places = [(word, word.partition("=")[0].lstrip("+").rpartition("@")[2]) for word in words]
    return [
        word
        for word, place in places
        if place not in own
        and (
            place in SHARED
            or place.replace("/", ".").split(".")[0] in groups
            or place.startswith("data.")
        )
        and place not in ("seed", "runs_dir")
    ]


@contextmanager
def _naming(earlier: Earlier, config: DictConfig) -> Iterator[None]:
    """Say which run is wrong, where it is not the one that was asked for."""
    try:
        yield
    except InputError as error:
        raise InputError(
            f"{earlier.experiment}, which {config.name} needs ({earlier.key}): {error}"
        ) from error


def _finish(earlier: Earlier, train: Train, words: Sequence[str]) -> None:
    told = False
    while not earlier.is_finished:
        if is_held(earlier.folder / "lock"):
            if not told:
                tell(f"{earlier.folder} is being trained by another process; waiting for it.")
            told = True
            time.sleep(LOOK_S)
            continue
        try:
            with _without_tags():
                train(earlier.config, words)
        except InputError:
            # Another process may have begun it between the look and the start, and even ended it.
            if not (earlier.is_finished or is_held(earlier.folder / "lock")):
                raise


@contextmanager
def _without_tags() -> Iterator[None]:
    """Tags of a table's row or a trial are those of the run that was asked for."""
    tags = os.environ.pop(TAGS, None)
    try:
        yield
    finally:
        if tags is not None:
            os.environ[TAGS] = tags


def _write_labels(earlier: Earlier, config: DictConfig, name: str) -> None:
    from rgbt.build.load_run import open_run
    from rgbt.evaluation.pseudo_labels import Labelling, teacher_of, write_pseudo_labels
    from rgbt.evaluation.request import EvaluationRequest

    folder, node = labels_folder(config, name), config.domains[name]
    assert folder is not None, "the domain takes labels of an earlier run"
    if (folder / MANIFEST).exists():
        return
    # The earlier run may have been made on another machine, and where the data lie elsewhere.
    here = [
        *(f"data.{each}" for each in config.data if each != "_target_"),
        *("trainer.accelerator", "trainer.threads"),
        *(f"dataset.{each}" for each in ("root", "cache_dir") if each in config.dataset),
    ]
    place = [f"{each}={json.dumps(OmegaConf.select(config, each))}" for each in here]
    checkpoint = earlier.checkpoint.removesuffix(".pt")
    # The user's own: the same configuration as this command composed.
    own = [target for _, target in targets(OmegaConf.to_container(earlier.config))]
    session = open_run(earlier.folder, place, checkpoint, trust=own).session
    teacher = teacher_of(earlier.folder.name, session.model)
    request = EvaluationRequest(split=node.split, view=node.teacher_view)
    write_pseudo_labels(session, teacher, request, Labelling(node.threshold), folder)
