from __future__ import annotations

import math
from dataclasses import replace

import pytest

from rgbt.checks import InputError
from sweeps.evaluation import ExtraEvaluation
from sweeps.table.cells import TableCell
from sweeps.table.scoring import check_metrics, published, score
from sweeps.table.table import Column, Row
from tests.sweeps.tabled import Made, counts_of, failed, outcome, pairs_of, right, table

ACC = Column(name="acc", metric="pixel_accuracy")
RGB = Column(name="rgb", metric="pixel_accuracy", modality="rgb")
LESS = Column(name="less", minus=("rgb", "acc"))


def test_mean_sd_and_difference_by_hand() -> None:
    scored = Made({"a": ((40, 50, 60), 48.0)}).scored()
    cell = scored.cells["a", "acc"]
    (row,), (column,) = scored.table.rows, scored.table.columns
    assert (cell.mean, cell.sd, cell.seeds) == (50.0, 10.0, 3)
    assert cell.keys == ("a0", "a1", "a2")
    assert scored.difference(row, column) == 2.0
    assert (scored.seeds, cell.reason) == ((0, 1, 2), "")


def test_one_seed_has_no_sd() -> None:
    assert math.isnan(Made({"a": ((40,), None)}).scored().cells["a", "acc"].sd)


def test_best_and_second_best_by_direction() -> None:
    rows = {"a": ((40,), 9.0), "b": ((60,), 8.0), "c": ((50,), 7.0)}
    scored = Made(rows).scored()
    assert scored.ranks_ours == {("b", "acc"): 1, ("c", "acc"): 2}
    assert scored.ranks_published == {("a", "acc"): 1, ("b", "acc"): 2}
    lowest = Column(name="acc", metric="pixel_accuracy", best="lowest")
    assert Made(rows, {"columns": (lowest,)}).scored().ranks_ours == {
        ("a", "acc"): 1,
        ("c", "acc"): 2,
    }
    nobody = Column(name="acc", metric="pixel_accuracy", best="none")
    assert Made(rows, {"columns": (nobody,)}).scored().ranks_ours == {}


def test_ties_share_a_rank_and_equal_columns_have_none() -> None:
    tied = Made({"a": ((60,), 5.0), "b": ((60,), 5.0), "c": ((50,), 5.0)}).scored()
    assert tied.ranks_ours == {("a", "acc"): 1, ("b", "acc"): 1, ("c", "acc"): 2}
    assert tied.ranks_published == {}


def test_rank_correlation() -> None:
    # ranks of ours 1 2 3 4, printed 1 3 2 4: rho = 1 - 6 * 2 / (4 * 15) = 0.8
    rows = {"a": ((1,), 10.0), "b": ((2,), 30.0), "c": ((3,), 20.0), "d": ((4,), 40.0)}
    order = Made(rows | {"e": ((5,), None)}).scored().orders["acc"]
    assert order.rho == pytest.approx(0.8)
    assert order.rows == 4


@pytest.mark.parametrize(
    "rows",
    [
        {"a": ((1,), 10.0), "b": ((2,), 30.0)},
        {"a": ((1,), 10.0), "b": ((1,), 30.0), "c": ((1,), 20.0)},
        {"a": ((1,), None)},
    ],
)
def test_no_rank_correlation_of_few_or_equal_rows(rows: dict) -> None:
    order = Made(rows).scored().orders["acc"]
    assert math.isnan(order.rho)
    assert order.rows == sum(printed is not None for _, printed in rows.values())


def test_score_minus_per_seed_and_modality() -> None:
    runs = {
        ("a", seed): outcome(str(seed), {None: right(acc), ExtraEvaluation("rgb"): right(rgb)})
        for seed, (acc, rgb) in enumerate([(50, 40), (70, 50)])
    }
    scored = score("t", table((Row(label="a"),), (ACC, RGB, LESS)), runs, scale="demo")
    assert scored.cells["a", "rgb"].mean == 45.0
    less = scored.cells["a", "less"]
    assert less.mean == -15.0
    assert less.sd == pytest.approx(math.sqrt(50))  # -10 and -20; not from the two columns' sds


def test_score_mean_column_per_seed_reports_missing() -> None:
    columns = (
        Column(name="both", mean=("rgb", "acc")),
        *(ACC, RGB),
        Column(name="gain", minus=("both", "acc")),
    )
    runs = {
        ("a", seed): outcome(str(seed), {None: right(acc), ExtraEvaluation("rgb"): right(rgb)})
        for seed, (acc, rgb) in enumerate([(50, 40), (70, 50)])
    }
    cells = score("t", table((Row(label="a"),), columns), runs, scale="demo").cells
    assert cells["a", "both"].mean == 52.5
    assert cells["a", "both"].sd == pytest.approx(math.sqrt(112.5))  # 45 and 60
    assert cells["a", "gain"].mean == -7.5  # -5 and -10
    missing = Column(name="both", mean=("acc", "bus"))
    bus = Column(name="bus", metric="class/bus")
    found = score("t", table((Row(label="a"),), (ACC, bus, missing)), runs, scale="demo")
    cell = found.cells["a", "both"]
    assert (cell.seeds, cell.mark) == (0, "no value")
    assert "no class 'bus'" in cell.reason
    later = (ACC, Column(name="TC", needs="flow"), Column(name="both", mean=("acc", "TC")))
    found = score("t", table((Row(label="a"),), later), runs, scale="demo")
    assert found.cells["a", "both"].reason == "seeds 0, 1: flow"


