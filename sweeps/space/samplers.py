"""Samplers and pruners of a search.

Options are those of Optuna's constructors, as far as a YAML file can hold them.
"""

from __future__ import annotations

import importlib.util
import inspect
from collections.abc import Mapping
from functools import partial
from typing import TYPE_CHECKING, Any

from rgbt.checks import InputError, check_choice, nearest

if TYPE_CHECKING:
    from optuna.pruners import BasePruner

    from sweeps.space.per_trial import PerTrialSampler

SAMPLERS = {
    "tpe": "TPESampler",
    "random": "RandomSampler",
    "gp": "GPSampler",
    "nsga2": "NSGAIISampler",
    "cmaes": "CmaEsSampler",
}
"""Samplers without state outside the storage: the others (QMC, grid, brute force) keep a counter,
which neither several drivers nor a resumed search can share. nsga2 crosses earlier points
and may propose one of them again."""

PRUNERS = {
    "none": "NopPruner",
    "median": "MedianPruner",
    "percentile": "PercentilePruner",
    "successive_halving": "SuccessiveHalvingPruner",
    "hyperband": "HyperbandPruner",
    "patient": "PatientPruner",
}
"""Pruners of a curve over steps of the optimizer. `patient` stops a trial that has not risen for
`patience` reports, whatever the other trials do."""

PLAIN: dict[str, Any] = {
    "int": int,
    "float": float,
    "bool": bool,
    "int | None": int | None,
    "float | None": float | None,
    "bool | None": bool | None,
    "str | int": str | int,
}
"""Types of options that a YAML file can hold."""

NOT_OPTIONS = (
    "seed",
    *("consider_prior", "prior_weight", "consider_magic_clip", "consider_endpoints"),
    *("sigma0", "inc_popsize"),
)
"""The seed has its own key; Optuna 6 drops the others."""


def build_sampler(node: Mapping[str, Any], objectives: int = 1) -> PerTrialSampler:
    """The sampler of a search.

    Args:
        node: its kind, one of `SAMPLERS`; its seed: one worker with the same seed proposes the same
            points, see `PerTrialSampler`; options of Optuna's constructor.
        objectives: how many numbers the search follows.

    Raises:
        InputError: unknown kind or option, an option of a wrong type or value, a missing package,
            or a sampler that cannot follow so many objectives.
    """
    import optuna

    from sweeps.space.per_trial import PerTrialSampler

    kind, options = _kind("sampler", node, SAMPLERS)
    seed = options.pop("seed", 0)
    if not isinstance(seed, int):
        raise InputError(f"hydra.sweeper.sampler.seed: expected a whole number, got {seed}.")
    if kind == "cmaes" and importlib.util.find_spec("cmaes") is None:
        raise InputError("sampler.kind=cmaes needs the package cmaes; run `pip install cmaes`.")
    if kind == "cmaes" and objectives > 1:
        raise InputError(
            f"sampler.kind=cmaes supports one objective, but this search has {objectives}; "
            "choose tpe, gp or nsga2."
        )
    make = getattr(optuna.samplers, SAMPLERS[kind])
    _check_options("sampler", kind, make, options)

    def seeded(trial_seed: int) -> optuna.samplers.BaseSampler:
        sampler: optuna.samplers.BaseSampler = make(**options, seed=trial_seed)
        return sampler

    _construct("sampler", kind, partial(seeded, 0))
    return PerTrialSampler(seeded, seed)


def build_pruner(node: Mapping[str, Any] | None, objectives: int = 1) -> BasePruner:
    """The pruner of a search; trials report at their validation steps.

    Args:
        node: its kind, one of `PRUNERS`, and options of Optuna's constructor; None: no pruner.
            Those that count steps (``n_warmup_steps``, ``min_resource``) count steps of the
            optimizer, not validations.
        objectives: how many numbers the search follows.

    Raises:
        InputError: unknown kind or option, an option of a wrong type or value or without one, or
            more than one objective.
    """
    import optuna

    kind, options = _kind("pruner", {"kind": "none"} if node is None else node, PRUNERS)
    if kind != "none" and objectives > 1:
        raise InputError(
            f"pruner.kind={kind} compares trials by one number, but this search has {objectives} "
            "objectives; set hydra.sweeper.pruner=null or use one objective."
        )
    options.pop("seed", None)
    make = getattr(optuna.pruners, PRUNERS[kind])
    fixed = {"wrapped_pruner": None} if kind == "patient" else {}
    _check_options("pruner", kind, make, options)
    pruner: BasePruner = _construct("pruner", kind, partial(make, **fixed, **options))
    return pruner


def _kind(
    what: str, node: Mapping[str, Any], known: Mapping[str, str]
) -> tuple[str, dict[str, Any]]:
    options = dict(node)
    if "kind" not in options:
        raise InputError(
            f"hydra.sweeper.{what}: 'kind' has no value; give one, such as {{kind: tpe}}."
        )
    kind = str(options.pop("kind"))
    check_choice(f"{what}.kind", kind, known)
    return kind, options


def _check_options(what: str, kind: str, make: Any, given: Mapping[str, Any]) -> None:
    """Refuse options that are not in the signature of `make`, or of another type."""
    import pydantic

    parameters = inspect.signature(make).parameters
    types = {name: one.annotation for name, one in parameters.items() if name not in NOT_OPTIONS}
    words = {n: t if isinstance(t, str) else getattr(t, "__name__", "") for n, t in types.items()}
    known = {name: PLAIN[word] for name, word in words.items() if word in PLAIN}
    for name in known:
        if parameters[name].default is inspect.Parameter.empty and name not in given:
            raise InputError(f"{what}.kind={kind} needs the option '{name}'; set {what}.{name}.")
    for name, value in given.items():
        if name not in known:
            hint = nearest(name, known) if known else "it has none"
            raise InputError(f"{what}.{name} is not an option of kind {kind}; {hint}.")
        try:
            pydantic.TypeAdapter(known[name]).validate_python(value, strict=True)
        except pydantic.ValidationError as error:
            wanted = words[name].replace("None", "null")
            raise InputError(f"{what}.{name}: expected {wanted}, got {value!r}.") from error


def _construct(what: str, kind: str, make: partial[Any]) -> Any:
    """Call `make`; values that Optuna itself refuses are the user's mistake."""
    try:
        return make()
    except ValueError as error:
        reason = str(error).rstrip(".")
        raise InputError(f"{what}.kind={kind} does not accept these options: {reason}.") from error
