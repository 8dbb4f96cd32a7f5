"""A comparison in one sentence, with its evidence and its limits."""

from __future__ import annotations

from analysis.uncertainty.estimates import Comparison
from rgbt.metrics import names
from rgbt.metrics.named import parse


def sentence(comparison: Comparison, label_a: str, label_b: str) -> str:
    """The first difference of a comparison as a sentence, with everything that limits it."""
    found = comparison.differences[0]
    metric, difference, interval = found.metric, found.difference, found.interval
    if interval is None:
        return f"{metric} of {label_a} and {label_b} cannot be compared: nothing to score."
    images = f"{comparison.images} images"
    if found.value == 0 and interval.half == 0:
        same = f"{label_a} and {label_b} have the same {metric}, {found.a.value:.2f}"
        return f"{same}, on every draw of the {images}."
    if "blocks" in comparison.said or "sequences" in comparison.said:
        images += f" in {comparison.said}"
    trainings = f"{found.a.seeds} and {found.b.seeds} trainings"
    if found.a.seeds == found.b.seeds:
        trainings = f"{found.a.seeds} trainings each" if found.a.seeds > 1 else "one training each"
    # What was not drawn anew and may be all there is to the difference.
    start, basis = "As trained here, ", f"over {images}; with {trainings}, it says nothing about"
    basis += " other trainings of the two"
    if difference.both is not None:
        start, basis = "", f"over {trainings} and {images}"
    p, ends = _p(difference.p), f"{interval.low:+.2f} to {interval.high:+.2f}"
    evidence = (
        f"({found.b.value:.2f} against {found.a.value:.2f}; {100 * comparison.level:g} % interval "
        f"of the difference {ends}, {p})"
    )
    unit = "" if parse(metric).score == names.VAR else " points"
    if difference.p < 1 - comparison.level and 0.0 not in interval:
        more = f"{abs(found.value):.2f}{unit} {'higher' if found.value > 0 else 'lower'}"
        said = f"{start}the {metric} of {label_b} is {more} than that of {label_a} {evidence}"
        count = len(comparison.differences)
        corrected = f"corrected for all {count} scores compared, {_p(found.p_corrected)}"
        end = f"; {corrected}" if count > 1 else ""
    else:
        said = f"{start}a difference in {metric} between {label_b} and {label_a} is not shown"
        said += f" {evidence}"
        end = f"; this data shows only differences above about {interval.half:.2f}{unit}"
    return f"{said[0].upper()}{said[1:]}, {basis}{end}."


def _p(value: float) -> str:
    return "p < 0.001" if value < 0.001 else f"p = {value:.3f}"