def test_score_omitted_columns_have_no_cell() -> None:
    rows = (Row(label="a", without=("rgb",)), Row(label="b"))
    both = {None: right(50), ExtraEvaluation("rgb"): right(30)}
    runs = {("a", 0): outcome("k", right(40)), ("b", 0): outcome("l", both)}
    mean = Column(name="both", mean=("acc", "rgb"))
    cells = score("t", table(rows, (ACC, RGB, LESS, mean)), runs, scale="demo").cells
    assert {place: cell.mean for place, cell in cells.items()} == {
        ("a", "acc"): 40.0,
        **{("b", "acc"): 50.0, ("b", "rgb"): 30.0, ("b", "less"): -20.0, ("b", "both"): 40.0},
    }


def test_each_head_has_its_counts() -> None:
    column = Column(name="day head", metric="pixel_accuracy", modality="rgb", head="source")
    made = {None: right(50), ExtraEvaluation("rgb", head="source"): right(30)}
    runs = {("a", 0): outcome("k", made)}
    scored = score("t", table((Row(label="a"),), (ACC, column)), runs, scale="demo")
    assert [cell.mean for cell in scored.cells.values()] == [50.0, 30.0]


def test_failing_images_have_counts_of_their_own() -> None:
    noisy = Column(name="noisy", metric="pixel_accuracy", corruption="noise", severity=16)
    made = {None: right(50), ExtraEvaluation(corruption="noise", severity=16.0): right(30)}
    runs = {("a", 0): outcome("k", made)}
    scored = score("t", table((Row(label="a"),), (ACC, noisy)), runs, scale="demo")
    assert [cell.mean for cell in scored.cells.values()] == [50.0, 30.0]


def test_sizes_stand_beside_what_was_run_and_have_ranks() -> None:
    size = Column(name="size", parameters=True, best="lowest")
    rows = tuple(
        Row(label=label, experiment="crm", values={"size": printed})
        for label, printed in (("a", 54.4), ("b", 44.6), ("c", 50.0))
    )
    runs = {("a", seed): outcome(str(seed), right(40)) for seed in (0, 1)}
    sizes = {
        (label, "size"): TableCell(millions, math.nan, 0)
        for label, millions in (("a", 54.36), ("b", 44.56), ("c", 51.0))
    }
    scored = score("t", table(rows, (ACC, size)), runs, scale="demo", sizes=sizes)
    assert scored.cells["a", "acc"].seeds == 2
    assert scored.cells["b", "size"].mean == 44.56
    assert scored.ranks_ours == {("b", "size"): 1, ("c", "size"): 2}
    assert scored.difference(rows[0], size) == pytest.approx(-0.04)
    assert (scored.orders["size"].rho, scored.orders["size"].rows) == (pytest.approx(1.0), 3)
    assert set(score("t", table(rows, (size,)), {}, scale="demo").cells) == set()


def test_regions_of_the_table_and_placeholders() -> None:
    column = Column(name="R2", metric="class/{class}/region/2")
    rows = (
        Row(label="Road", settings={"class": "road"}),
        Row(label="Car", settings={"class": "car"}),
    )
    run = outcome("k", {ExtraEvaluation("default", "ring9"): counts_of()})
    runs = {("Road", 0): run, ("Car", 0): run}
    scored = score("t", table(rows, (column,), regions="ring9"), runs, scale="demo")
    assert scored.cells["Road", "R2"].mean == pytest.approx(75.0)
    assert scored.cells["Car", "R2"].mean == pytest.approx(80.0)


