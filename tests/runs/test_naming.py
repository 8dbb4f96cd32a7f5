"""What a run is called, and which group it belongs to."""

from __future__ import annotations

from dataclasses import replace

import pytest

from rgbt.checks import InputError
from rgbt.runs.naming import VARIED, describe, short_word, tags_from_environment
from tests.composed import specified

SIGMA, STEPS = "masker.sigma_div=2", "trainer.max_steps=4"


@pytest.mark.parametrize(
    ("words", "varied", "name", "group"),
    [
        ((), "", "grbm · s0", "grbm"),
        ((SIGMA,), "", "σ 2 · s0 · grbm", f"grbm {SIGMA}"),
        # Of a point of a sweep, what it does not vary is last; the group is in typed order.
        (
            *((STEPS, SIGMA), "masker.sigma_div seed"),
            *("σ 2 · s0 · grbm · max_steps 4", f"grbm {STEPS} {SIGMA}"),
        ),
        ((STEPS,), "experiment seed", "grbm · s0 · max_steps 4", f"grbm {STEPS}"),
        ((STEPS,), "seed", "grbm · s0 · max_steps 4", f"grbm {STEPS}"),
        (("masker=irm", "~masker.ratio"), "", None, "grbm masker=irm ~masker.ratio"),
        # The last of two values, and the value of a reference; images are half as large as paper's.
        (("optimizer.lr=1", "optimizer.lr=2"), "", None, "grbm optimizer.lr=2"),
        (("masker.patch_size=${px:64}",), "", None, "grbm masker.patch_size=32"),
        (("recipe.dataset='my data'",), "", "dataset my data · s0 · grbm", None),
    ],
)
def test_name_and_group(
    words: tuple[str, ...], varied: str, name: str | None, group: str | None
) -> None:
    typed = ("+experiment=x", "runs_dir=x", "tracking=none", "seed=0", *words)
    spec = replace(specified(("+experiment=grbm",)), overrides=typed)
    found = describe(spec, {VARIED: varied} if varied else {})
    assert found.name == (name or found.name)
    assert found.tags["rgbt.group"] == (group or found.tags["rgbt.group"])


def test_what_a_search_varies_is_named_first_with_three_digits() -> None:
    sigma = "masker.sigma_div=1.2227708767423853"
    drawn = (sigma, "masker.patch_size=8", "loss.spatial.alpha=1.1111")
    keys = " ".join(word.partition("=")[0] for word in drawn)
    spec = replace(specified(("+experiment=grbm",)), overrides=("seed=0", STEPS, *drawn))
    found = describe(spec, {VARIED: keys})
    assert found.name == "σ 1.22 · patch 8 · α 1.11 · s0 · grbm · max_steps 4"
    assert found.tags["rgbt.group"] == f"grbm {STEPS} {' '.join(drawn)}", "the tag has all digits"
    chosen = dict(word.split("=") for word in drawn)
    assert found.params == {**chosen, "name": "grbm", "seed": "0"}, "no constants"


@pytest.mark.parametrize(
    ("word", "shown"),
    [
        ("optimizer.lr=0.00012345", "lr 0.000123"),
        ("trainer.max_steps=123456", "max_steps 123456"),
        ("+debug=smoke", "smoke"),
        ("masker=none", "masker none"),
        ("~masker.ratio", "~masker.ratio"),
        ("loss.spatial.alpha=-0.5555", "α -0.555"),
        ("optimizer.lr=1.23456e-05", "lr 1.23e-05"),
        ("recipe.dataset=2024_11", "dataset 2024_11"),
        ("teacher.run=2062320e7012", "run 2062320e7012"),
    ],
)
def test_word_for_people(word: str, shown: str) -> None:
    assert short_word(word) == shown


def test_tags_of_the_environment_are_json(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RGBT_TAGS", '{"ticket": 42}')
    assert tags_from_environment() == {"ticket": "42"}
    monkeypatch.setenv("RGBT_TAGS", "[1]")
    with pytest.raises(InputError, match="RGBT_TAGS"):
        tags_from_environment()
