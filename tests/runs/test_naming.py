"""What a run is called, and which group it belongs to."""

from __future__ import annotations

from dataclasses import replace

import pytest

from rgbt.checks import InputError
from rgbt.runs.naming import VARIED, describe, tags_from_environment
from tests.composed import specified

SIGMA, STEPS = "masker.sigma_div=2", "trainer.max_steps=4"


@pytest.mark.parametrize(
    ("words", "varied", "name", "group"),
    [
        ((), "", "seed=0 · grbm", "grbm"),
        ((SIGMA,), "", f"{SIGMA} seed=0 · grbm", f"grbm {SIGMA}"),
        # Of a point of a sweep, what it does not vary is last; the group is in typed order.
        (
            *((STEPS, SIGMA), "masker.sigma_div seed"),
            *(f"{SIGMA} seed=0 · grbm {STEPS}", f"grbm {STEPS} {SIGMA}"),
        ),
        ((STEPS,), "experiment seed", f"grbm seed=0 · {STEPS}", f"grbm {STEPS}"),
        (("masker=irm", "~masker.ratio"), "", None, "grbm masker=irm ~masker.ratio"),
        # The last of two values, and the value of a reference; images are half as large as paper's.
        (("optimizer.lr=1", "optimizer.lr=2"), "", None, "grbm optimizer.lr=2"),
        (("masker.patch_size=${px:64}",), "", None, "grbm masker.patch_size=32"),
        (("recipe.dataset='my data'",), "", "recipe.dataset=my data seed=0 · grbm", None),
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


def test_tags_of_the_environment_are_json(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RGBT_TAGS", '{"ticket": 42}')
    assert tags_from_environment() == {"ticket": "42"}
    monkeypatch.setenv("RGBT_TAGS", "[1]")
    with pytest.raises(InputError, match="RGBT_TAGS"):
        tags_from_environment()
