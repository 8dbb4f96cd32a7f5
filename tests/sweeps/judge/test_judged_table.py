"""Claims with planted outcomes: true, false, and too small to tell."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import pytest

from analysis.uncertainty.contrasts import FIXED
from sweeps.judge.contrasts import as_claimed
from sweeps.judge.judged_claim import JudgedClaim
from sweeps.plan.claim import Claim
from sweeps.plan.request import RowSeed
from sweeps.plan.table import Column, Row, Table
from sweeps.point import Outcome
from sweeps.score.cells import TableCell
from tests.sweeps.judge.accuracies import accuracy, judged, planted
from tests.sweeps.tabled import failed, outcome, table

SHARES = {"low": (50.0, 51.0, 49.0), "high": (60.0, 61.5, 59.0), "same": (60.5, 60.0, 60.5)}
"""Accuracies in percent by seed."""

SAME, OPPOSITE, OPEN = "same direction", "opposite direction", "not shown"
PRINTED = {"low": 50.0, "high": 49.0, "same": 50.5}
ACC = Column(name="acc", metric="pixel_accuracy")


def claim(name: str = "c", **others: Any) -> Claim:
    given = {"says": "A sentence.", "source": "Sec. I", "columns": ("acc",), "expected": "higher"}
    return Claim(name=name, **{**given, **others})


def of(*claims: Claim, rows: tuple[str, ...] = tuple(SHARES), **others: Any) -> Table:
    made = []
    for label in rows:
        values = {"acc": PRINTED[label]} if label in PRINTED else {}
        made.append(Row(label=label, experiment="crm", values=values))
    return table(tuple(made), (ACC,), claims=claims, **{"confirm": (0, 1, 2), **others})


def judge(one: Claim, runs: dict[RowSeed, Outcome] | None = None, **others: Any) -> JudgedClaim:
    runs = planted(SHARES) if runs is None else runs
    (found,) = judged(of(one, **others), runs).claims
    return found


def test_true_false_and_undecidable_claims_come_out_so() -> None:
    claims = (
        claim("true", rows=("high",), against=("low",)),
        claim("false", rows=("low",), against=("same",)),
        claim("small", rows=("same",), against=("high",)),
    )
    found = judged(of(*claims), planted(SHARES)).claims
    assert [claim.word for claim in found] == [SAME, OPPOSITE, OPEN]
    assert [claim.as_printed for claim in found] == [False, False, True]
    true, _, small = (claim.verdict for claim in found)
    assert true is not None
    assert small is not None
    assert true.estimate == pytest.approx(10.2, abs=1.0)
    assert true.seeds == 3
    assert small.interval is not None
    assert small.interval.low < 0 < small.interval.high
    assert small.smallest > abs(small.estimate)
    assert small.seeds_needed > 3
    assert found[2].reason


def test_paired_seeds_cancel_what_both_rows_share() -> None:
    """Seeds differ by 20 points, the rows of each seed by 2."""
    runs = planted({"low": (40.0, 60.0, 50.0, 55.0), "high": (42.0, 62.0, 52.0, 57.0)})
    found = judge(claim(rows=("high",), against=("low",)), runs)
    assert found.word == SAME


def test_best_of_all_needs_every_other_row() -> None:
    best = claim(rows=("high",), against=("others",))
    shares = {**SHARES, "same": (55.0, 55.5, 54.0)}
    assert judge(best, planted(shares)).word == SAME
    partly = planted({label: shares[label] for label in ("low", "high")})
    found = judge(best, partly)
    assert (found.word, found.missing) == (OPEN, ("same",))
    assert found.reason == "Some rows have no score: row 'same' has no finished run."
    worse = {**SHARES, "high": (40.0, 41.0, 39.0)}
    refuted = judge(best, planted({label: worse[label] for label in ("low", "high")}))
    assert (refuted.word, refuted.missing) == (OPPOSITE, ("same",))


def test_most_with_rows_not_run_is_never_contradicted() -> None:
    """The rows that were not run may all be as claimed: three of five would be most."""
    rows = ("low", "same", "first", "second", "third")
    most = claim(rows=rows, against=("high",), combine="most")
    shares = {"low": (50.0, 51.0, 49.0), "same": (55.0, 56.0, 54.0), "high": (90.0, 91.0, 89.5)}
    found = judge(most, planted(shares), rows=("high", *rows))
    assert (found.word, found.missing) == (OPEN, ("first", "second", "third"))
    every = planted({**dict.fromkeys(rows, shares["low"]), "high": shares["high"]})
    assert judge(most, every, rows=("high", *rows)).word == OPPOSITE


def test_claim_without_runs_is_not_run() -> None:
    found = judge(claim(rows=("high",), against=("low",)), {})
    assert (found.word, found.verdict, found.printed) == ("not run", None, -1.0)
    assert found.missing == ("low", "high")
    assert found.reason == "row 'high' has no finished run."
    lost = {("high", 0): failed("broke"), ("low", 0): outcome("k", accuracy(50))}
    assert judge(claim(rows=("high",), against=("low",)), lost).word == "not run"


def test_one_seed_decides_nothing() -> None:
    runs = planted({"low": (50,), "high": (60,)})
    found = judge(claim(rows=("high",), against=("low",)), runs, confirm=())
    assert found.word == OPEN
    assert found.verdict is not None
    assert (found.verdict.covers, found.verdict.seeds) == ("images", 1)
    assert math.isnan(found.verdict.seeds_needed)


def test_predictions_without_seeds_are_compared_with_every_seed() -> None:
    runs: dict[RowSeed, Outcome] = {
        **planted({"high": SHARES["high"]}),
        ("low", FIXED): outcome("file", accuracy(50.0, 7)),
    }
    found = judge(claim(rows=("high",), against=("low",)), runs)
    assert found.word == SAME
    assert found.verdict is not None
    assert found.verdict.seeds == 3


def test_most_are_more_than_half() -> None:
    most = claim(rows=("high",), combine="most")
    assert [as_claimed(most, values) for values in ((1.0, -1.0), (1.0, -1.0, 2.0))] == [False, True]


def test_mean_and_any_combine_contrasts() -> None:
    two = {"rows": ("high", "low"), "against": ("same",)}
    shares = {**SHARES, "high": (70.0, 71.0, 69.0)}
    assert judge(claim(**two, combine="any"), planted(shares)).word == SAME
    assert judge(claim(**two), planted(shares)).word == OPPOSITE
    mean = judge(claim(**two, combine="mean", at_most=5.0, expected="similar"), planted(shares))
    assert mean.word == SAME
    assert mean.label == "mean of 2 contrasts"
    assert mean.printed == pytest.approx((49.0 + 50.0) / 2 - 50.5)


@pytest.mark.parametrize(
    ("best", "marks"),
    [("highest", {"high": 1, "mid": 2}), ("lowest", {"low": 1, "mid": 2}), ("none", {})],
)
def test_best_row_is_marked_where_it_is_shown(best: Any, marks: dict[str, int]) -> None:
    column = Column(name="acc", metric="pixel_accuracy", best=best)
    rows = tuple(Row(label=label, experiment="crm") for label in ("low", "mid", "high"))
    shares = {"low": (50.0, 51.0, 49.0), "mid": (70.0, 71.0, 70.5), "high": (90.0, 91.0, 90.0)}
    made = table(rows, (column,), confirm=(0, 1, 2))
    given = planted(shares)
    found = judged(made, given)
    assert found.scored.marks == {(label, "acc"): rank for label, rank in marks.items()}
    noisy = planted({**shares, "high": (90.0, 60.0, 70.0), "low": (50.0, 80.0, 70.0)})
    assert judged(made, noisy).scored.marks == {}
    single = {run: one for run, one in given.items() if run[1] == 0}
    assert replace(found, runs=single).scored.marks == {}


def test_rows_of_the_same_runs_share_a_mark() -> None:
    runs = planted({"low": (50.0, 51.0, 49.0), "high": (60.0, 61.0, 60.0)})
    runs |= {("again", seed): run for (label, seed), run in list(runs.items()) if label == "high"}
    rows = tuple(Row(label=label, experiment="crm") for label in ("low", "high", "again"))
    one = claim(rows=("high",), against=("again",))
    made = judged(table(rows, (ACC,), claims=(one,), confirm=(0, 1, 2)), runs)
    assert made.scored.marks == {("high", "acc"): 1, ("again", "acc"): 1}
    (found,) = made.claims
    assert found.word == "not run"
    assert found.reason == "rows 'high' and 'again' are the same runs at this scale."


def test_claims_about_counted_sizes_are_exact() -> None:
    size = Column(name="size", efficiency="parameters")
    rows = tuple(Row(label=label, experiment="crm") for label in ("small", "large"))
    one = claim(rows=("small",), against=("large",), columns=("size",), expected="lower")
    sizes = {
        (label, "size"): TableCell(mean, math.nan, 0)
        for label, mean in (("small", 3.0), ("large", 5.0))
    }
    more = {**sizes, ("small", "size"): TableCell(6.0, math.nan, 0)}
    made = table(rows, (size,), claims=(one,))
    for given, word in ((sizes, "holds"), (more, "contradicted"), ({}, "not run")):
        (found,) = judged(made, {}, given).claims
        assert found.word == word


def test_rows_of_different_lists_or_machines_are_said() -> None:
    runs = planted({"low": SHARES["low"], "high": SHARES["high"]})
    for (label, seed), finished in runs.items():
        lists = "trained on train.txt" if label == "low" else "trained on all.txt"
        machine = "GPU" if label == "high" and seed else "CPU"
        run: Any = replace(finished.results[0], lists=lists, machine=machine)  # type: ignore[type-var]
        runs[label, seed] = replace(finished, results=(run,))
    assert judge(claim(rows=("high",), against=("low",)), runs).warnings == (
        "Different lists: low trained on train.txt; high trained on all.txt.",
        "Seeds 1, 2 mix machines, which train differently.",
    )


def test_folds_differ_in_lists_and_rows_do_not() -> None:
    runs = planted({"low": SHARES["low"], "high": SHARES["high"]})
    for (label, seed), finished in runs.items():
        run: Any = replace(finished.results[0], lists=f"trained on fold {seed}")  # type: ignore[type-var]
        runs[label, seed] = replace(finished, results=(run,))
    assert judge(claim(rows=("high",), against=("low",)), runs).warnings == ()


def test_seeds_without_the_evaluation_do_not_count() -> None:
    """Another table may have trained seed 2 of a row, without the measurement of this one."""
    one, runs = claim(rows=("high",), against=("low",)), {}
    for label, shares in SHARES.items():
        for seed, share in enumerate(shares):
            own, of_rgb = accuracy(50.0, seed), accuracy(share, seed)
            made = {(): own, ("modality=rgb",): of_rgb} if seed < 2 else own
            runs[label, seed] = outcome(f"{label}{seed}", made)
    rgb = replace(of(one), columns=(Column(**{**vars(ACC), "modality": "rgb"}),))
    (found,) = judged(replace(rgb, confirm=(0, 1)), runs).claims
    assert found.verdict is not None
    assert (found.verdict.seeds, round(found.verdict.estimate)) == (2, 10)
