"""A comparison in one sentence, with its evidence and its limits."""

from __future__ import annotations

from analysis.uncertainty.estimates import Comparison
from rgbt.metrics import names
from rgbt.metrics.named import parse


def sentence(comparison: Comparison, label_a: str, label_b: str) -> str:
    """The first difference of a comparison as a sentence, with everything that limits it.

    Args:
        comparison: one score or more; the sentence is about the first.
        label_a: name of the first method.
        label_b: name of the second method.
    """
    found = comparison.differences[0]
    if found.interval is None:
        return f"{found.metric} of {label_a} and {label_b} cannot be compared: nothing to score."
    if found.value == 0 and found.interval.half == 0:
        return (
            f"{label_a} and {label_b} have the same {found.metric}, {found.a.value:.2f}, on every "
            f"draw of the {comparison.images} images."
        )
    images = f"{comparison.images} images"
    if "blocks" in comparison.said or "sequences" in comparison.said:
        images += f" in {comparison.said}"
    seeds = found.a.seeds, found.b.seeds
    trainings = f"{seeds[0]} and {seeds[1]} trainings"
    if seeds[0] == seeds[1]:
        trainings = "one training each" if seeds[0] == 1 else f"{seeds[0]} trainings each"
    scores = f"{found.b.value:.2f} against {found.a.value:.2f}"
    p, ends = _p(found.difference.p), f"{found.interval.low:+.2f} to {found.interval.high:+.2f}"
    evidence = f"({scores}; {100 * comparison.level:g} % interval of the difference {ends}, {p})"
    # What was not drawn anew and may be all there is to the difference.
    start, basis = "As trained here, ", f"over {images}; with {trainings}, it says nothing about"
    basis += " other trainings of the two"
    if found.difference.both is not None:
        start, basis = "", f"over {trainings} and {images}"
    unit = "" if parse(found.metric).score == names.VAR else " points"
    if found.difference.p < 1 - comparison.level and 0.0 not in found.interval:
        more = "higher" if found.value > 0 else "lower"
        said = (
            f"{start}the {found.metric} of {label_b} is {abs(found.value):.2f}{unit} {more} than "
            f"that of {label_a} {evidence}, {basis}"
        )
        count = len(comparison.differences)
        if count > 1:
            said += f"; corrected for all {count} scores compared, {_p(found.p_corrected)}"
    else:
        limit = f"this data shows only differences above about {found.interval.half:.2f}{unit}"
        said = (
            f"{start}a difference in {found.metric} between {label_b} and {label_a} is not shown "
            f"{evidence}, {basis}; {limit}"
        )
    return f"{said[0].upper()}{said[1:]}."


def _p(value: float) -> str:
    return "p < 0.001" if value < 0.001 else f"p = {value:.3f}"
