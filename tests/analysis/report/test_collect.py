"""The page's data from a real MLflow store, made once: every number recomputed here by hand."""

from __future__ import annotations

import json
import shutil
import statistics
from collections.abc import Iterator, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from analysis.report import page, tables
from analysis.report.collect import collect
from analysis.report.data import CellEntry, ReportData, RunEntry, TableEntry
from analysis.report.markdown import page_texts
from analysis.report.store import read_store
from analysis.uncertainty import Resampling, compare, estimate
from rgbt.checks import InputError
from rgbt.tracking.mlflow_store import MlflowTracking
from tests.analysis.report.stores import (
    CLASSES,
    RGB_FILE,
    TABLE,
    counts_of,
    fill_store,
    keys_of,
)
from tests.analysis.report.test_page import rows_of, visible

RESAMPLES = 200


def quiet(items: Sequence[Any], what: str) -> Iterator[Any]:
    yield from items


def tracker(runs_dir: Path, **changed: Any) -> MlflowTracking:
    given = {"artifact_uri": None, "experiment": "rgbt", "runs_dir": str(runs_dir)}
    return MlflowTracking(changed.pop("uri", None), **{**given, **changed})


def collected(runs_dir: Path, tracking: Any = None) -> ReportData:
    return collect(tracking or tracker(runs_dir), runs_dir, RESAMPLES, "rgbt report", (), quiet)