def test_score_protocols_have_separate_counts() -> None:
    """TC of road 6/8 and 8/10, of car 0. CA of road alike; as released 6/10 and 8/12."""
    columns = (
        ACC,
        Column(name="TC", metric="TC", frames="released"),
        Column(name="CA", metric="CA_released", frames="released"),
        Column(name="TC aligned", metric="class/road/TC", frames="aligned", printed=False),
    )
    rows = tuple(
        Row(label=label, experiment="crm", values={"TC": printed})
        for label, printed in (("a", 30.0), ("b", 31.0), ("c", 32.0))
    )
    made = {
        label: {
            None: right(share),
            ExtraEvaluation(frames="released"): pairs_of(same, 2, "released"),
            ExtraEvaluation(frames="aligned"): pairs_of(same + 2, 0 if label == "c" else 2),
        }
        for label, share, same in (("a", 40, 6), ("b", 50, 8), ("c", 60, 2))
    }
    runs = {(label, 0): outcome(label, counts) for label, counts in made.items()}
    scored = score("t", table(rows, columns), runs, scale="demo")
    found = {place: cell.mean for place, cell in scored.cells.items()}
    assert found["a", "TC"] == pytest.approx(100 * 6 / 8 / 2)
    assert found["b", "TC"] == pytest.approx(100 * 8 / 10 / 2)
    assert found["a", "CA"] == pytest.approx(100 * 6 / (6 + 8 + 8 - 2 * 6) / 2)
    assert found["b", "CA"] == pytest.approx(100 * 8 / (8 + 10 + 10 - 2 * 8) / 2)
    assert found["a", "TC aligned"] == pytest.approx(80.0)
    assert found["c", "TC aligned"] == 100.0
    assert scored.orders["TC"].rho == pytest.approx(-0.5)  # ours 2 3 1 for 1 2 3
    assert scored.orders["TC aligned"].rows == 0
    assert scored.ranks_ours["c", "TC aligned"] == 1
    assert math.isnan(scored.difference(rows[0], columns[3]))


def test_pairs_that_were_not_counted_say_so() -> None:
    column = Column(name="TC", metric="TC", frames="aligned")
    run = outcome("k", {ExtraEvaluation(frames="aligned"): right(40)})
    (cell,) = score(
        "t", table((Row(label="a"),), (column,)), {("a", 0): run}, scale="demo"
    ).cells.values()
    assert cell.mark == "no value"
    assert "rgbt consistency run=..." in cell.reason


def test_score_failed_seed_keeps_reason() -> None:
    runs = {
        ("a", 0): outcome("k", right(40)),
        ("a", 1): failed("out of memory"),
        ("a", 2): failed("out of memory"),
    }
    cell = score("t", table((Row(label="a"),)), runs, scale="demo").cells["a", "acc"]
    assert (cell.mean, cell.seeds, cell.mark) == (40.0, 1, "failed")
    assert cell.reason == "seeds 1, 2: out of memory"


def test_what_cannot_be_scored_says_why() -> None:
    column = Column(name="x", metric="class/bus")
    runs = {("a", 0): outcome("k", right(40))}
    cell = score("t", table((Row(label="a"),), (ACC, column)), runs, scale="demo").cells["a", "x"]
    assert math.isnan(cell.mean)
    assert cell.mark == "no value"
    assert "no class 'bus'" in cell.reason


def test_score_missing_rows_and_columns_have_no_cells() -> None:
    later = Column(name="TC", needs="flow")
    rows = (Row(label="a"), Row(label="theirs", values={"acc": 3.0, "TC": None}))
    runs = {("a", 0): outcome("k", right(40))}
    scored = score("t", table(rows, (ACC, later)), runs, scale="demo")
    assert set(scored.cells) == {("a", "acc")}
    assert published(rows[1], later) is None
    assert math.isnan(scored.difference(rows[1], ACC))


def test_commits_are_counted_by_run() -> None:
    runs = {
        ("a", 0): outcome("k0", right(1), "aaa"),
        ("a", 1): outcome("k1", right(2), "bbb"),
        ("b", 0): outcome("k0", right(1), "aaa"),
        ("b", 1): outcome("k2", right(1), None),
    }
    rows = (Row(label="a"), Row(label="b"))
    assert score("t", table(rows), runs, scale="demo").commits == {"aaa": 1, "bbb": 1}


def test_misspelt_metric_is_refused_before_anything_runs() -> None:
    row = Row(label="a", experiment="crm")
    bad = table((row,), (Column(name="x", metric="mIou"),))
    with pytest.raises(InputError, match="did you mean 'mIoU'"):
        check_metrics(bad)
    check_metrics(table((row,), (ACC, RGB, LESS)))


def test_score_absent_class_follows_table() -> None:
    """One of two classes has pixels, all right: 100 percent alone, 50 with a zero beside it."""
    column = Column(name="mIoU", metric="mIoU")
    runs = {("a", 0): outcome("k", right(100))}
    for absent, wanted in (("released", 50.0), ("exclude", 100.0)):
        asked = table((Row(label="a", experiment="crm"),), (column,), absent=absent)
        assert score("t", asked, runs, scale="demo").cells["a", "mIoU"].mean == wanted
        # Without a convention of its own the table takes that of the counts.
        counted = {("a", 0): outcome("k", replace(right(100), absent=absent))}
        plain = table((Row(label="a", experiment="crm"),), (column,))
        assert score("t", plain, counted, scale="demo").cells["a", "mIoU"].mean == wanted
