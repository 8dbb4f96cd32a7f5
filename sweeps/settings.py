"""Settings of a sweep: the keys of ``conf/hydra/sweeper/study.yaml``, checked."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from importlib.util import find_spec
from typing import Annotated, Any, ClassVar, Literal, cast

from annotated_types import Interval, Len, doc
from omegaconf import DictConfig, OmegaConf

from rgbt.checks import InputError, nearest
from rgbt.config.overrides import LAUNCHERS
from rgbt.config.values import check_value
from rgbt.metrics import names as scores
from rgbt.metrics.scores import MEANS
from rgbt.ranges import Names, Positive, Text

# Scores that a run measures once, of its best checkpoint.
FINAL_METRICS = [
    scores.consistency(score, protocol)
    for score in (scores.TC, scores.CA)
    for protocol in ("aligned", "released")
]

# Launchers that a sweep works with.
WORKING = ("basic", "submitit_local", "submitit_slurm", "ray")


@dataclass(frozen=True)
class Objective:
    """Names one number that a search optimizes.

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
            raise InputError(
                f"objective '{self.metric}': val/<score> or test/<score>; "
                f"{nearest(score, known)}, region/<n>, class/<name>."
            )

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


@dataclass(frozen=True, kw_only=True)
class SweepSettings:
    """See ``conf/hydra/sweeper/study.yaml``, which explains every key and holds the defaults.

    `launcher` is the choice of ``hydra/launcher``, and `launcher_options` are its settings.
    """

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
    launcher: Text = "basic"
    launcher_options: dict[str, Any] = field(default_factory=dict)


# Keys whose interpolations (``${px:64}``) are resolved by the runs -> what null stands for.
UNRESOLVED: dict[str, Any] = {"space": {}, "params": {}, "points": []}


def read_settings(node: DictConfig) -> SweepSettings:
    """Return the settings of the sweeper and of the launcher from the node ``hydra``.

    InputError: a setting is wrong or missing, or the launcher does not work with a sweep or lacks
    a package.
    """
    name = node.runtime.choices["hydra/launcher"]
    if name not in WORKING:
        hint = f" ({LAUNCHERS[name]})" if name in LAUNCHERS else ""
        raise InputError(f"hydra/launcher={name}: a sweep works with {', '.join(WORKING)}{hint}.")
    if name == "ray" and find_spec("ray") is None:
        raise InputError("hydra/launcher=ray: it needs pip install 'rgbt[ray]'.")
    options = cast("dict[str, Any]", OmegaConf.to_container(node.launcher, resolve=True))
    options.pop("_target_", None)
    plain: dict[str, Any] = {}
    unresolved = OmegaConf.to_container(node.sweeper, resolve=False)
    assert isinstance(unresolved, dict), "the node of a sweeper is a mapping"
    for key in (str(key) for key in unresolved if key not in ("_target_", "_recursive_")):
        value = node.sweeper[key]
        if key in UNRESOLVED:
            value = unresolved[key] or UNRESOLVED[key]
        elif OmegaConf.is_config(value):
            value = OmegaConf.to_container(value, resolve=True)
        plain[key] = value
    settings = cast(SweepSettings, check_value("hydra.sweeper", plain, SweepSettings))
    if not settings.wait and settings.timeout_minutes is not None:
        raise InputError(
            "hydra.sweeper.timeout_minutes needs hydra.sweeper.wait=true: the command stops the "
            "jobs. SLURM has a limit of its own, hydra.launcher.timeout_min."
        )
    if not settings.wait and name in ("basic", "submitit_local"):  # before a study is written
        raise InputError("hydra.sweeper.wait=false: runs of this machine end with the command.")
    return replace(settings, launcher=name, launcher_options=options)
