"""The sentence of a comparison, in all its forms."""

from __future__ import annotations

import math
from typing import Any

import pytest

from analysis.uncertainty import Comparison, Difference, Estimate, Interval, sentence
from analysis.uncertainty.contrasts import Evidence


def side(value: float, seeds: int, said: str = "", **values: Any) -> Estimate:
    found = {"images": None, "trainings": None, "both": None, "p": math.nan, **values}
    evidence = Evidence(values=(value,), seeds=(), error=math.nan, blocks=393, said=said)
    return Estimate(value=value, sd=0.3, seeds=seeds, evidence=evidence, **found)


@pytest.mark.parametrize(
    ("metric", "values", "seeds", "said", "level", "words"),
    [
        (
            *("mIoU", (61.8, 62.9, 0.0123, (0.31, 1.94)), (1, 1), "393 single images", 0.95),
            "As trained here, the mIoU of GRBM is 1.10 points higher than that of CRM (62.90 "
            "against 61.80; 95 % interval of the difference +0.31 to +1.94, p = 0.012), over 393 "
            "images; with one training each, it says nothing about other trainings of the two.",
        ),
        (
            *("Var", (50.0, 38.5, 0.0004, (-20.0, 3.0), (-16.0, -7.0)), (3, 3), "40 blocks", 0.95),
            "The Var of GRBM is 11.50 lower than that of CRM (38.50 against 50.00; 95 % interval "
            "of the difference -16.00 to -7.00, p < 0.001), over 3 trainings each and 393 images "
            "in 40 blocks.",
        ),
        (
            *("mIoU", (61.8, 62.1, 0.51, (0.1, 0.5), (-0.9, 1.5)), (3, 2), "393 single", 0.95),
            "A difference in mIoU between GRBM and CRM is not shown (62.10 against 61.80; 95 % "
            "interval of the difference -0.90 to +1.50, p = 0.510), over 3 and 2 trainings and 393 "
            "images; this data shows only differences above about 1.20 points.",
        ),
        (
            *("night/Var", (40.0, 42.0, 0.4, (-3.0, 7.0)), (3, 1), "12 sequences", 0.9),
            "As trained here, a difference in night/Var between GRBM and CRM is not shown (42.00 "
            "against 40.00; 90 % interval of the difference -3.00 to +7.00, p = 0.400), over 393 "
            "images in 12 sequences; with 3 and 1 trainings, it says nothing about other trainings "
            "of the two; this data shows only differences above about 5.00.",
        ),
        # p and the interval have to agree.
        ("mIoU", (61.0, 62.0, 0.06, (0.1, 2.0)), (1, 1), "", 0.95, "is not shown"),
        ("mIoU", (61.0, 62.0, 0.03, (-0.1, 2.0)), (1, 1), "", 0.99, "is not shown"),
        ("class/Var", (61.0, 63.0, 0.01, (1.0, 3.0)), (1, 1), "", 0.95, "2.00 points higher"),
        ("mIoU", (61.0, 61.0, 1.0, (0.0, 0.0)), (1, 1), "", 0.95, "have the same mIoU, 61.00, on"),
        (
            *("class/cone", (math.nan, math.nan, math.nan), (1, 1), "", 0.95),
            "class/cone of CRM and GRBM cannot be compared: nothing to score.",
        ),
    ],
)
def test_sentence(
    metric: str,
    values: tuple[Any, ...],
    seeds: tuple[int, int],
    said: str,
    level: float,
    words: str,
) -> None:
    a, b, p, *ends = values
    images, both = [*(Interval(*pair) for pair in ends), None, None][:2]
    difference = side(b - a, 1, said, images=images, both=both, p=p)
    sides = {"a": side(a, seeds[0]), "b": side(b, seeds[1])}
    found = Difference(metric=metric, difference=difference, **sides)
    comparison = Comparison(differences=(found,), images=393, partition="ring5", level=level)
    text = sentence(comparison, "CRM", "GRBM")
    assert text == words if words.endswith(".") else words in text
