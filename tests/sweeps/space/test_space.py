"""Points in Hydra's order, ranges of a search, and values that reach Hydra unchanged."""

from __future__ import annotations

import json
import random
from typing import Any

import optuna
import pytest
from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra._internal.utils import create_config_search_path
from hydra.core.override_parser.overrides_parser import OverridesParser
from optuna.distributions import CategoricalDistribution, FloatDistribution, IntDistribution

from rgbt.checks import InputError
from rgbt.config.compose import conf_dir
from sweeps.space import (
    as_overrides,
    grid_points,
    list_points,
    merge_space,
    parse_space,
    split,
)

LOADER = ConfigLoaderImpl(config_search_path=create_config_search_path(str(conf_dir())))
FLOAT = {"type": "float", "low": 0.5, "high": 32, "log": True}
LOSS = {"type": "categorical", "choices": ["set_criterion", "set_criterion_spatial"]}
SPACE = {
    "masker.sigma_div": FLOAT,
    "loss": LOSS,
    "cells": {"type": "int", "low": 2, "high": 8, "step": 3},
}


def read_back(override: str) -> Any:
    return OverridesParser.create().parse_override(override).value()


@pytest.mark.parametrize(
    "overrides",
    [
        ["+experiment=grbm", "masker.sigma_div=1,2,4", "seed=0,1,2"],
        ["seed=range(1,4)", "+experiment=grbm,crm", "optimizer.lr=choice(1e-4,0.5)"],
        ["a=range(0.5,2,0.5)", "b=sort(3,1,2)", "c=str(choice(1,2))"],
        ["metric=glob(ring*)", "model.fresh=[a,b],[c]", "name='a, b',c d"],
        ["seed=0,1", "x=1", "seed=5,6", "x=2,3"],
        ["x=null,true,'true',${seed}"],
        ["seed=3"],
    ],
    ids=" ".join,
)
def test_grid_points_are_hydras_in_hydras_order(overrides: list[str]) -> None:
    fixed, swept, intervals = split(overrides, LOADER)
    found = [set(point.overrides) for point in grid_points(fixed, swept)]
    parsed = OverridesParser.create(LOADER).parse_overrides(overrides)
    assert found == [set(point) for point in BasicSweeper.split_arguments(parsed, None)[0]]
    assert intervals == {}


def test_split_intervals_are_entries_of_a_space() -> None:
    words = ["a=interval(0.5,4)", "b=tag(log,interval(1,8))", "c=int(interval(1,8))", "seed=0,1"]
    fixed, swept, intervals = split(words, LOADER)
    assert (fixed, swept) == ((), {"seed": ["0", "1"]})
    assert parse_space(intervals) == {
        "a": FloatDistribution(0.5, 4.0),
        "b": FloatDistribution(1.0, 8.0, log=True),
        "c": IntDistribution(1, 8),
    }


@pytest.mark.parametrize(
    "override", ["seed=range(3,1)", "model=glob(nothing*)", "a=tag(lgo,interval(1,2))"]
)
def test_split_sweep_that_means_nothing_raises(override: str) -> None:
    with pytest.raises(InputError) as told:
        split([override], LOADER)
    assert f"'{override}'" in str(told.value)


def test_list_points_go_in_pairs_and_replace_fixed() -> None:
    points = list_points(
        [["masker.sigma_div=1", "masker.patch_size=8"], ["experiment=crm", "~x"]],
        ["+experiment=grbm", "seed=1"],
    )
    assert [point.params for point in points] == [
        {"masker.sigma_div": 1, "masker.patch_size": 8},
        {"experiment": "crm"},
    ]
    assert points[0].overrides[:2] == ("+experiment=grbm", "seed=1")
    assert points[1].overrides == ("seed=1", "experiment=crm", "~x")
    with pytest.raises(InputError, match="hydra.sweeper.points: 'seed=0,1'"):
        list_points([["seed=0,1"]], [])


@pytest.mark.parametrize(
    ("entry", "key"),
    [
        ({"type": "flaot"}, "k.type"),
        ({**FLOAT, "hihg": 3}, "k.hihg"),
        ({"type": "float", "low": 3, "high": 1}, "k'"),
        ({"type": "float", "low": 0, "high": float("nan")}, "k.high"),
        ({"type": "int", "low": 0.5, "high": 2}, "k.low"),
        ({"type": "categorical", "choices": [1, 2.5, True]}, "k.choices"),
        ({"type": "categorical", "choices": [[1], "[1]"]}, "k.choices"),
        ({"type": "categorical", "choices": [{"a": 1}]}, "k.choices"),
        ({"type": "categorical", "choices": [[float("nan")]]}, "k.choices"),
    ],
)
def test_parse_space_wrong_range_raises_with_key(entry: dict[str, Any], key: str) -> None:
    with pytest.raises(InputError, match=rf"hydra\.sweeper\.space\.{key}"):
        parse_space({"loss": LOSS, "k": entry})


def test_merge_space_command_line_has_priority() -> None:
    assert merge_space(SPACE, ["seed=1"], {}, {}) == parse_space(SPACE)
    ranges = {"cells": {"type": "float", "low": 1.0, "high": 2.0}}
    values = {"masker.sigma_div": ["1", "2.5"], "seed": ["0", "1"]}
    found = merge_space(SPACE, ["loss=set_criterion"], values, ranges)
    assert list(found) == ["masker.sigma_div", "cells", "seed"]
    assert found["masker.sigma_div"] == CategoricalDistribution((1, 2.5))
    assert found["cells"] == FloatDistribution(1.0, 2.0)


def test_trial_of_space_has_types_steps_and_lists() -> None:
    choices = [[48, 64], [96, 128]]
    space = parse_space({**SPACE, "scale.crop_hw": {"type": "categorical", "choices": choices}})
    trial = optuna.create_study(sampler=optuna.samplers.RandomSampler(seed=0)).ask(dict(space))
    values = trial.params
    assert trial.distributions == space
    assert type(values["masker.sigma_div"]) is float
    assert values["cells"] in (2, 5, 8)
    assert read_back(as_overrides(values)[-1]) in choices


@pytest.mark.parametrize(
    ("value", "text"),
    [
        ("${px:64}", "${px:64}"),
        ("1", "'1'"),
        ("choice(1,2)", "'choice(1,2)'"),
        (None, "null"),
        (True, "true"),
        (3.0, "3.0"),
        (0.1 + 0.2, "0.30000000000000004"),
        ([1, "b, c", None, [2.5, False]], "[1,'b, c',null,[2.5,false]]"),
    ],
)
def test_as_overrides_is_read_back_by_hydra(value: object, text: str) -> None:
    (override,) = as_overrides({"some.key": value})
    assert override == f"some.key={text}"
    assert json.dumps(read_back(override)) == json.dumps(value)  # tells 1, 1.0 and true apart


def test_as_overrides_any_text_is_read_back() -> None:
    draw = random.Random(0)
    letters = "ab1. ,:=()]{}'\"\\$\t\n#~+-é%@/*null"
    for _ in range(300):
        text = "".join(draw.choice(letters) for _ in range(draw.randint(0, 6)))
        single, listed = as_overrides({"x": text, "y": [text, text]})
        assert read_back(single) == text
        assert read_back(listed) == [text, text]
