"""Spaces: every mistake is reported, conditions hold, values reach Hydra unchanged."""

from __future__ import annotations

import json
import random
from dataclasses import dataclass
from typing import Any

import optuna
import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import OmegaConf

from rgbt.checks import InputError
from sweeps.space.space import as_overrides, parse_space, signature, suggest
from tests.models.golden import compose

FLOAT = {"type": "float", "low": 0.5, "high": 32, "log": True}
LOSS = {"type": "categorical", "choices": ["set_criterion", "set_criterion_spatial"]}
ALPHA = {"type": "float", "low": 0, "high": 3, "when": {"loss": "set_criterion_spatial"}}


def read_back(override: str) -> Any:
    return OverridesParser.create().parse_override(override).value()


def test_ranges_arrive_as_written() -> None:
    sigma, cells, rate = parse_space(
        {
            "masker.sigma_div": FLOAT,
            "cells": {"type": "int", "low": 2, "high": 8, "step": 3},
            "rate": {"type": "float", "low": 0.1, "high": 0.7, "step": 0.2},
        }
    )
    assert (sigma.low, sigma.high, sigma.log, sigma.step) == (0.5, 32.0, True, None)
    assert isinstance(sigma.high, float)
    assert (cells.low, cells.high, cells.step) == (2, 8, 3)
    assert isinstance(cells.low, int)
    assert (rate.step, rate.log) == (0.2, False)


@pytest.mark.parametrize(
    ("entry", "sentence"),
    [
        ({"type": "flaot"}, "type 'flaot' is unknown; did you mean 'float'?"),
        ({"low": 1, "high": 2}, "type 'None' is unknown"),
        ("0..1", "expected a mapping"),
        ({**FLOAT, "hihg": 3}, "'hihg' is not a key of type float; did you mean 'high'?"),
        ({**LOSS, "low": 3}, "'low' is not a key of type categorical"),
        ({"type": "float", "low": 3, "high": 1}, "low=3.0 is greater than high=1.0"),
        ({"type": "float", "low": 3}, "high must be a finite float, got None"),
        ({"type": "float", "low": "1", "high": 2}, "low must be a finite float, got '1'"),
        ({"type": "float", "low": 0, "high": float("inf")}, "high must be a finite float"),
        ({"type": "int", "low": 0.5, "high": 2}, "low must be a finite int, got 0.5"),
        ({"type": "int", "low": True, "high": 2}, "low must be a finite int, got True"),
        ({**FLOAT, "low": 0}, "low=0.0 has no logarithm"),
        ({**FLOAT, "log": "yes"}, "log must be true or false, got 'yes'"),
        ({**FLOAT, "step": 0.5}, "step and log: true exclude each other"),
        ({"type": "int", "low": 0, "high": 4, "step": 0}, "step must be positive, got 0"),
        ({"type": "int", "low": 0, "high": 4, "step": 3}, "not a whole number of steps of 3"),
        ({"type": "categorical"}, "at least one value, got None"),
        ({"type": "categorical", "choices": []}, "at least one value, got []"),
        ({"type": "categorical", "choices": [1, 2.5, True]}, "choices contain True twice"),
        ({"type": "categorical", "choices": [{"a": 1}]}, "a plain value or a list of them"),
        ({"type": "categorical", "choices": [float("nan")]}, "must be finite"),
        ({**FLOAT, "when": "loss"}, "when must be a mapping"),
        (
            {**FLOAT, "when": {"los": "x"}},
            "'los' is not a parameter above it; did you mean 'loss'?",
        ),
        ({**FLOAT, "when": {"k": 1}}, "'k' is not a parameter above it"),
        ({**FLOAT, "when": {"loss": "set_criterio"}}, "did you mean 'set_criterion'?"),
        ({**FLOAT, "when": {"n": [1, 9]}}, "'n' is never 9 but an int from 1 to 4"),
        ({**FLOAT, "when": {"f": 1.0}}, "'f' is a float"),
    ],
)
def test_a_mistake_is_one_sentence_with_the_key(entry: object, sentence: str) -> None:
    above = {"loss": LOSS, "n": {"type": "int", "low": 1, "high": 4}, "f": FLOAT}
    with pytest.raises(InputError) as told:
        parse_space({**above, "k": entry})
    assert str(told.value).startswith("search space, 'k': ")
    assert sentence in str(told.value)


def test_a_parameter_can_be_read() -> None:
    step = {"type": "int", "low": 2, "high": 8, "step": 3}
    assert [str(one) for one in parse_space({"s": FLOAT, "n": step, "loss": LOSS, "a": ALPHA})] == [
        "s: 0.5 to 32, logarithmic",
        "n: 2 to 8, in steps of 3",
        "loss: one of set_criterion set_criterion_spatial",
        "a: 0 to 3, when loss is set_criterion_spatial",
    ]


