"""Typed settings that other settings leave without effect are reported."""

from __future__ import annotations

import pytest

from rgbt.config.compose import compose
from rgbt.spec.unused import unused_sentences

EMA = "trainer.ema_decay=0.9"
CASES = {
    "average": ((EMA,), EMA),
    "other average": ((EMA, "trainer.averaging=last"), EMA),
    "used": ((EMA, "trainer.averaging=ema"), None),
    "recipe": (("recipe.lr=0.1",), "recipe.lr=0.1"),
    "recipe of demo": (("recipe.demo_steps=3",), None),
    "a whole recipe": (("scale=paper", "recipe=kp"), None),
    "read by code": (("recipe.dataset=kp",), None),
    "recipe of paper": (("scale=paper", "recipe.lr=0.1"), None),
}


@pytest.mark.parametrize(("typed", "unused"), CASES.values(), ids=CASES)
def test_unused_setting_is_named_in_one_sentence(typed: tuple[str, ...], unused: str) -> None:
    words = ("+experiment=mfnet", *typed)
    found = list(unused_sentences(compose(words), words))
    assert [sentence.partition(" has no effect ")[0] for sentence in found] == [
        *([unused] if unused else [])
    ]
