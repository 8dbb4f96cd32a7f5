"""Rank correlation with print, and signs of contrasts, by hand."""

from __future__ import annotations

import math

import numpy as np
import pandas as pd
import pytest

from sweeps.judge.agreement import (
    CONTRASTS,
    SIGNS,
    contrasts_frame,
    pairs_of,
    rank_correlations,
    ranks_of,
    signs_of,
)
from sweeps.judge.judged_table import JudgedTable
from sweeps.plan.claim import Claim
from sweeps.plan.table import Column, Row
from sweeps.show.agreement import (
    agreement_lines,
    forest_of,
    pairs_grid,
    ranks_grid,
    sides_figure,
    sides_grid,
    signs_grid,
)
from tests.sweeps.judge.accuracies import judged, planted
from tests.sweeps.tabled import table

SHARES = {"a": (50.0, 51.0, 50.5), "b": (60.0, 61.0, 60.5), "c": (80.0, 81.0, 80.5)}
PRINTED = {"a": 50.0, "b": 53.0, "c": 52.0, "d": 52.0}


def made(name: str, shares: dict[str, tuple[float, ...]]) -> JudgedTable:
    """A table whose printed order is a, c or d, b; no paper prints other rows."""
    a, b, *_, last = shares
    rows = []
    for label in shares:
        values = {"mIoU": PRINTED[label]} if label in PRINTED else {}
        rows.append(Row(label=label, experiment="crm", values=values))
    claims = tuple(
        Claim(
            name=f"{row} above {other}",
            says="S.",
            source="I",
            rows=(row,),
            against=(other,),
            columns=("mIoU",),
            expected="higher",
        )
        for row, other in ((b, a), (a, b), (b, last), (last, a))
    )
    column = Column(name="mIoU", metric="mIoU")
    given = table(tuple(rows), (column,), claims=claims, confirm=(0, 1, 2))
    return judged(given, planted(shares), name=name)


def test_rank_correlation_by_hand() -> None:
    """1 - 6 sum d^2 / (n (n^2 - 1)); with ties the correlation of the mean ranks."""
    printed = np.array([1.0, 2.0, 3.0, 4.0])
    drawn = np.array([[5.0, 6.0, 7.0, 8.0], [8.0, 7.0, 6.0, 5.0], [6.0, 5.0, 7.0, 8.0]])
    assert rank_correlations(drawn, printed) == pytest.approx([1.0, -1.0, 1 - 6 * 2 / 60])
    tied = rank_correlations(drawn[:1], np.array([1.0, 1.0, 2.0, 3.0]))
    assert tied == pytest.approx(np.corrcoef([1, 2, 3, 4], [1.5, 1.5, 3, 4])[0, 1])


def test_ranks_of_tables_and_their_interval() -> None:
    ranks = ranks_of([made("p/one", SHARES)])
    (row,) = ranks.to_dict("records")
    assert (row["table"], row["rows"], row["scale"]) == ("p/one", 3, "unknown")
    assert row["rho"] == pytest.approx(0.5)
    assert (row["low"], row["high"]) == pytest.approx((0.5, 0.5)), "our order is certain"
    noisy = {**SHARES, "b": (90.0, 40.0, 80.0)}
    (row,) = ranks_of([made("p/one", noisy)]).to_dict("records")
    assert row["low"] < 0.5 < row["high"]
    twins = {"a": SHARES["a"], "b": SHARES["b"], "c": ()}
    assert ranks_of([made("p/one", twins)]).empty, "two rows are ranked alike or opposite"
    single = {label: shares[:1] for label, shares in SHARES.items()}
    (row,) = ranks_of([made("p/one", single)]).to_dict("records")
    assert math.isnan(row["low"])


def test_signs_of_different_contrasts_are_counted_once() -> None:
    """b above a and c above a are so in print and ours, b above c in print alone."""
    first = made("p/one", SHARES)
    contrasts = contrasts_frame([first])
    assert contrasts["claim"].tolist() == ["b above a", "b above c", "c above a"]
    (found,) = signs_of(contrasts).to_dict("records")
    assert [found[key] for key in SIGNS[2:4] + SIGNS[6:]] == [2, 3, 2, 3]
    assert math.isnan(found["low"]), "one table has no spread over tables"
    assert signs_of(contrasts[:1]).empty, "one contrast is no share"
    # In another table d scores lowest; its runs of a and b are those of the first.
    shares = {"a": SHARES["a"], "b": SHARES["b"], "d": (10.0, 11.0, 10.5)}
    both = contrasts_frame([first, made("p/two", shares)])
    (found,) = signs_of(both).to_dict("records")
    assert (found["alike"], found["contrasts"]) == (3, 5)
    assert found["low"] <= 3 / 5 <= found["high"]
    lines = agreement_lines(signs_of(both), ranks_of([first]))
    assert "contrasts have the printed sign" in lines[0]
    assert "0 below" in lines[0]


def test_contrasts_without_print_are_known_and_do_not_count_as_printed() -> None:
    printed = made("p/one", SHARES)
    own = made("own", dict(zip("xyz", SHARES.values(), strict=True)))
    for tables in ([printed, own], [own, printed]):
        contrasts = contrasts_frame(tables)
        assert contrasts["printed"].notna().tolist() == [True] * 3 + [False] * 3
        (found,) = signs_of(contrasts).to_dict("records")
        assert (found["alike"], found["contrasts"]) == (2, 3)
        assert "| own |" not in signs_grid(contrasts).to_markdown()
        figure = forest_of(contrasts, "P")
        assert figure is not None
        assert len(figure.axes[0].get_yticklabels()) == 3
        sides = sides_grid(contrasts, "unknown").to_markdown()
        assert "| own: y - x, mIoU | - | +9.67*" in sides