@pytest.mark.parametrize("key", ["", "a b", "~a", "a=b", "a,b"])
def test_a_key_is_the_key_of_an_override(key: str) -> None:
    with pytest.raises(InputError, match="expected a key"):
        parse_space({key: FLOAT})


def test_conditions_need_all_their_parameters() -> None:
    parameters = parse_space(
        {
            "loss": LOSS,
            "loss.spatial.alpha": ALPHA,
            "n": {"type": "int", "low": 1, "high": 4, "when": {"loss": "set_criterion_spatial"}},
            "deep": {"type": "categorical", "choices": [True, False], "when": {"n": [2, 3]}},
        }
    )

    def chosen(**fixed: object) -> list[str]:
        wanted = {**fixed, "loss.spatial.alpha": 2.0, "deep": True}
        return list(suggest(optuna.trial.FixedTrial(wanted), parameters))

    assert chosen(loss="set_criterion", n=2) == ["loss"]
    assert chosen(loss="set_criterion_spatial", n=1) == ["loss", "loss.spatial.alpha", "n"]
    assert chosen(loss="set_criterion_spatial", n=3) == [
        *("loss", "loss.spatial.alpha"),
        "n",
        "deep",
    ]


def test_lists_are_text_to_optuna_and_lists_to_hydra() -> None:
    study = optuna.create_study()
    choices = [[48, 64], [96, 128]]
    parameters = parse_space({"scale.crop_hw": {"type": "categorical", "choices": choices}})
    values = suggest(study.ask(), parameters)
    assert study.trials[0].params["scale.crop_hw"] in ("[48,64]", "[96,128]")
    assert values["scale.crop_hw"] in ((48, 64), (96, 128))
    assert read_back(as_overrides(values)[0]) in choices


@pytest.mark.parametrize(
    ("value", "text"),
    [
        ("set_criterion_spatial", "set_criterion_spatial"),
        ("${px:64}", "${px:64}"),
        ("a b", "a b"),
        ("a, b", "'a, b'"),
        ("1", "'1'"),
        ("null", "'null'"),
        ("true", "'true'"),
        ("", "''"),
        ("it's", r"'it\'s'"),
        ("choice(1,2)", "'choice(1,2)'"),
        ("~/x", "'~/x'"),
        (None, "null"),
        (True, "true"),
        (False, "false"),
        (3, "3"),
        (3.0, "3.0"),
        (0.1 + 0.2, "0.30000000000000004"),
        (1e-05, "1e-05"),
        (-1e22, "-1e+22"),
        ([], "[]"),
        ([1, "b, c", None, [2.5, False]], "[1,'b, c',null,[2.5,false]]"),
    ],
)
def test_values_are_read_back_by_hydra(value: object, text: str) -> None:
    (override,) = as_overrides({"some.key": value})
    assert override == f"some.key={text}"
    found = read_back(override)
    assert json.dumps(found) == json.dumps(value)  # tells 1, 1.0 and true apart


def test_any_text_is_read_back_by_hydra() -> None:
    draw = random.Random(0)
    letters = "ab1. ,:=()[]{}'\"\\$\t\n#~+-é%@/*null"
    for _ in range(300):
        text = "".join(draw.choice(letters) for _ in range(draw.randint(0, 6)))
        single, listed = as_overrides({"x": text, "y": [text, text]})
        assert read_back(single) == text
        assert read_back(listed) == [text, text]


def test_patch_sizes_follow_the_scale() -> None:
    """The text of the resolver survives OmegaConf, Optuna and the grammar, then is resolved."""
    entry = {"type": "categorical", "choices": ["${px:64}"]}
    node = OmegaConf.create({"masker.patch_size": entry})
    values = suggest(optuna.create_study().ask(), parse_space(node))
    overrides = as_overrides(values)
    assert overrides == ("masker.patch_size=${px:64}",)
    assert compose("+experiment=grbm", *overrides).masker.patch_size == 32
    assert compose("+experiment=grbm", "scale=paper", *overrides).masker.patch_size == 64


@dataclass
class Goal:
    metric: str


def test_signature_covers_space_and_objectives() -> None:
    space = parse_space({"a": FLOAT, "b": LOSS})
    name = signature(space, [Goal("val/mIoU")])
    assert len(name) == 12
    assert name == signature(parse_space({"b": LOSS, "a": FLOAT}), [Goal("val/mIoU")])
    assert name != signature(space, [Goal("val/Var")])
    assert name != signature(
        parse_space({"a": {**FLOAT, "high": 16}, "b": LOSS}), [Goal("val/mIoU")]
    )
