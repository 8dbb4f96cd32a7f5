"""A comparison in one sentence that a reviewer would accept."""

from __future__ import annotations

from analysis.uncertainty.compare import Comparison, Difference
from analysis.uncertainty.intervals import Interval
from rgbt.metrics import names
from rgbt.metrics.named import parse


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
    if found.value == 0 and found.interval.half == 0:
        return (
            f"{label_a} and {label_b} have the same {found.metric}, {found.a.value:.2f}, on every "
            f"draw of the {comparison.images} images."
        )
    alpha = 1 - comparison.level
    is_told = found.p < alpha and 0.0 not in found.interval
    scores = f"{found.b.value:.2f} against {found.a.value:.2f}"
    evidence = (
        f"{100 * comparison.level:g} % interval of the difference {_ends(found.interval)}, "
        f"{_p(found.p)}"
    )
    basis, limit = _basis(found, comparison), _limit(found)
    start = f"As trained here, the {found.metric}" if limit else f"The {found.metric}"
    more = "higher" if found.value > 0 else "lower"
    size = f"{abs(found.value):.2f}{_unit(found)}"
    if is_told:
        said = f"{start} of {label_b} is {size} {more} than that of {label_a}"
        return f"{said} ({scores}; {evidence}), {basis}{limit}{_corrected(found, comparison)}."
    here = "As trained here, a" if limit else "A"
    return (
        f"{here} difference in {found.metric} between {label_b} and {label_a} is not shown "
        f"({scores}; {evidence}), {basis}{limit}; {_unseen(found, found.interval)}."
    )


def _unseen(found: Difference, interval: Interval) -> str:
    """How large a difference had to be; or that interval and test say two things."""
    if 0.0 not in interval:
        return "the interval leaves 0 out, the exchange test does not confirm it"
    return f"with this much, one below about {interval.half:.2f}{_unit(found)} cannot be seen"


def _basis(found: Difference, comparison: Comparison) -> str:
    """What was drawn anew."""
    images = f"{comparison.images} images"
    if "blocks" in comparison.said or "sequences" in comparison.said:
        images += f" in {comparison.said}"
    return f"over {images}" if found.both is None else f"over {_trainings(found)} and {images}"


def _limit(found: Difference) -> str:
    """What was not drawn anew and may be all there is to the difference."""
    if found.both is not None:
        return ""
    return f"; with {_trainings(found)}, it says nothing about other trainings of the two"


def _corrected(found: Difference, comparison: Comparison) -> str:
    """The p-value among all that were compared, where that is another one."""
    count = len(comparison.differences)
    if count == 1:
        return ""
    return f"; corrected for all {count} scores compared, {_p(found.p_corrected)}"


def _trainings(found: Difference) -> str:
    a, b = found.a.seeds, found.b.seeds
    if a == b:
        return "one training each" if a == 1 else f"{a} trainings each"
    return f"{a} and {b} trainings"


def _ends(interval: Interval) -> str:
    return f"{interval.low:+.2f} to {interval.high:+.2f}"


def _p(value: float) -> str:
    return "p < 0.001" if value < 0.001 else f"p = {value:.3f}"


def _unit(found: Difference) -> str:
    is_variance = parse(found.metric).score == names.VAR
    return "" if is_variance else " points"
