"""The command line has the last word on what a search file says."""

from __future__ import annotations

import pytest
from omegaconf import OmegaConf

from rgbt.checks import InputError
from sweeps.space.merge import merge_space
from sweeps.space.space import parse_space

SPATIAL = {"loss": "set_criterion_spatial"}
SPACE = {
    "masker.sigma_div": {"type": "float", "low": 0.5, "high": 32, "log": True},
    "loss": {"type": "categorical", "choices": ["set_criterion", "set_criterion_spatial"]},
    "alpha": {"type": "float", "low": 0, "high": 3, "when": SPATIAL},
    "focus": {"type": "categorical", "choices": ["edge", "center"], "when": SPATIAL},
    "deep": {"type": "int", "low": 0, "high": 1, "when": {"focus": "center"}},
}


def test_without_a_word_the_file_stands() -> None:
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
