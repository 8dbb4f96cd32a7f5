"""Numbers of the page that depend on a choice: absent classes, percent, seeds, duplicate runs."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from analysis.report import collect
from analysis.report.claims import claim_entries, forms_entry, judge_of
from analysis.report.differences import difference_entries, load_choices
from analysis.report.runs import percent_scores
from analysis.report.store import MlflowRun
from analysis.report.tables import cell_of, find_intervals
from analysis.report.tables_recorded import RecordedCell, RecordedTable
from analysis.report.tables_rescored import CountsSource, RescoredTable, score_again
from analysis.uncertainty import Resampling, compare, estimate
from rgbt.metrics.counts import Counts
from rgbt.metrics.named import value
from rgbt.randomness import numpy_generator
from sweeps.table.cells import OWN_COUNTS
from sweeps.table.load_table import load_table
from tests.analysis.report.stores import TABLE, counts_of, files_of
from tests.analysis.report.test_collect_parts import run_of, stored


def quiet(items: Sequence[Any], what: str) -> Iterator[Any]:
    yield from items


def without_a_class(seed: int) -> Counts:
    """A third class that occurs nowhere, so that the two conventions differ."""
    counts = counts_of(seed)
    wide = np.zeros((*counts.counts.shape[:2], 3, 3), np.int64)
    wide[..., :2, :2] = counts.counts
    return replace(counts, counts=wide, classes=(*counts.classes, "cone"))


def test_variances_of_parts_are_no_percent() -> None:
    counts = counts_of(0)
    night = tuple(index % 2 == 0 for index in range(len(counts.names)))
    told = replace(counts, night=night)
    found = percent_scores(told, "released")
    for metric in ("Var", "day/Var", "night/Var", "night/mIoU", "region/1"):
        assert found[metric] == pytest.approx(value(metric, told, "released")), metric


@pytest.mark.parametrize("absent", ["released", "exclude"])
def test_intervals_score_absent_classes_as_the_table_does(absent: Any) -> None:
    runs = {f"k{seed}": run_of({}, seed, without_a_class(seed)) for seed in range(2)}
    asked = (CountsSource(tuple(runs), (OWN_COUNTS,), absent), "mIoU")
    counts = [without_a_class(seed) for seed in range(2)]
    expected = estimate(counts, ["mIoU"], Resampling(resamples=200, absent=absent))["mIoU"]
    assert find_intervals([asked], runs, 200, quiet)[asked].interval == expected.both


def test_differences_score_absent_classes_as_the_runs_do() -> None:
    choice = next(each for each in load_choices() if each.topic == "Learning rate")
    sides = [
        [
            replace(run_of(dict(values), seed, without_a_class(seed + shift)), absent="exclude")
            for seed in range(2)
        ]
        for shift, values in ((0, choice.paper.values), (5, choice.released.values))
    ]
    entries = difference_entries([run for side in sides for run in side], 200, quiet)
    effect = next(each.effect for each in entries if each.topic == choice.topic)
    expected = compare(
        *([run.counts() for run in side] for side in sides),
        metrics=["mIoU"],
        settings=Resampling(resamples=200, absent="exclude"),
    ).differences[0]
    assert expected.interval is not None
    assert f"mIoU {expected.value:+.2f} [{expected.interval.low:+.2f}, " in effect
    assert "not corrected" in effect


def draft(tmp_path: Path, seeds: int, runs: dict[str, Any], text: str = TABLE) -> RescoredTable:
    """Row A with one run per seed, recorded with `seeds` of them."""
    path = tmp_path / "t.yaml"
    path.write_text(text)
    line = RecordedCell(1.0, None, seeds, None, "", tuple(runs))
    recorded = RecordedTable(
        name="own/t",
        scale="paper",
        seeds=tuple(range(seeds)),
        lines={("A", column): line for column in ("mIoU", "rgb", "drop")},
    )
    return score_again(recorded, load_table(str(path)), runs)


def test_a_difference_of_columns_is_first_less_second(tmp_path: Path) -> None:
    run = run_of({}, 0, counts_of(0))
    run._evaluations["evaluations/table_rgb_as-trained.npz"] = counts_of(0, 0.5)
    found = draft(tmp_path, 1, {"k0": run})
    table = found.scored.table
    drop = next(each for each in table.columns if each.name == "drop")
    expected = value("mIoU", counts_of(0, 0.5), "released") - value(
        "mIoU", counts_of(0), "released"
    )
    assert expected < 0
    assert found.values(table.rows[0], drop) == pytest.approx((expected,))


def test_a_mean_of_columns_has_values_and_no_interval(tmp_path: Path) -> None:
    run = run_of({}, 0, counts_of(0))
    run._evaluations["evaluations/table_rgb_as-trained.npz"] = counts_of(0, 0.5)
    text = TABLE.replace("minus: [rgb, mIoU]", "mean: [rgb, mIoU]")
    found = draft(tmp_path, 1, {"k0": run}, text)
    row, column = found.scored.table.rows[0], found.scored.table.columns[3]
    sides = [value("mIoU", counts_of(0, right), "released") for right in (0.5, 0.7)]
    assert found.values(row, column) == pytest.approx((sum(sides) / 2,))
    assert found.scored.cells["A", "drop"].mean == pytest.approx(sum(sides) / 2)
    assert found.interval_key(row, column) is None
    missing = draft(tmp_path, 1, {"k0": run_of({}, 0, counts_of(0))}, text)
    assert missing.values(row, column) == (None,)


def test_counted_parameters_are_as_recorded_and_have_no_marks(tmp_path: Path) -> None:
    path = tmp_path / "t.yaml"
    path.write_text(TABLE)
    lines = {
        ("A", "size"): RecordedCell(54.36, None, 0, None, "", ()),
        ("B", "size"): RecordedCell(44.56, None, 0, None, "", ()),
        ("C", "size"): RecordedCell(None, None, 0, None, "", ()),
    }
    recorded = RecordedTable(name="own/t", scale="demo", seeds=(0,), lines=lines)
    found = score_again(recorded, load_table(str(path)), {})
    assert {place: cell.mean for place, cell in found.scored.cells.items()} == {
        ("A", "size"): 54.36,
        ("B", "size"): 44.56,
    }
    row, column = found.scored.table.rows[0], found.scored.table.columns[-1]
    cell = cell_of(found, row, column, {})
    assert (cell.mean, cell.seeds, cell.reason, cell.rank, cell.runs) == (54.36, 0, "", 0, ())
    assert found.interval_key(row, column) is None


def pairs_of(seed: int) -> Counts:
    """Twelve pairs of frames of one set: 200 pixels of each of two classes, 200 of none."""
    single = counts_of(seed)
    size = (len(single.names), 3)
    drawn = numpy_generator(seed, "pairs").multinomial(200, (0.4, 0.1, 0.1, 0.4), size)
    return replace(single, counts=drawn.reshape(*size, 2, 2), partition="aligned1")


def test_column_of_frames_is_scored_from_its_file(tmp_path: Path) -> None:
    runs = {f"k{seed}": run_of({}, seed, counts_of(seed)) for seed in range(2)}
    for seed, run in enumerate(runs.values()):
        run._evaluations["evaluations/consistency_aligned_test.npz"] = pairs_of(seed)
    ours = "{name: TC, metric: class/car/TC, frames: aligned, printed: false}"
    text = TABLE.replace("{name: size, efficiency: parameters}", ours)
    found = draft(tmp_path, 2, runs, text)
    row, column = found.scored.table.rows[0], found.scored.table.columns[-1]
    expected = [value("class/car/TC", pairs_of(seed), "released") for seed in range(2)]
    assert found.values(row, column) == ()  # recorded without the column
    assert found.scored.cells["A", "TC"].mean == pytest.approx(sum(expected) / 2)
    asked = found.interval_key(row, column)
    source = CountsSource(("k0", "k1"), ("evaluations/consistency_aligned_test.npz",), None)
    assert asked == (source, "class/car/TC")
    wanted = estimate(
        [pairs_of(seed) for seed in range(2)], ["class/car/TC"], Resampling(resamples=200)
    )
    found_interval = find_intervals([asked], runs, 200, quiet)[asked]
    assert found_interval.interval == wanted["class/car/TC"].both


def test_cell_without_a_recorded_seed_has_no_interval(tmp_path: Path) -> None:
    runs = {f"k{seed}": run_of({}, seed, counts_of(seed)) for seed in range(2)}
    table = draft(tmp_path, 2, runs).scored.table
    row, column = table.rows[0], table.columns[0]
    assert draft(tmp_path, 2, runs).interval_key(row, column) is not None
    assert draft(tmp_path, 3, runs).interval_key(row, column) is None


def recorded_rows(tmp_path: Path, text: str, keys: dict[str, tuple[str, ...]]) -> RecordedTable:
    """A record of rows with these runs, each with as many seeds as it has runs."""
    (tmp_path / "t.yaml").write_text(text)
    lines = {
        (row, "mIoU"): RecordedCell(1.0, None, len(of_row), None, "", of_row)
        for row, of_row in keys.items()
    }
    return RecordedTable(name="own/t", scale="demo", seeds=(0, 1, 2), lines=lines)


def test_row_of_decided_claims_needs_fewer_seeds_without_a_reason(tmp_path: Path) -> None:
    runs = {f"k{seed}": run_of({}, seed, counts_of(seed)) for seed in range(3)}
    recorded = recorded_rows(tmp_path, TABLE, {"A": ("k0", "k1", "k2"), "B": ("k0", "k1")})
    found = score_again(recorded, load_table(str(tmp_path / "t.yaml")), runs)
    cells = {label: found.scored.cells[label, "mIoU"] for label in "AB"}
    assert {label: cell.seeds for label, cell in cells.items()} == {"A": 3, "B": 2}
    assert [cell.reason for cell in cells.values()] == ["", ""]


def test_both_forms_have_a_row_each_and_their_difference(tmp_path: Path) -> None:
    text = TABLE.replace("{label: A,", "{label: A, released: {remarks: [Other masks.]},")
    runs = {f"k{seed}": run_of({}, seed, counts_of(seed)) for seed in range(2)}
    made = [counts_of(seed, 0.9) for seed in range(2)]
    runs |= {f"r{seed}": replace(run_of({}, seed, each)) for seed, each in enumerate(made)}
    runs = {key: replace(run, entry=replace(run.entry, key=key)) for key, run in runs.items()}
    keys = {"A": ("k0", "k1"), "A, released": ("r0", "r1")}
    recorded = replace(recorded_rows(tmp_path, text, keys), form="both")
    draft = score_again(recorded, load_table(str(tmp_path / "t.yaml")), runs)
    judge = judge_of(draft, 200)
    assert claim_entries(judge, draft.outcomes) == ()
    entry = forms_entry(judge, draft.outcomes)
    assert entry is not None
    means = [
        sum(value("mIoU", counts_of(seed, right), "released") for seed in range(2)) / 2
        for right in (0.7, 0.9)
    ]
    (row,) = (row for row in entry.rows if row[0] == "A, mIoU")
    assert row[1] == f"{means[1] - means[0]:+.2f}"


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_run_stored_twice_is_shown_finished(
    order: tuple[int, int], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    one: MlflowRun = stored(files_of(tmp_path), rgbt__key="k0")
    both = [replace(one, status="FAILED", run_id="failed"), replace(one, run_id="finished")]

    def opened(each: MlflowRun, remarks: list[str]) -> Any:
        del remarks
        run = run_of({}, 0)
        return replace(run, entry=replace(run.entry, status=each.status, run_id=each.run_id))

    monkeypatch.setattr(collect, "open_run", opened)
    remarks: list[str] = []
    (run,) = collect._open_all([both[index] for index in order], quiet, remarks)
    assert run.entry.run_id == "finished"
    assert "is in the store twice" in remarks[0]
