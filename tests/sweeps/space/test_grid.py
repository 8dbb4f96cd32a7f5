"""Grids and lists in Hydra's order, ranges, and a search file changed by the command line."""

from __future__ import annotations

from collections.abc import Sequence

import optuna
import pytest
from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra._internal.utils import create_config_search_path
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import OmegaConf

from rgbt.checks import InputError
from rgbt.config.compose import conf_dir
from sweeps.space.grid import distributions, grid_points, list_points, merge_space, split
from sweeps.space.space import parse_space

LOADER = ConfigLoaderImpl(config_search_path=create_config_search_path(str(conf_dir())))
SPATIAL = {"loss": "set_criterion_spatial"}
SPACE = {
    "masker.sigma_div": {"type": "float", "low": 0.5, "high": 32, "log": True},
    "loss": {"type": "categorical", "choices": ["set_criterion", "set_criterion_spatial"]},
    "alpha": {"type": "float", "low": 0, "high": 3, "when": SPATIAL},
    "focus": {"type": "categorical", "choices": ["edge", "center"], "when": SPATIAL},
    "deep": {"type": "int", "low": 0, "high": 1, "when": {"focus": "center"}},
}


def hydras_points(overrides: Sequence[str]) -> list[set[str]]:
    parsed = OverridesParser.create(LOADER).parse_overrides(list(overrides))
    (batch,) = BasicSweeper.split_arguments(parsed, None)
    return [set(point) for point in batch]


@pytest.mark.parametrize(
    "overrides",
    [
        ["+experiment=grbm", "masker.sigma_div=1,2,4", "seed=0,1,2"],
        ["seed=range(1,4)", "+experiment=grbm,crm", "optimizer.lr=choice(1e-4,0.5)"],
        ["a=range(0.5,2,0.5)", "b=sort(3,1,2)", "c=str(choice(1,2))"],
        ["metric=glob(ring*)", "model.fresh=[a,b],[c]", "name='a, b',c d"],
        ["seed=0,1", "x=1", "seed=5,6", "x=2,3"],
        ["seed=0,1", "x=1", "seed=5"],
        ["x=null,true,'true',${seed}"],
        ["seed=3"],
    ],
    ids=" ".join,
)
def test_points_are_hydras_in_hydras_order(overrides: list[str]) -> None:
    fixed, swept, intervals = split(overrides, LOADER)
    points = grid_points(fixed, swept)
    assert [set(point.overrides) for point in points] == hydras_points(overrides)
    assert intervals == {}


def test_intervals_are_entries_of_a_space() -> None:
    fixed, swept, intervals = split(
        ["a=interval(0.5,4)", "b=tag(log,interval(1,8))", "c=int(interval(1,8))", "seed=0,1"],
        LOADER,
    )
    assert (fixed, swept) == ((), {"seed": ["0", "1"]})
    assert intervals == {
        "a": {"type": "float", "low": 0.5, "high": 4.0, "log": False},
        "b": {"type": "float", "low": 1.0, "high": 8.0, "log": True},
        "c": {"type": "int", "low": 1, "high": 8, "log": False},
    }
    assert isinstance(intervals["c"]["low"], int)


@pytest.mark.parametrize(
    ("override", "sentence"),
    [
        ("seed=range(3,1)", "'seed=range(3,1)' has no values"),
        ("model=glob(nothing*)", "has no values"),
        ("a=tag(lgo,interval(1,2))", "tag 'lgo' is unknown; did you mean 'log'?"),
        ("a=tag(log,choice(1,2))", "only interval() has tags"),
    ],
)
def test_sweeps_that_mean_nothing_are_refused(override: str, sentence: str) -> None:
    with pytest.raises(InputError) as told:
        split([override], LOADER)
    assert sentence in str(told.value)


def test_lists_go_in_pairs() -> None:
    points = list_points(
        [["masker.sigma_div=1", "masker.patch_size=8"], ["masker.sigma_div=4"]],
        ["+experiment=grbm", "seed=1"],
    )
    assert [point.params for point in points] == [
        {"masker.sigma_div": 1, "masker.patch_size": 8},
        {"masker.sigma_div": 4},
    ]
    assert points[1].overrides == ("+experiment=grbm", "seed=1", "masker.sigma_div=4")


def test_override_of_a_point_replaces_the_fixed_one() -> None:
    (point,) = list_points([["experiment=crm"]], ["+experiment=grbm", "seed=1"])
    assert point.overrides == ("seed=1", "experiment=crm")


@pytest.mark.parametrize(
    ("point", "sentence"),
    [(["seed=0,1"], "'seed=0,1' has several values"), ([], "needs at least one override")],
)
def test_a_point_of_a_list_is_one_point(point: list[str], sentence: str) -> None:
    with pytest.raises(InputError, match=sentence):
        list_points([["seed=3"], point], [])


def test_optuna_can_draw_a_grid() -> None:
    _, swept, _ = split(["n=1,2", "f=1,2.5", "b=true,false", "l=[1,2],[3]", "m=x,null"], LOADER)
    points = grid_points((), swept)
    found = distributions(points)
    assert found == {
        "n": optuna.distributions.IntDistribution(1, 2),
        "f": optuna.distributions.FloatDistribution(1.0, 2.5),
        "b": optuna.distributions.CategoricalDistribution((True, False)),
        "l": optuna.distributions.CategoricalDistribution(("[1,2]", "[3]")),
        "m": optuna.distributions.CategoricalDistribution(("x", None)),
    }
    study = optuna.create_study()
    for point in points:
        study.add_trial(
            optuna.create_trial(params=dict(point.params), distributions=found, value=0)
        )
    assert [trial.params for trial in study.trials] == [point.params for point in points]


def test_without_overrides_the_file_is_unchanged() -> None:
    node = OmegaConf.create(SPACE)
    assert merge_space(node, ["seed=1"], {}, {}) == parse_space(SPACE)


def test_values_and_ranges_replace_an_entry_in_its_place() -> None:
    found = merge_space(
        SPACE,
        [],
        {"masker.sigma_div": ["1", "2.5"], "seed": ["0", "1"]},
        {"alpha": {"type": "float", "low": 1.0, "high": 2.0, "log": False}},
    )
    assert [one.key for one in found] == [*SPACE, "seed"]
    sigma, _, alpha, *_ = found
    assert (sigma.type, sigma.choices) == ("categorical", (1, 2.5))
    assert (alpha.low, alpha.high) == (1.0, 2.0)
    assert alpha.when == (("loss", ("set_criterion_spatial",)),)


def test_a_fixed_key_is_not_searched() -> None:
    found = merge_space(SPACE, ["masker.sigma_div=4", "alpha=2"], {}, {})
    assert [one.key for one in found] == ["loss", "focus", "deep"]


@pytest.mark.parametrize(
    ("fixed", "left"),
    [
        ("loss=set_criterion", ["masker.sigma_div"]),
        ("loss=set_criterion_spatial", ["masker.sigma_div", "alpha", "focus", "deep"]),
        ("focus=edge", ["masker.sigma_div", "loss", "alpha"]),
        ("focus=center", ["masker.sigma_div", "loss", "alpha", "deep"]),
    ],
)
def test_a_fixed_key_decides_the_conditions_on_it(fixed: str, left: list[str]) -> None:
    assert [one.key for one in merge_space(SPACE, [fixed], {}, {})] == left


def test_merge_space_invalid_file_raises_despite_override() -> None:
    wrong = {**SPACE, "masker.sigma_div": {"type": "flaot"}}
    with pytest.raises(InputError, match="did you mean 'float'"):
        merge_space(wrong, ["masker.sigma_div=4"], {}, {})
