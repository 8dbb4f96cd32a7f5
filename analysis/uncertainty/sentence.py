"""A comparison in one sentence that a reviewer would accept."""

from __future__ import annotations

from analysis.uncertainty.compare import Comparison, Difference
from analysis.uncertainty.intervals import Interval
from rgbt.metrics import names


def sentence(comparison: Comparison, label_a: str, label_b: str) -> str:
    """What the first difference of a comparison says, with everything that limits it.

    Args:
        comparison: one score or more; the sentence is about the first.
        label_a: what the first method is called.
        label_b: the second.
    """
    found = comparison.differences[0]
    if found.interval is None:
        return f"{found.metric} of {label_a} and {label_b} cannot be compared: nothing to score."
    alpha = 1 - comparison.level
    is_told = found.p < alpha and 0.0 not in found.interval
    scores = f"{found.b.value:.2f} against {found.a.value:.2f}"
    evidence = (
        f"{100 * comparison.level:g} % interval of the difference {_ends(found.interval)}, "
        f"{_p(found.p)}"
    )
    basis = _basis(found, comparison)
    more = "higher" if found.value > 0 else "lower"
    size = f"{abs(found.value):.2f}{_unit(found)}"
    if is_told:
        said = f"The {found.metric} of {label_b} is {size} {more} than that of {label_a}"
        return f"{said} ({scores}; {evidence}), {basis}."
    return (
        f"A difference in {found.metric} between {label_b} and {label_a} is not shown ({scores}; "
        f"{evidence}), {basis}; with this much, one below about {found.interval.half:.2f}"
        f"{_unit(found)} cannot be seen."
    )


def _basis(found: Difference, comparison: Comparison) -> str:
    """What was drawn anew, and what was not."""
    images = f"{comparison.images} images"
    if "blocks" in comparison.said or "sequences" in comparison.said:
        images += f" in {comparison.said}"
    a, b = found.a.seeds, found.b.seeds
    trainings = f"{a} trainings each" if a == b else f"{a} and {b} trainings"
    if found.both is not None:
        return f"over {trainings} and {images}"
    if a == b == 1:
        return f"over {images}, one training each: how much trainings differ is not in it"
    return f"over {images}, {trainings}: how much trainings differ is not in it"


def _ends(interval: Interval) -> str:
    return f"{interval.low:+.2f} to {interval.high:+.2f}"


def _p(value: float) -> str:
    return "p < 0.001" if value < 0.001 else f"p = {value:.3f}"


def _unit(found: Difference) -> str:
    is_variance = found.metric.endswith(names.VAR)
    return "" if is_variance else " points"
