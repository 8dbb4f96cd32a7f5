"""Settings of a sweep: the keys of ``conf/hydra/sweeper/study.yaml``, checked."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, Any, ClassVar, Literal, NamedTuple, cast

from annotated_types import Interval, Len, doc
from omegaconf import DictConfig, OmegaConf

from rgbt.checks import InputError, nearest
from rgbt.config.values import check_value
from rgbt.metrics import names as scores
from rgbt.metrics.scores import MEANS
from rgbt.ranges import Names, Positive, Text

# Scores that a run measures once, of its best checkpoint.
FINAL_METRICS = [
    scores.consistency(s, p) for s in (scores.TC, scores.CA) for p in ("aligned", "released")
]


@dataclass(frozen=True)
class Objective:
    """One number that a search optimizes.

    `metric` is "val/<score>" (best checkpoint on the selection split) or "test/<score>", the scores
    being those of `rgbt.metrics.names`; of two frames "val/TC/aligned" etc.
    """

    __pydantic_config__: ClassVar[dict[str, str]] = {"extra": "forbid"}

    metric: Text
    direction: Literal["maximize", "minimize"]

    def __post_init__(self) -> None:
        split, _, score = self.metric.partition("/")
        whole = score.removeprefix(f"{scores.DAY}/").removeprefix(f"{scores.NIGHT}/")
        known = [*MEANS, scores.VAR, *FINAL_METRICS]
        is_known = {whole, score} & {*known} or score.startswith(("region/", "class/"))
        if split not in ("val", "test") or not is_known:
            told = f"val/<score> or test/<score>; {nearest(score, known)}, region/<n>, class/<name>"
            raise InputError(f"objective '{self.metric}': {told}.")

    @property
    def is_consistency(self) -> bool:
        """Whether it is a score of two frames, which only some runs measure."""
        return self.metric.partition("/")[2] in FINAL_METRICS

    @property
    def is_reported(self) -> bool:
        """Whether a run reports it while it trains."""
        return self.metric.startswith("val/") and not self.is_consistency


Gpu = Annotated[int, Interval(ge=0, le=1023)]

# The GPU that a worker uses, or several for runs with `trainer.devices`.
GpuSlot = Gpu | Annotated[tuple[Gpu, ...], Len(1, 64)]

NumRuns = Annotated[int, Interval(ge=1, le=10**6)]


class Launcher(NamedTuple):
    """The choice of ``hydra/launcher``, and its settings (``hydra.launcher``)."""

    name: Text = "basic"
    options: dict[str, Any] = {}


@dataclass(frozen=True, kw_only=True)
class SweepSettings:
    """See ``conf/hydra/sweeper/study.yaml``, which explains every key and holds the defaults."""

    __pydantic_config__: ClassVar[dict[str, str]] = {"extra": "forbid"}

    storage: Text | None
    workers: Annotated[int, Interval(ge=1, le=1024), doc("jobs at the same time")] | None
    gpus: Annotated[tuple[GpuSlot, ...], Len(1, 1024)] | None
    retry: Literal["none", "failed"]
    timeout_minutes: Positive | None
    wait: bool
    stop_jobs: bool
    commands: Text | None
    dry_run: bool
    study: Text | None
    params: dict[str, Any]
    points: tuple[Names, ...]
    space: dict[str, dict[str, Any]]
    objectives: Annotated[tuple[Objective, ...], Len(1, 10)]
    sampler: dict[str, Any]
    pruner: dict[str, Any] | None
    trials: NumRuns | None
    hours: Positive | None
    replicates: Annotated[int, Interval(ge=1, le=1000)]
    trust: Annotated[str, Len(0, 4096)]
    launcher: Launcher = Launcher()


# Keys whose interpolations (``${px:64}``) are resolved by the runs -> what null stands for.
UNRESOLVED: dict[str, Any] = {"space": {}, "params": {}, "points": []}


def read_settings(node: DictConfig, launcher: Launcher) -> SweepSettings:
    """Settings from the node ``hydra.sweeper``; InputError names a wrong or missing key."""
    raw = OmegaConf.to_container(node, resolve=False)
    assert isinstance(raw, dict), "the node of a sweeper is a mapping"
    plain: dict[str, Any] = {}
    for key in (str(key) for key in raw if key not in ("_target_", "_recursive_")):
        value = raw[key] or UNRESOLVED[key] if key in UNRESOLVED else node[key]
        is_config = OmegaConf.is_config(value)
        plain[key] = OmegaConf.to_container(value, resolve=True) if is_config else value
    settings = cast(SweepSettings, check_value("hydra.sweeper", plain, SweepSettings))
    if not settings.wait and launcher.name in ("basic", "submitit_local"):
        raise InputError("hydra.sweeper.wait=false: runs of this machine end with the command.")
    if not settings.wait and settings.timeout_minutes is not None:
        raise InputError(
            "hydra.sweeper.timeout_minutes needs hydra.sweeper.wait=true: the command stops the "
            "jobs. SLURM has a limit of its own, hydra.launcher.timeout_min."
        )
    return replace(settings, launcher=launcher)


def read_launcher(node: DictConfig) -> Launcher:
    """The launcher from the node ``hydra``."""
    options = OmegaConf.to_container(node.launcher, resolve=True)
    return Launcher(node.runtime.choices["hydra/launcher"], cast("dict[str, Any]", options))
