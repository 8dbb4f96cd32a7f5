"""The variance budget of a table: by source, in sum, of the images, and of paired differences."""

from __future__ import annotations

import math
from typing import Any

import pytest

from rgbt.checks import InputError
from rgbt.config.compose import compose
from rgbt.runs.specify import specify
from sweeps.rendering.variance import variance_csv, variance_grids
from sweeps.table.check_table import check_table
from sweeps.table.load_table import STUDIES, load_table, study_names
from sweeps.table.request import TableRequest
from sweeps.table.table import Row, Table
from sweeps.table.variance import Variance
from sweeps.verdicts.judge import TableJudge
from sweeps.verdicts.variance import VarianceBudget, variance_budget
from tests.sweeps.tabled import outcome, right, table
from tests.sweeps.verdicts.accuracies import planted

SHARES = {"w": (50, 53, 50), "o": (50, 50, 54), "all": (48, 52, 56), "other": (40, 45, 50)}
"""Accuracies in percent by seed: sd of w sqrt(3), of o sqrt(16 / 3), of all 4."""

DECLARED = Variance(column="acc", sources={"weights": "w", "order": "o"}, all="all")


def of(variance: Variance | None = DECLARED) -> Table:
    rows = tuple(Row(label=label, experiment="crm") for label in SHARES)
    return table(rows, variance=variance)


def budget(variance: Variance = DECLARED, *, without: str = "") -> VarianceBudget:
    runs: Any = {
        (label, seed): outcome(f"{label}{seed}", right(share))
        for label, shares in SHARES.items()
        for seed, share in enumerate(shares)
        if label != without
    }
    found = variance_budget(TableJudge("own/t", of(variance), resamples=100), runs)
    assert found is not None
    return found


def test_sources_have_the_standard_deviations_of_their_rows() -> None:
    found = budget()
    assert [each.source for each in found.sources] == ["weights", "order"]
    assert [each.sd for each in found.sources] == pytest.approx([math.sqrt(3), math.sqrt(16 / 3)])
    assert found.total == pytest.approx(math.sqrt(3 + 16 / 3))
    assert (found.all.sd, found.all.count) == (pytest.approx(4.0), 3)
    assert found.all.interval is not None
    # chi2(0.975, 2) = 7.378
    assert found.all.interval.low == pytest.approx(4 * math.sqrt(2 / 7.378), rel=1e-3)


def test_difference_without_another_method_is_that_of_two_unpaired_runs() -> None:
    found = budget()
    assert found.difference.sd == pytest.approx(math.sqrt(2) * 4)
    by_seeds = {each.seeds: each for each in found.smallest}
    # t(0.975, 3) = 3.1824
    assert by_seeds[4].value == pytest.approx(3.1824 * math.sqrt(2) * 4 / 2, rel=1e-4)
    assert by_seeds[4].interval.low < by_seeds[4].value < by_seeds[4].interval.high
    assert math.isnan(by_seeds[4].with_images)


def test_difference_against_another_method_is_paired_by_seed() -> None:
    found = budget(Variance(column="acc", sources={"weights": "w"}, all="all", against="other"))
    assert found.difference.sd == pytest.approx(1.0)  # 8, 7, 6
    assert found.difference.source == "all - other, acc"


def test_images_are_resampled() -> None:
    rows = {"w": (50.0, 51.0), "o": (50.0, 52.0), "all": (50.0, 53.0), "other": (40.0, 44.0)}
    declared = Variance(column="acc", sources={"weights": "w"}, all="all", against="other")
    judge = TableJudge("own/t", of(declared), resamples=400)
    runs: Any = planted(rows)
    found = variance_budget(judge, runs)
    assert found is not None
    # 40 images of 800 pixels with independent noise: sqrt(p (1 - p) / 32,000) = 0.28 for one run.
    assert found.images.sd == pytest.approx(0.28 / math.sqrt(2), rel=0.5)
    assert "blocks" not in found.images.reason
    assert all(each.with_images >= each.value for each in found.smallest)


def test_source_without_runs_is_named_and_the_sum_is_unknown() -> None:
    found = budget(without="o")
    assert found.sources[1].reason == "row 'o' has no finished run."
    assert math.isnan(found.total)
    by_source, _ = variance_grids(found)
    assert by_source.rows[1] == ("order", "-", "-", "-", "0")
    assert "order: row 'o' has no finished run." in by_source.notes


def test_table_without_variance_has_no_budget() -> None:
    assert variance_budget(TableJudge("own/t", of(None)), {}) is None


def test_grids_show_shares_of_the_variance_of_all() -> None:
    by_source, smallest = variance_grids(budget())
    shares = {row[0]: row[3] for row in by_source.rows}
    assert shares == {
        **{"weights": "19 %", "order": "33 %", "sum of these": "52 %", "all": "100 %"},
        "test images": "-",
    }
    assert by_source.rows[0][1] == "1.73"
    assert [row[0] for row in smallest.rows] == ["2", "3", "4", "6", "8", "12", "16"]
    assert smallest.rows[2][1] == "9.00"


def test_csv_has_every_number() -> None:
    lines = variance_csv(budget()).splitlines()
    assert lines[0] == "kind,name,value,low,high,with_images,count,reason"
    assert lines[1].startswith(f"sd,weights,{math.sqrt(3):.6g},")
    assert len(lines) == 1 + 2 + 3 + 1 + 7


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"column": "mIuO"}, "t.yaml, variance, column"),
        ({"all": "everything"}, "t.yaml, variance, row"),
        ({"against": "none"}, "t.yaml, variance, row"),
        ({"sources": {}}, "t.yaml, variance, sources: expected one source or more, got none."),
    ],
)
def test_variance_of_unknown_parts_is_refused(changes: dict[str, Any], sentence: str) -> None:
    with pytest.raises(InputError, match=sentence):
        check_table(of(Variance(**{**vars(DECLARED), **changes})), "t.yaml")


def test_study_rows_vary_one_source_each() -> None:
    assert "variance" in study_names()
    study = load_table("variance")
    assert study == load_table(str(STUDIES / "variance.yaml"))
    request = TableRequest("variance", study, "demo", (3,))
    specs = {
        label: specify(compose(words), words)
        for label, seed in request.row_seeds()
        if (words := request.overrides(label, seed))
    }
    drawn = {
        label: (spec.drawn.weights, spec.drawn.order, spec.drawn.masks)
        for label, spec in specs.items()
    }
    assert drawn == {
        **{"weights": (3, 1000, 1000), "order": (1000, 3, 1000), "masks": (1000, 1000, 3)},
        **{"start": (1000, 1000, 1000), "all": (3, 3, 3), "baseline": (3, 3, 3)},
    }
    starts = {label: spec.seeds.start for label, spec in specs.items()}
    assert {label for label, start in starts.items() if start == "run"} == {
        "start",
        "all",
        "baseline",
    }
    assert len({spec.key for spec in specs.values()}) == 6
