"""Invalid values for every key of the configuration, and the result of each.

Composing takes long, so that a configuration is composed once and its nodes are changed.
"""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig, ListConfig, OmegaConf

from rgbt.build.training_setup import set_up_training
from rgbt.checks import InputError
from rgbt.config.component import Component
from rgbt.config.compose import compose
from rgbt.engine.checkpoint import State
from rgbt.engine.trainer import Trainer
from rgbt.spec.run_spec import NODES
from rgbt.spec.specify import specify

NO_NUMBER = (float("nan"), float("inf"), -float("inf"), 1e30, -1e30, 10**12)
NO_TEXT = ("", "x" * 100_000, "a\x00b", "two\nlines")
NEVER = (*NO_NUMBER, *NO_TEXT)
"""Values that no setting can mean, whatever it is: one that is accepted is a mistake of ours."""

KINDS: dict[type, tuple[Any, ...]] = {
    bool: (True,),
    int: (-1, 0, 1, 2),
    float: (0.5,),
    str: ("x", "Größe ☃"),
    list: ([], [1], [-1, 0], [1.0, 0.5]),
    dict: ({}, {"a": 1}),
    type(None): (None,),
}
"""Values that some settings can mean, by kind."""

POOL = (*NEVER, *(value for values in KINDS.values() for value in values))

NEGATIVE = {
    "camera_pitch_deg": "a camera may look up",
    "ego_forward_m": "a car may go back",
    "ego_yaw_deg": "a car may turn to either side",
    "source_value": "LSGAN stands -1 and 1 for the two sides",
    "target_value": "likewise",
}
"""Numbers that may be -1, and why."""

EXPERIMENTS = (
    "grbm",
    "cmx",
    "temporal_con",
    "heatnet",
    "sh_max_squares",
    "multi_head_night_stage1",
)
"""Together they name most constructors."""

SMALL = {
    "dataset.num_train": 4,
    "dataset.num_train_day": 4,
    "dataset.num_train_night": 4,
    "dataset.num_val": 2,
    "dataset.num_test": 2,
    "scale.batch_size": 2,
    "scale.eval_batch_size": 2,
    "scale.num_points": 64,
    "trainer.accelerator": "cpu",
    "trainer.threads": 1,
}
"""As `conf/debug/smoke.yaml`, for the keys that a data set has."""


@dataclass(frozen=True)
class Case:
    """One key of a configuration with another value."""

    experiment: str
    key: str
    usual: Any
    value: Any

    def __str__(self) -> str:
        return f"+experiment={self.experiment} {self.key}={str(self.value)[:30]!r}"

    @property
    def must_be_refused(self) -> bool:
        """Whether the kind of the usual value says that this one is senseless."""
        if any(self.value is each for each in NEVER) or self.key.endswith("_target_"):
            return True
        if self.value is None or self.usual is None:
            return False
        if self.value == -1 and not isinstance(self.value, bool):
            return self.key.rpartition(".")[2] not in NEGATIVE
        number = (int, float)
        same = [kinds for kinds in ((bool,), number, (str,), (list,), (dict,))]
        kind = next(kinds for kinds in same if isinstance(self.usual, kinds))
        return not isinstance(self.value, kind) or (isinstance(self.value, bool) != (bool in kind))


def composed(experiment: str, *words: str) -> DictConfig:
    """A configuration of small sizes."""
    config = compose([f"+experiment={experiment}", "tracking=none", *words])
    for key, value in SMALL.items():
        parent = config[key.split(".")[0]]
        if key.split(".")[1] in parent:
            OmegaConf.update(config, key, value)
    return config


def leaves(node: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """Every key that holds no mapping of further keys, with its value."""
    for key in node:
        full = f"{path}.{key}" if path else str(key)
        value = None if OmegaConf.is_missing(node, key) else node[key]
        if isinstance(value, DictConfig) and len(value):
            yield from leaves(value, full)
        else:
            yield full, OmegaConf.to_container(value) if isinstance(value, ListConfig) else value


def cases(
    configs: dict[str, DictConfig], values: Sequence[Any] = POOL
) -> Iterator[tuple[DictConfig, Case]]:
    """Every value for every setting of every constructor, each once."""
    seen: set[tuple[Any, str]] = set()
    for experiment, config in configs.items():
        for key, usual in leaves(config):
            parent, _, last = key.rpartition(".")
            target = OmegaConf.select(config, parent).get("_target_") if parent else None
            if (target, last) in seen:
                continue
            seen.add((target, last))
            yield from ((config, Case(experiment, key, usual, value)) for value in values)


@contextmanager
def changed(config: DictConfig, case: Case) -> Iterator[DictConfig]:
    """`config` with the value of a case, for a while."""
    parent, _, last = case.key.rpartition(".")
    node: Any = OmegaConf.select(config, parent) if parent else config
    content = node.__dict__["_content"]
    usual = content[last]
    content[last] = OmegaConf.create({last: case.value})._get_node(last)
    content[last]._set_parent(node)
    try:
        yield config
    finally:
        content[last] = usual


def checked(config: DictConfig, case: Case) -> None:
    """The check of the node alone that a case changes."""
    head = case.key.split(".")[0]
    if head in NODES:
        Component.from_node(config[head], head)
    else:
        specify(config)


def used(folder: Path) -> Callable[[DictConfig, Case], None]:
    """Everything that a run builds, and one step of its training."""

    def use(config: DictConfig, case: Case) -> None:
        del case
        spec = specify(config)
        assert spec.key
        spec.tracking.build()
        prepared = set_up_training(spec)
        session = prepared.session
        settings = replace(session.trainer, max_steps=1)
        Trainer(
            fabric=session.fabric,
            settings=settings,
            scheme=prepared.scheme,
            model=prepared.model,
            others=prepared.others,
            optimizers=prepared.optimizers,
            schedule=prepared.schedule,
            steps_per_epoch=max(1, prepared.steps_per_epoch() // settings.accumulate),
            folder=folder,
            record=lambda step, values: None,
            validate=lambda step: 0.0,
        ).fit(prepared.batches(range(settings.accumulate)), State(seed=config.seed))

    return use


@contextmanager
def within(seconds: int) -> Iterator[None]:
    """TimeoutError after so many seconds."""

    def stop(number: int, frame: Any) -> None:
        raise TimeoutError(f"not done after {seconds} s")

    before = signal.signal(signal.SIGALRM, stop)
    signal.alarm(seconds)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


def outcome(
    use: Callable[[DictConfig, Case], None], config: DictConfig, case: Case, seconds: int = 120
) -> str:
    """ "refused", "accepted", or what is wrong with either."""
    threads = torch.get_num_threads()
    try:
        with within(seconds), changed(config, case):
            use(config, case)
    except InputError as error:
        return "refused" if "\n" not in str(error) else f"many lines: {error}"
    except TimeoutError:
        return "endless"
    except Exception as error:  # what a fuzz is for
        return f"traceback: {type(error).__name__}: {str(error)[:200]}"
    finally:
        torch.set_num_threads(threads)
    return "senseless value accepted" if case.must_be_refused else "accepted"
