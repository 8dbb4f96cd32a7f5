"""Settings of a sweep: the keys of ``conf/hydra/sweeper/study.yaml``, checked."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, Any, ClassVar, Literal

from annotated_types import Interval, Len, doc
from omegaconf import DictConfig, OmegaConf

from rgbt.checks import InputError, nearest
from rgbt.config.component import build
from rgbt.metrics import names as scores
from rgbt.ranges import Names, Positive, Text

SCORES = (
    *(scores.MIOU, scores.VAR, scores.MACC, scores.MPRECISION, scores.MF1),
    *(scores.PIXEL_ACCURACY, scores.region(1), scores.class_iou("car")),
)
"""Scores of a run, with one region and one class as examples."""

AT_THE_END = tuple(
    scores.consistency(score, protocol)
    for score in (scores.TC, scores.CA)
    for protocol in ("aligned", "released")
)
"""Scores that a run measures once, of its best checkpoint."""


@dataclass(frozen=True)
class Objective:
    """One number that a search optimizes.

    Attributes:
        metric: "val/<score>" (best checkpoint on the selection split) or "test/<score>", the scores
            being those of `rgbt.metrics.names`; of two frames "val/TC/aligned" etc.
        direction: which way is better.
    """

    __pydantic_config__: ClassVar[dict[str, str]] = {"extra": "forbid"}

    metric: Text
    direction: Literal["maximize", "minimize"]

    def __post_init__(self) -> None:
        if not self.metric.startswith(("val/", "test/")):
            raise InputError(
                f"objective '{self.metric}': expected val/<score> or test/<score>, such as "
                "val/mIoU or val/Var."
            )
        score = self.metric.partition("/")[2]
        part, _, inner = score.partition("/")
        whole = inner if part in (scores.DAY, scores.NIGHT) else score
        if whole not in SCORES and score not in AT_THE_END and part not in ("region", "class"):
            known = nearest(score, (*SCORES, *AT_THE_END))
            raise InputError(f"objective '{self.metric}': {known}.")

    @property
    def is_consistency(self) -> bool:
        """Whether it is a score of two frames, which only some runs measure."""
        return self.metric.partition("/")[2] in AT_THE_END

    @property
    def is_reported(self) -> bool:
        """Whether a run reports it while it trains."""
        return self.metric.startswith("val/") and not self.is_consistency


Gpu = Annotated[int, Interval(ge=0, le=1023)]

GpuSlot = Gpu | Annotated[tuple[Gpu, ...], Len(1, 64)]
"""The GPU that a worker uses, or several for runs with `trainer.devices`."""

NumRuns = Annotated[int, Interval(ge=1, le=10**6)]


@dataclass(frozen=True, kw_only=True)
class SweepSettings:
    """See ``conf/hydra/sweeper/study.yaml``, which explains every key and holds the defaults."""

    storage: Text | None
    workers: Annotated[int, Interval(ge=1, le=1024), doc("processes at the same time")]
    gpus: Annotated[tuple[GpuSlot, ...], Len(1, 1024)] | None
    executor: Literal["local", "submitit"]
    submitit: dict[str, Any] | None
    retries: Annotated[int, Interval(ge=0, le=1000)]
    retry: Literal["none", "failed"]
    timeout_minutes: Positive | None
    max_failures: NumRuns | None
    wait: bool
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

    def __post_init__(self) -> None:
        if self.submitit and self.executor != "submitit":
            raise InputError(
                "submitit={...} has an effect only with executor=submitit; add executor=submitit."
            )
        if self.executor == "submitit" and self.timeout_minutes is not None:
            raise InputError(
                "timeout_minutes would include the time in the queue; with executor=submitit, set "
                "submitit={timeout_min: ...}."
            )


UNRESOLVED: dict[str, type] = {"space": dict, "params": dict, "points": list}
"""Keys whose interpolations (``${px:64}``) are resolved by the runs, not by the sweep."""


def read_settings(node: DictConfig) -> SweepSettings:
    """Settings from the node ``hydra.sweeper``.

    Raises:
        InputError: an unknown key, a missing one, a wrong type or value.
    """
    known = SweepSettings.__dataclass_fields__
    raw = OmegaConf.to_container(node, resolve=False)
    assert isinstance(raw, dict), "the node of a sweeper is a mapping"
    for key in raw:
        if key not in known and key != "_target_":
            raise InputError(
                f"'hydra.sweeper.{key!s}' is not a setting; {nearest(str(key), known)}."
            )
    for key in known:
        if key not in raw:
            raise InputError(
                f"'hydra.sweeper.{key}' has no value; see conf/hydra/sweeper/study.yaml."
            )
    for key, kind in UNRESOLVED.items():
        raw[key] = kind() if raw[key] is None else raw[key]
        if not isinstance(raw[key], kind):
            what = "mapping" if kind is dict else "list"
            raise InputError(f"'hydra.sweeper.{key!s}' must be a {what}, got {raw[key]!r}.")
    values = {key: node[key] for key in known if key not in UNRESOLVED}
    empty = {key: kind() for key, kind in UNRESOLVED.items()}
    own = {"_target_": "sweeps.settings.SweepSettings", **values, **empty}
    settings: SweepSettings = build(OmegaConf.create({"hydra": {"sweeper": own}}).hydra.sweeper)
    for point in raw["points"]:
        if not isinstance(point, list):
            raise InputError(
                f"hydra.sweeper.points: expected a list of lists of overrides such as "
                f"[[masker.sigma_div=1], [masker.sigma_div=4]], got {point!r} inside."
            )
    points = tuple(tuple(map(str, point)) for point in raw["points"])
    return replace(settings, space=raw["space"], params=raw["params"], points=points)
