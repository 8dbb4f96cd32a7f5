"""Which seeds judge a claim and by which rule; its words, its size; what is judged once."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import pytest

from analysis.uncertainty.contrasts import FIXED
from analysis.uncertainty.intervals import Interval
from analysis.uncertainty.verdicts import Verdict
from sweeps.judge.judged_claim import JudgedClaim, are_of_paper
from sweeps.plan.claim import Claim
from sweeps.plan.request import RowSeed
from sweeps.plan.table import Column, Row
from sweeps.point import Outcome
from sweeps.score.reader import Origin, RunReader
from tests.sweeps.judge.accuracies import accuracy, judged
from tests.sweeps.tabled import outcome, table

DECLARED = (10, 11, 12, 13)
# The high row is 4 points above the low one, up to the seed. A fixed number of four seeds shows it;
# at any number of seeds four of them do not.
LOW, HIGH = (50.0, 52.0, 49.0, 51.0, 50.0), (54.5, 55.0, 54.0, 54.2, 54.0)
ABOVE: dict[str, Any] = {"rows": ("high",), "against": ("low",)}


def claim(name: str = "c", **others: Any) -> Claim:
    given = {"says": "A sentence.", "source": "Sec. I", "columns": ("acc",), "expected": "higher"}
    return Claim(name=name, **{**given, **ABOVE, **others})


def runs_of(*seeds: int, low: int = 0) -> dict[RowSeed, Outcome]:
    """Runs of two rows with these seeds; `low` moves the low row up."""
    runs: dict[RowSeed, Outcome] = {}
    for place, seed in enumerate(seeds):
        for label, shares in (("low", LOW), ("high", HIGH)):
            share = shares[place % 5] + (low if label == "low" else 0)
            runs[label, seed] = outcome(f"{label}{seed}", accuracy(share, seed))
    return runs


def judge(runs: dict[RowSeed, Outcome], *claims: Claim, **others: Any) -> list[JudgedClaim]:
    rows = (
        Row(label="low", experiment="crm", values={"acc": 50.0}),
        Row(label="high", experiment="crm", values={"acc": 51.0}),
    )
    column = Column(name="acc", metric="pixel_accuracy")
    made = table(rows, (column,), claims=claims, **{"confirm": DECLARED, **others})
    return judged(made, runs).claims


def test_only_the_declared_seeds_are_judged_by_the_fixed_rule() -> None:
    (found,) = judge(runs_of(*DECLARED), claim())
    assert (found.basis, found.word, found.exploration) == (
        "confirmation",
        "same direction",
        None,
    )
    # The same numbers of other seeds are explored: an interval for any number of seeds is wider.
    (explored,) = judge(runs_of(0, 1, 2, 3), claim())
    assert (explored.basis, explored.word) == ("exploration", "not shown")
    assert found.verdict is not None
    assert explored.verdict is not None
    assert explored.verdict.smallest > 2 * found.verdict.smallest


def test_further_seeds_neither_join_nor_replace_the_declared_ones() -> None:
    """Whoever adds seeds until a claim is decided gets the rule for that, without a tag."""
    others = runs_of(0, 1, 2, 14, low=8)
    (found,) = judge(runs_of(*DECLARED) | others, claim())
    (alone,) = judge(runs_of(*DECLARED), claim())
    assert found.confirmation == alone.confirmation
    assert found.exploration is not None
    assert (found.exploration.seeds, found.exploration.estimate < 0) == (4, True)
    (more,) = judge(runs_of(*DECLARED, 14), claim(), confirm=())
    assert (more.basis, more.verdict and more.verdict.seeds) == ("exploration", 5)


def test_a_confirmation_needs_every_declared_seed_of_every_row() -> None:
    runs = runs_of(0, 1, 2, 3) | runs_of(*DECLARED)
    del runs["low", 12]
    (found,) = judge(runs, claim())
    assert (found.basis, found.verdict and found.verdict.seeds) == ("exploration", 4)
    (found,) = judge({run: one for run, one in runs.items() if run[1] >= 10}, claim())
    assert found.word == "not run"
    assert found.reason == "not all of the declared seeds 10, 11, 12, 13 are finished."


def test_claims_made_after_a_result_are_not_confirmed() -> None:
    (found,) = judge(runs_of(*DECLARED), claim(exploratory=True))
    assert (found.basis, found.word) == ("exploration", "not shown")


def test_networks_that_are_evaluated_alone_have_no_seeds() -> None:
    runs = {
        (label, FIXED): outcome(label, accuracy(share, 1))
        for label, share in (("low", 50.0), ("high", 60.0))
    }
    (found,) = judge(runs, claim())
    assert (found.basis, found.word) == ("evaluation", "same direction")


ON_PAPER = Origin("real images of mfnet", "paper", "0", "", "")


def test_words_of_a_paper_are_for_its_images_and_recipe(monkeypatch: pytest.MonkeyPatch) -> None:
    """There the bounds of the claim count, too."""
    claims = [claim(), claim("size", at_least=8.0), claim("level", against=(), at_least=52.0)]
    found = judge(runs_of(*DECLARED), *claims)
    assert [one.word for one in found] == ["same direction", "judged once", "not comparable"]
    monkeypatch.setattr(RunReader, "origin", lambda *_: ON_PAPER)
    found = judge(runs_of(*DECLARED), *claims)
    assert [one.word for one in found] == ["holds", "contradicted", "holds"]
    for images, scale, is_changed in (
        ("synthetic scenes", "paper", False),
        (ON_PAPER.images, "bench", False),
        (ON_PAPER.images, "paper", True),
        ("real images of mfnet and synthetic scenes", "paper", False),
    ):
        assert not are_of_paper(images, scale, is_changed=is_changed)


def test_a_claim_about_the_same_runs_is_judged_once() -> None:
    opposite = claim("again", rows=("low",), against=("high",), expected="lower")
    other = claim("other", rows=("low",), against=("high",))
    found = judge(runs_of(*DECLARED), claim(), opposite, other)
    assert [one.word for one in found] == ["same direction", "judged once", "opposite direction"]
    assert found[1].same_as == "c"
    runs = runs_of(*DECLARED)
    runs |= {("twin", seed): runs["high", seed] for seed in DECLARED}
    rows = tuple(Row(label=label, experiment="crm") for label in ("low", "high", "twin"))
    column = Column(name="acc", metric="pixel_accuracy")
    both = claim(rows=("high", "twin"))
    made = table(rows, (column,), claims=(both,), confirm=DECLARED)
    (found,) = judged(made, runs).claims
    assert [single.label for single in found.contrasts] == ["high - low, acc"]
    assert found.warnings[-1].endswith("judged once: twin - low, acc.")


@pytest.mark.parametrize(
    ("printed", "low", "high", "word"),
    [
        (0.75, 0.7, 0.8, "includes it"),
        (-9.8, -9.797, -9.797, "includes it"),
        (0.75, 9.2, 10.9, "larger"),
        (-0.75, -10.9, -9.2, "larger"),
        (0.75, 0.1, 0.2, "smaller"),
        (0.75, -2.0, 0.2, "smaller"),
        (0.75, -2.0, -0.2, "other sign"),
        (-0.75, 0.2, 2.0, "other sign"),
        (None, 0.1, 0.2, ""),
    ],
)
def test_size_is_our_interval_beside_the_printed_value(
    printed: float | None, low: float, high: float, word: str
) -> None:
    verdict = Verdict(
        kind="holds",
        estimate=(low + high) / 2,
        interval=Interval(low, high),
        covers="images and seeds",
        smallest=1.0,
        seeds=4,
        seeds_needed=4,
        decisive=0,
    )
    found = JudgedClaim(
        table="t", claim=claim(), label="a - b", printed=printed, confirmation=verdict
    )
    assert found.size == word
    blind = replace(verdict, interval=None, smallest=math.nan)
    assert replace(found, confirmation=blind).size == ""