def test_most_contrasts_on_real_images_are_said_first() -> None:
    one = contrasts_frame([made("p/one", SHARES)])
    counts = {"synthetic scenes": 3, "real images of a": 2, "real images of b": 3}
    every = [one[:number].assign(images=images) for images, number in counts.items()]
    found = signs_of(pd.concat(every))["images"].tolist()
    assert found == ["real images of b", "real images of a", "synthetic scenes"]


def test_no_interval_that_excludes_0_is_said() -> None:
    both = contrasts_frame([made("p/one", SHARES)])
    wide = both.assign(confirmed_low=-99.0, confirmed_high=99.0)
    (line,) = agreement_lines(signs_of(wide), ranks_of([]))
    assert line.endswith("where chance gives 50 %; no interval excludes 0.")


def test_a_confirmation_without_interval_is_not_decided_by_exploration() -> None:
    both = contrasts_frame([made("p/one", SHARES)])
    for end in ("low", "high"):
        both[f"explored_{end}"] = both[f"confirmed_{end}"]
    both["confirmed_low"] = both["confirmed_high"] = math.nan
    (found,) = signs_of(both).to_dict("records")
    assert (found["alike"], found["decided"]) == (2, 0)
    (found,) = signs_of(both.assign(confirmed=math.nan, explored=both["confirmed"])).to_dict(
        "records"
    )
    assert (found["alike"], found["decided"]) == (2, 3)


def test_agreement_is_shown_and_drawn() -> None:
    tables = [made("p/one", SHARES)]
    contrasts = contrasts_frame(tables)
    text = signs_grid(contrasts).to_markdown() + ranks_grid(ranks_of(tables)).to_markdown()
    assert "| p/one | unknown images, scale=unknown | 2 of 3 | 3 |" in text
    assert "+0.50 | [+0.50, +0.50]" in text
    figure = forest_of(contrasts, "P")
    assert figure is not None
    (axes,) = figure.axes
    names = [label.get_text() for label in axes.get_yticklabels()]
    assert names[0] == "one: b - c, mIoU", "the sign that differs from print is on top"
    assert len(names) == 3
    assert forest_of(contrasts.iloc[:0], "P") is None
    assert forest_of(contrasts_frame([]), "P") is None


def measured(kind: str, scale: str, ours: dict[str, float]) -> pd.DataFrame:
    """Contrasts a to d of two tables, printed as 1, 2, -3 and 4, with ends one point away."""
    printed = {"a": 1.0, "b": 2.0, "c": -3.0, "d": 4.0}
    rows = []
    for name, value in ours.items():
        row = dict.fromkeys(CONTRASTS, math.nan) | {"paper": "p", "images": kind, "scale": scale}
        row |= {"table": "one" if name in "ab" else "two", "claim": name, "contrast": name}
        row |= {"printed": printed[name], "explored": value, "explored_low": value - 1}
        rows.append(row | {"explored_high": value + 1, "decides": True})
    return pd.DataFrame(rows)


def test_print_bench_and_real_images_are_compared_in_pairs() -> None:
    """Bench has all four, real images three; each pair is over what both have."""
    bench = measured("synthetic scenes", "bench", {"a": 1.0, "b": -2.0, "c": -3.0, "d": 0.5})
    real = measured("real images of m", "real", {"a": 5.0, "b": -7.0, "d": 6.0})
    both = pd.concat([bench, real], ignore_index=True)
    found = {(row["first"], row["second"]): row for row in pairs_of(both).to_dict("records")}
    synthetic, images = "synthetic scenes, scale=bench", "real images of m, scale=real"
    counts = {pair: (row["alike"], row["contrasts"]) for pair, row in found.items()}
    assert counts == {
        ("print", images): (2, 3),
        ("print", synthetic): (3, 4),
        (images, synthetic): (3, 3),
    }
    # Ranks of print 2 3 1 4 and bench 4 2 1 3 differ by 2, 1, 0, 1: 1 - 6 * 6 / (4 * 15).
    assert found["print", synthetic]["rho"] == pytest.approx(0.4)
    row = found[images, synthetic]
    assert row["rho"] == pytest.approx(0.5), "ranks 2 1 3 and 3 1 2"
    assert row["low"] <= 1.0 <= row["high"]
    assert row["tables"] == 2
    assert "| 3 of 3 | 2 | 100 % [" in pairs_grid(pairs_of(both)).to_markdown()
    text = sides_grid(both, "real images").to_markdown()
    assert "| one: a | +1.00 | +1.00 [+0.00, +2.00] | +5.00* [+4.00, +6.00] |" in text
    assert "two: c" not in text, "it was not run on real images"
    figure = sides_figure(both, "real images")
    assert figure is not None
    (axes,) = figure.axes
    assert [name.get_text() for name in axes.get_yticklabels()] == ["one: a", "one: b", "two: d"]
    drawn = {bars.get_label(): bars.lines[0].get_xdata() for bars in axes.containers}
    assert {kind: list(values) for kind, values in drawn.items()} == {
        synthetic: [1.0, -2.0, 0.5],
        images: [5.0, -7.0, 6.0],
    }
    assert sides_figure(bench, "real images") is None
