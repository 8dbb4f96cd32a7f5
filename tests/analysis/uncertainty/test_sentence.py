"""The sentence of a comparison, in all its forms."""

from __future__ import annotations

import math

import pytest

from analysis.uncertainty import Comparison, Difference, Estimate, Interval
from analysis.uncertainty.contrasts import Evidence
from analysis.uncertainty.sentence import sentence


def side(value: float, seeds: int, said: str = "", **values) -> Estimate:
    found = {"images": None, "trainings": None, "both": None, "p": math.nan, **values}
    evidence = Evidence(values=(value,), seeds=(), error=math.nan, blocks=393, said=said)
    return Estimate(value=value, sd=0.3, seeds=seeds, evidence=evidence, **found)


def compared(metric: str, a: float, b: float, **values) -> Comparison:
    seeds = values.pop("seeds", (1, 1))
    said = values.pop("said", "393 single images")
    level = values.pop("level", 0.95)
    difference = side(b - a, 1, said, **values)
    found = Difference(
        metric=metric, a=side(a, seeds[0]), b=side(b, seeds[1]), difference=difference
    )
    return Comparison(differences=(found,), images=393, partition="ring5", level=level)


def test_difference_shown_over_images():
    found = compared("mIoU", 61.8, 62.9, p=0.0123, images=Interval(0.31, 1.94))
    assert sentence(found, "CRM", "GRBM") == (
        "As trained here, the mIoU of GRBM is 1.10 points higher than that of CRM (62.90 against "
        "61.80; 95 % interval of the difference +0.31 to +1.94, p = 0.012), over 393 images; with "
        "one training each, it says nothing about other trainings of the two."
    )


def test_difference_shown_over_images_and_seeds_in_blocks():
    found = compared(
        *("Var", 50.0, 38.5),
        images=Interval(-20.0, 3.0),
        both=Interval(-16.0, -7.0),
        p=0.0004,
        seeds=(3, 3),
        said="40 blocks of up to 10 neighbouring frames",
    )
    assert sentence(found, "CRM", "GRBM") == (
        "The Var of GRBM is 11.50 lower than that of CRM (38.50 against 50.00; 95 % interval of "
        "the difference -16.00 to -7.00, p < 0.001), over 3 trainings each and 393 images in 40 "
        "blocks of up to 10 neighbouring frames."
    )


def test_difference_not_shown_over_images_and_seeds():
    found = compared(
        *("mIoU", 61.8, 62.1),
        images=Interval(0.1, 0.5),
        both=Interval(-0.9, 1.5),
        p=0.51,
        seeds=(3, 2),
    )
    assert sentence(found, "CRM", "GRBM") == (
        "A difference in mIoU between GRBM and CRM is not shown (62.10 against 61.80; 95 % "
        "interval of the difference -0.90 to +1.50, p = 0.510), over 3 and 2 trainings and 393 "
        "images; this data shows only differences above about 1.20 points."
    )


def test_difference_not_shown_for_variance_at_night():
    found = compared(
        *("night/Var", 40.0, 42.0),
        p=0.4,
        images=Interval(-3.0, 7.0),
        seeds=(3, 1),
        said="12 sequences",
        level=0.9,
    )
    assert sentence(found, "CRM", "GRBM") == (
        "As trained here, a difference in night/Var between GRBM and CRM is not shown (42.00 "
        "against 40.00; 90 % interval of the difference -3.00 to +7.00, p = 0.400), over 393 "
        "images in 12 sequences; with 3 and 1 trainings, it says nothing about other trainings of "
        "the two; this data shows only differences above about 5.00."
    )


@pytest.mark.parametrize(("p", "low", "level"), [(0.06, -0.1, 0.95), (0.03, -0.1, 0.99)])
def test_difference_is_shown_if_p_and_interval_agree(p: float, low: float, level: float):
    found = compared("mIoU", 61.0, 62.0, p=p, images=Interval(low, 2.0), level=level)
    assert "is not shown" in sentence(found, "a", "b")


def test_a_class_called_var_is_no_variance():
    found = compared("class/Var", 61.0, 63.0, p=0.01, images=Interval(1, 3))
    assert "2.00 points higher" in sentence(found, "a", "b")


def test_nothing_to_score():
    found = compared("class/cone", math.nan, math.nan, p=math.nan)
    assert sentence(found, "CRM", "GRBM") == (
        "class/cone of CRM and GRBM cannot be compared: nothing to score."
    )