@pytest.fixture(scope="module")
def runs_dir(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Folder of runs, filled; the tables of the current folder are in it."""
    here = tmp_path_factory.mktemp("report")
    (here / "tables" / "own").mkdir(parents=True)
    (here / "tables" / "own" / "t.yaml").write_text(TABLE)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(here)
        runs = here / "runs"
        runs.mkdir()
        fill_store(runs, tracker(runs))
        yield runs


@pytest.fixture(scope="module")
def data(runs_dir: Path) -> ReportData:
    return collected(runs_dir)


@pytest.fixture(autouse=True)
def few_tables(data: ReportData, monkeypatch: pytest.MonkeyPatch) -> None:
    """After the first time: reading all published tables takes a second."""
    names = ["spatialseg/table3", "temporal/table1", "temporal/table4"]
    own = tables.table_names

    def some() -> list[str]:
        return [name for name in own() if name in names or name.startswith("own/")]

    monkeypatch.setattr(tables, "table_names", some)


@pytest.fixture
def changeable(runs_dir: Path, tmp_path: Path) -> Path:
    """A copy of the folder; the database still names the artifacts of the first one."""
    return Path(shutil.copytree(runs_dir, tmp_path / "runs"))


def run_of(data: ReportData, key: str) -> RunEntry:
    (run,) = (run for run in data.runs if run.key == key)
    return run


def table_of(data: ReportData, name: str = "own/t") -> TableEntry:
    (table,) = (table for table in data.tables if table.name == name)
    return table


def cell_of(data: ReportData, row: str, column: str) -> CellEntry:
    table = table_of(data)
    return table.cells[table.rows.index(row)][table.columns.index(column)]


def miou(matrix: np.ndarray) -> float:
    """Of one confusion matrix, percent, by a loop."""
    ious = [
        matrix[k, k] / (matrix[k].sum() + matrix[:, k].sum() - matrix[k, k])
        for k in range(len(matrix))
    ]
    return 100 * statistics.fmean(ious)


def test_complete_run_prints_nothing(data: ReportData) -> None:
    assert data.remarks == ()
    assert len(data.runs) == 8
    assert [table.scale for table in data.tables if table.scale] == ["paper"]
    assert data.tables[0].name == "own/t"
    assert "spatialseg/table3" in [table.name for table in data.tables]
    assert [study.name for study in data.studies] == ["search/two"]


def test_a_run_has_scores_of_its_counts(data: ReportData) -> None:
    run = run_of(data, "bb2")
    counts = counts_of(2, 0.8).counts
    by_region = [miou(counts.sum(0)[region]) for region in range(2)]
    assert run.scores["mIoU"] == pytest.approx(miou(counts.sum((0, 1))))
    assert run.scores["region/2"] == pytest.approx(by_region[1])
    assert run.scores["Var"] == pytest.approx(statistics.pvariance(by_region))
    assert run.region_ious == pytest.approx(by_region)
    car = counts.sum(0)[0]
    expected = 100 * car[1, 1] / (car[1].sum() + car[:, 1].sum() - car[1, 1])
    assert run.class_region_ious[1][0] == pytest.approx(expected)
    assert (run.images, run.classes, run.partition) == (12, CLASSES, "ring2")


def test_run_shows_its_provenance(data: ReportData) -> None:
    run = run_of(data, "aa1")
    assert (run.name, run.group, run.scale, run.seed) == (
        "grbm scale=paper seed=1",
        "grbm scale=paper",
        "paper",
        1,
    )
    assert run.commit == "0123456789+"
    assert run_of(data, "aa0").commit == "0123456789"
    assert run.repeat == "python -m rgbt.run +experiment=grbm scale=paper seed=1"
    assert run.command.startswith("/opt/venv/bin/python -m rgbt.run")
    assert run.host == "desk: EPYC, 2 cores"
    assert run.hardware == "EPYC, 2 cores"
    assert run.started == "2026-01-02T00:00:00+00:00"
    assert run.status == "FINISHED"
    assert run.studies == ("search/two",)
    assert run.table_rows == {"own/t": "A"}
    assert run.dataset == "fingerprint"
    assert run.config["masker.sigma_div"] == "4.0"
    assert run.config["masker.ratio"] == "null"
    assert run.config["tracking.uri"] == "postgresql://me:***@host/db"


def test_results_pages_show_claims_and_hide_folders(data: ReportData, runs_dir: Path) -> None:
    assert {each.verdict for each in data.contrasts} == {"Not run: baseline."}
    pages = page_texts(data, ())
    table = pages["own.md"]
    assert "| `b_is_better` | ✓ holds | B - A, mIoU | +" in table
    assert "| B is better than A. (own, TABLE I; paper scale) | ✓ holds |" in pages["index.md"]
    cell = table_of(data, "own/t").cells[0][0]
    assert f"| ours | 3 | {cell.mean:.2f} ± {cell.sd:.2f} |" in table
    assert "(paper scale, `trainer.max_steps=9`)" in table
    assert str(runs_dir) not in "".join(pages.values())


def test_passwords_are_nowhere(data: ReportData) -> None:
    text = json.dumps(asdict(data))
    assert "secret" not in text
    assert ":pw@" not in text


def test_cells_are_means_over_seeds_with_intervals(data: ReportData) -> None:
    cell = cell_of(data, "A", "mIoU")
    values = [miou(counts_of(seed, 0.7).counts.sum((0, 1))) for seed in range(3)]
    assert cell.mean == pytest.approx(statistics.fmean(values))
    assert cell.sd == pytest.approx(statistics.stdev(values))
    assert cell.values == pytest.approx(values)
    assert (cell.seeds, cell.runs) == (3, tuple(keys_of("grbm scale=paper")))
    assert cell.difference == pytest.approx(statistics.fmean(values) - 61.0)
    settings = Resampling(resamples=RESAMPLES)
    expected = estimate([counts_of(seed, 0.7) for seed in range(3)], ["mIoU", "Var"], settings)
    both = expected["mIoU"].both
    assert both is not None
    assert (cell.low, cell.high) == pytest.approx((both.low, both.high))
    assert cell.covers == "images and seeds"
    assert cell.low < cell.mean < cell.high


def test_cells_of_another_evaluation_use_its_counts(data: ReportData) -> None:
    cell = cell_of(data, "B", "rgb")
    values = [miou(counts_of(seed, 0.8 - 0.2).counts.sum((0, 1))) for seed in range(3)]
    assert cell.mean == pytest.approx(statistics.fmean(values))
    assert cell.covers == "images and seeds"


def test_differences_of_columns_are_paired_over_images_and_seeds(data: ReportData) -> None:
    cell = cell_of(data, "B", "drop")
    full = [counts_of(seed, 0.8) for seed in range(3)]
    rgb = [counts_of(seed, 0.8 - 0.2) for seed in range(3)]
    settings = Resampling(resamples=RESAMPLES)
    compared = compare(full, rgb, ["mIoU"], settings, paired=True).differences[0]
    assert compared.difference.both is not None
    assert cell.mean == pytest.approx(compared.value)
    assert cell.mean < 0
    assert (cell.low, cell.high) == pytest.approx(
        (compared.difference.both.low, compared.difference.both.high)
    )
    assert cell.covers == "images and seeds"


def test_the_table_has_marks_and_notes(data: ReportData) -> None:
    table = table_of(data)
    assert (table.number, table.caption, table.scale) == ("TABLE I", "Two masks", "paper")
    assert table.proposed == (False, True, False)
    # B is better than A by ten points and more; no third row is left to be better than.
    assert [cell_of(data, row, "mIoU").rank for row in "ABC"] == [0, 1, 0]
    # The spread of Var over three seeds is as large as the difference: nothing is shown.
    assert [cell_of(data, row, "Var").rank for row in "ABC"] == [0, 0, 0]
    assert table.notes == (
        "A remark of the table.",
        "B: Odd.",
        "As the text describes it.",
        "Every row of ours was run with trainer.max_steps=9.",
    )
    assert table.command == ("rgbt reproduce table=own/t seeds=3 scale=paper trainer.max_steps=9")
    assert cell_of(data, "C", "mIoU") == CellEntry(published=50.0, reason="shown as published only")


def test_claims_of_the_table_are_judged_by_its_runs(data: ReportData) -> None:
    found = {claim.name: claim for claim in table_of(data).claims}
    assert {name: claim.verdict for name, claim in found.items()} == {
        "b_is_better": "holds",
        "a_is_better": "contradicted",
        "both_are_alike": "undecided",
        "c_is_worse": "not run",
    }
    better = found["b_is_better"]
    a, b = ([counts_of(seed, right) for seed in range(3)] for right in (0.7, 0.8))
    scores = [[miou(each.counts.sum((0, 1))) for each in side] for side in (a, b)]
    differences = [second - first for first, second in zip(*scores)]
    assert better.estimate == pytest.approx(statistics.fmean(differences))
    settings = Resampling(resamples=RESAMPLES)
    (wanted,) = compare(a, b, ["mIoU"], settings, paired=True).differences
    both = wanted.difference.both
    assert both is not None
    assert (better.low, better.high) == pytest.approx((both.low, both.high), rel=0.1)
    assert (better.seeds, better.covers) == (3, "images and seeds")
    assert better.runs == (*keys_of("grbm scale=paper"), *keys_of("crm scale=paper"))
    # Printed: 60 for B and 61 for A.
    assert (better.printed, better.as_printed) == (-1.0, False)
    assert (found["a_is_better"].printed, found["a_is_better"].as_printed) == (1.0, True)
    assert found["a_is_better"].estimate == pytest.approx(-better.estimate)
    waiting = found["c_is_worse"]
    assert (waiting.missing, waiting.estimate, waiting.runs) == (("C",), None, ())
    assert (waiting.printed, waiting.as_printed) == (-11.0, True)


def test_seeds_added_until_decided_widen_the_intervals(changeable: Path) -> None:
    """The tag of one run is enough: three seeds are too few for an interval valid at any time."""
    tracking = tracker(changeable)
    read = read_store(tracking, changeable, changeable)
    tagged = [
        replace(each, tags={**each.tags, "rgbt.until_decided/own/t": "true"})
        if each.tags.get("rgbt.key") == "bb0"
        else each
        for each in read
    ]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("analysis.report.collect.read_store", lambda *_: tagged)
        found = collected(changeable)
    table = table_of(found)
    assert [claim.verdict for claim in table.claims] == [*["undecided"] * 3, "not run"]
    assert "seeds=until_decided" in table.command
    assert [cell_of(found, row, "mIoU").rank for row in "AB"] == [0, 0]


def test_tables_not_run_are_listed_with_their_command(data: ReportData) -> None:
    table = table_of(data, "spatialseg/table3")
    assert table.scale == ""
    assert table.command == "rgbt reproduce table=spatialseg/table3 seeds=3 scale=demo"
    cell = table.cells[3][table.columns.index("mIoU")]
    assert (cell.mean, cell.published, cell.runs) == (None, 61.79, ())
    temporal = table_of(data, "temporal/table4")
    cainet = temporal.cells[temporal.rows.index("CAINet")]
    assert cainet[0].reason == "shown as published only"
    columns = table_of(data, "temporal/table1").columns
    assert columns[-4:] == ("TC", "CA", "TC aligned", "CA aligned")
    assert "TC aligned: not in the paper." in table_of(data, "temporal/table1").notes


def test_the_search_has_its_front(data: ReportData) -> None:
    (study,) = data.studies
    assert (study.objectives, study.maximize) == (("val/mIoU", "val/Var"), (True, False))
    assert [trial.on_front for trial in study.trials] == [True, False, True, False]
    assert study.trials[2].values == (52.0, 12.0)
    assert study.trials[3].values == ()
    assert [trial.state for trial in study.trials] == [*["complete"] * 3, "failed"]
    assert study.trials[1].params == {"masker.alpha": "0.25"}
    assert study.trials[1].runs == ("aa1",)
    assert study.command == "python -m rgbt.run -m storage=postgresql://u:***@h/db"
    assert "![" not in study.note
    assert "A remark." in study.note


def test_collected_search_is_on_the_page(data: ReportData) -> None:
    text = page.page_text(data)
    assert "4 trials: 3 complete, 1 failed." in visible(text)
    assert 'data-chart="study-search-two/0"' in text
    assert rows_of(text, "trials of search/two") == [
        ["0", "complete", "50.00", "9.00", "★", "0.0"],
        ["2", "complete", "52.00", "12.00", "★", "0.5"],
        ["1", "complete", "49.00", "10.00", "", "0.25"],
        ["3", "failed", "–", "–", "", "0.75"],
    ]


def test_differences_compare_runs_that_differ_in_nothing_else(data: ReportData) -> None:
    (entry,) = (each for each in data.differences if each.topic == "Learning rate")
    # Two seeds of the released schedule against three of the paper's.
    assert entry.runs == ("aa0", "aa1", "aa2", "cc0", "cc1")
    paper = [counts_of(seed, 0.7) for seed in range(3)]
    released = [counts_of(seed, 0.9) for seed in range(2)]
    value = compare(paper, released, ["mIoU"], Resampling(resamples=RESAMPLES)).differences[0].value
    assert f"Released minus paper: mIoU {value:+.2f} [" in entry.effect
    assert "2 seeds against 3 seeds" in entry.effect
    (other,) = (each for each in data.differences if each.topic == "Logits of RTFNet")
    assert other.effect.endswith("model.final_relu=false,true seed=0,1,2")
    assert other.runs == ()


def test_one_picture_of_the_masker_that_all_runs_share(data: ReportData) -> None:
    (picture,) = data.masks
    assert picture.address.startswith("data:image/webp;base64,")
    assert len(picture.address) <= 40_000
    assert picture.width <= 640
    assert "gaussian_bernoulli" in picture.caption


def test_without_run_folders_the_store_gives_the_same(
    data: ReportData, changeable: Path, runs_dir: Path, tmp_path: Path
) -> None:
    for folder in changeable.glob("??[0-9]"):
        shutil.rmtree(folder)
    uri = f"sqlite:///{changeable / 'mlflow.db'}"
    found = collected(tmp_path / "none", tracker(tmp_path, uri=uri))
    assert found.runs == data.runs
    assert table_of(found) == table_of(data)
    assert found.remarks == ()


def damaged(changeable: Path, key: str, name: str, content: bytes | None) -> ReportData:
    """The data where a file of a run is damaged, or gone here and in the store."""
    path = changeable / key / name
    if content is not None:
        path.write_bytes(content)
        return collected(changeable)
    tracking = tracker(changeable)
    read = read_store(tracking, changeable, changeable)
    (stored,) = (each for each in read if each.tags.get("rgbt.key") == key)
    gone = replace(stored.files, folders=[changeable / key], fetch=None)
    path.unlink()
    others = [each for each in read if each is not stored]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            "analysis.report.collect.read_store",
            lambda *_: [*others, replace(stored, files=gone)],
        )
        return collected(changeable)


@pytest.mark.parametrize("content", [None, b"no counts"])
def test_a_run_without_usable_counts_is_shown_without_scores(
    changeable: Path, content: bytes | None
) -> None:
    found = damaged(changeable, "aa1", "counts_test.npz", content)
    run = run_of(found, "aa1")
    assert (run.scores, run.region_ious, run.images) == ({}, (), 0)
    (remark,) = found.remarks
    assert remark.startswith("Run 'grbm scale=paper seed=1' has no scores: ")
    cell = cell_of(found, "A", "mIoU")
    assert (cell.seeds, cell.low, cell.covers) == (3, None, "none")
    assert "as recorded" in cell.reason
    values = [miou(counts_of(seed, 0.7).counts.sum((0, 1))) for seed in range(3)]
    assert cell.mean == pytest.approx(statistics.fmean(values), abs=1e-6)
    assert cell_of(found, "B", "mIoU").covers == "images and seeds"


def test_a_run_without_configuration_shows_its_parameters(changeable: Path) -> None:
    found = damaged(changeable, "cc0", "config.yaml", b"a: [")
    assert run_of(found, "cc0").config == {"masker.sigma_div": "4.0"}
    (remark,) = found.remarks
    assert "config.yaml cannot be read" in remark


def test_counts_that_differ_from_mlflow_are_reported(changeable: Path) -> None:
    counts_of(5, 0.6).save(changeable / "bb0" / "counts_test.npz")
    found = collected(changeable)
    assert len(found.remarks) == 2
    assert "Run bb0: " in found.remarks[0]
    assert "differ from those in MLflow" in found.remarks[0]
    assert "Table 'own/t' (paper): " in found.remarks[1]
    assert "are not as recorded" in found.remarks[1]


def test_missing_evaluation_affects_only_its_column(changeable: Path) -> None:
    found = damaged(changeable, "bb1", RGB_FILE, None)
    assert cell_of(found, "B", "mIoU").covers == "images and seeds"
    cell = cell_of(found, "B", "rgb")
    assert (cell.low, cell.seeds) == (None, 3)
    assert cell.values[1] is None


def test_a_table_whose_file_is_gone_is_as_recorded(
    runs_dir: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    found = collected(runs_dir)
    table = table_of(found)
    assert table.claims == ()
    assert (table.rows, table.columns[:2]) == (("A", "B", "C"), ("mIoU", "Var"))
    cell = table.cells[0][0]
    values = [miou(counts_of(seed, 0.7).counts.sum((0, 1))) for seed in range(3)]
    assert cell.mean == pytest.approx(statistics.fmean(values), abs=1e-6)
    assert (cell.low, cell.published) == (None, 61.0)
    (remark,) = found.remarks
    assert remark == "Table 'own/t' has no file any more; it is shown as recorded."


def test_unreadable_table_file_is_reported(
    runs_dir: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    (tmp_path / "tables" / "own").mkdir(parents=True)
    (tmp_path / "tables" / "own" / "t.yaml").write_text("paper: [")
    monkeypatch.chdir(tmp_path)
    found = collected(runs_dir)
    assert found.remarks[0].startswith("Table 'own/t' is omitted: ")


def test_an_empty_experiment_makes_a_page_of_published_tables(runs_dir: Path) -> None:
    tracker(runs_dir, experiment="empty").store()
    found = collected(runs_dir, tracker(runs_dir, experiment="empty"))
    assert (found.runs, found.studies, found.masks) == ((), (), ())
    assert all(table.scale == "" for table in found.tables)
    assert found.remarks == ("The store holds no runs yet; tables show what the papers printed.",)


def test_an_unknown_experiment_is_refused_and_not_made(runs_dir: Path) -> None:
    for _ in range(2):
        with pytest.raises(InputError, match=r"no such experiment; did you mean 'rgbt'\?"):
            collected(runs_dir, tracker(runs_dir, experiment="rgb"))
