"""The factors of a scene as keywords of the functions that make data sets of them."""

from __future__ import annotations

import inspect
import typing
from dataclasses import fields

import pytest

from rgbt.data.synth.factors import NEUTRAL, SceneFactors, with_factors


def plain(*, seed: int = 3, factors: SceneFactors) -> tuple[int, SceneFactors]:
    return seed, factors


made = with_factors("night_share", height=96)(plain)


def test_signature_has_factors_with_types_and_defaults() -> None:
    parameters = inspect.signature(made).parameters
    names = {factor.name for factor in fields(SceneFactors)} - {"night_share"}
    assert set(parameters) == {"seed"} | (names - NEUTRAL)
    calibrated = with_factors("night_share", calibrated=True)(plain)
    assert set(inspect.signature(calibrated).parameters) == {"seed"} | names
    assert (parameters["height"].default, parameters["width"].default) == (96, 160)
    hints = typing.get_type_hints(made)
    assert (hints["height"], hints["rgb_noise"], hints["seed"]) == (int, float, int)
    assert set(hints) == set(parameters) | {"return"}


def test_keywords_set_factors() -> None:
    assert made() == (3, SceneFactors(height=96))
    assert made(seed=4, width=80) == (4, SceneFactors(height=96, width=80))
    with pytest.raises(TypeError, match="night_share"):
        made(night_share=0.2)
