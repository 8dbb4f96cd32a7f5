"""Verdicts as they are shown in a terminal, from claims with planted outcomes."""

from __future__ import annotations

import io
import re

import pytest
from rich.console import Console

from rgbt.terminal import rich_table
from sweeps.plan.claim import Claim
from sweeps.plan.table import Row
from sweeps.show.claims import claim_grids, claims_frame
from tests.sweeps.judge.accuracies import judged, planted
from tests.sweeps.tabled import table

SAYS = "The network with both images is better than the one with the visible images alone."


@pytest.mark.parametrize("width", [80, 120])
def test_no_verdict_is_cut(width: int) -> None:
    shares = {"low": (50.0, 51.0, 49.0), "high": (60.0, 61.5, 59.0), "same": (60.5, 60.0, 60.5)}
    pairs = {"true": ("high", "low"), "false": ("low", "same"), "small": ("same", "high")}
    given = {"columns": ("acc",), "expected": "higher", "source": "Sec. I", "says": SAYS}
    claims = tuple(
        Claim(name=f"a_long_name_of_the_claim_{name}", rows=(row,), against=(other,), **given)  # type: ignore[arg-type]
        for name, (row, other) in pairs.items()
    )
    rows = tuple(Row(label=label, experiment="crm") for label in shares)
    made = judged(
        table(rows, claims=claims, confirm=(0, 1, 2)), planted(shares), name="a_paper/a_table"
    )
    frame = claims_frame(made.claims)
    console = Console(file=io.StringIO(), width=width)
    for grid in claim_grids(frame, noted=True):
        console.print(rich_table(grid))
    shown = console.file.getvalue()  # type: ignore[attr-defined]
    for word in ("same direction", "opposite direction", "not shown"):
        first, *second = word.split()
        assert re.search(rf"^ *{first}( {second[0]})? ", shown, re.MULTILINE), word
    assert max(map(len, shown.splitlines())) <= width
    assert "…" not in shown
    assert "more images" in shown or "seeds" in shown
