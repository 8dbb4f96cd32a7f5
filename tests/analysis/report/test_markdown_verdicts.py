"""The page of claims: verdicts by scale and data, what was run, how long, what is not said."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from analysis.report import tables
from analysis.report.claim_views import chosen_data
from analysis.report.data import CellEntry, ReportData, RunEntry, TableEntry
from analysis.report.markdown import WIDTH, page_texts
from sweeps.table.load_table import load_table
from tests.analysis.report.pages import claim, report, run_entry, table_entry
from tests.analysis.report.test_collect import quiet
from tests.analysis.report.test_collect_parts import HEADER, files_of, stored


def run_of(key: str, scale: str, seconds: float, **others: Any) -> RunEntry:
    given = {"group": f"crm scale={scale}", "table_rows": {"crm/table3a": "Ours"}, "config": {}}
    entry = replace(run_entry(0, 0), key=key, scale=scale, seconds=seconds)
    return replace(entry, **{**given, **others})


def table_of(scale: str, keys: tuple[str, ...], extra: str = "", **numbers: Any) -> TableEntry:
    """CRM's Table 3 (a) with a run row and two claims; `numbers` are of the one with a verdict."""
    entry = table_entry("crm/table3a", {})
    cell = CellEntry(mean=50.0, seeds=len(keys), runs=keys)
    judged = claim("gains", "holds", runs=keys, **numbers)
    waiting = claim("waits", "not run")
    cells = (*entry.cells[:-1], (cell,))
    return replace(entry, scale=scale, extra=extra, cells=cells, claims=(judged, waiting))


def page_of(runs: tuple[RunEntry, ...], *entries: TableEntry) -> str:
    data: ReportData = replace(report(0), runs=runs, tables=entries, studies=())
    return page_texts(data, ())["claims.md"]


def section(text: str, title: str) -> str:
    """What follows a heading, up to the next one."""
    return text[text.index(f"## {title}\n") + 2 :].split("\n## ")[0]


RUNS = (
    run_of("b0", "bench", 100.0, seed=0, hardware="EPYC, 2 cores"),
    run_of("b1", "bench", 140.0, seed=1, hardware="EPYC, 2 cores", resumed=True),
    run_of("d0", "demo", 7000.0),
)


def test_claims_page_shows_bench_verdicts_apart_from_those_of_demo() -> None:
    demo = table_of("demo", ("d0",), estimate=-9.0)
    text = page_of(RUNS, demo, table_of("bench", ("b0", "b1"), estimate=3.25))
    said = " ".join(text.split())
    assert "All verdicts below are at bench scale, as of 2026-11-22." in said
    assert "Verdicts at demo scale are on [Results](index.md)." in said
    crm = section(text, "CRM, bench scale")
    assert "2 claims: 1 holds, 0 contradicted, 0 undecided, 1 not run." in " ".join(crm.split())
    assert "| The statement called gains. (Table 3 (a)) | Ny/4 - CRM baseline, Var |" in crm
    assert "| −2.47 | +3.25 | [−3.50, 1.00] | 2.25 | 3 | – | ✓ holds |" in crm
    assert "CRM, demo scale" not in text
    assert "−9.00" not in text


def test_claims_page_with_demo_alone_says_the_scale() -> None:
    text = page_of(RUNS, table_of("demo", ("d0",)))
    assert "All verdicts below are at demo scale" in text
    assert "## CRM, demo scale" in text


def test_claims_page_counts_time_of_the_runs_behind_verdicts() -> None:
    """100 + 140 s are 4 minutes; the run at demo scale is not behind a verdict of this page."""
    tables_ = (table_of("demo", ("d0",)), table_of("bench", ("b0", "b1")))
    what = section(page_of(RUNS, *tables_), "What was run")
    assert "2 runs of 1 arm took 4 min in total on EPYC, 2 cores." in what
    assert "| `crm scale=bench` | crm/table3a: Ours | 2 | 120 s | 4 min |" in what
    assert "- `crm scale=bench`: b0, b1" in what
    assert "1 run was interrupted and resumed; the pauses are counted." in what
    assert "d0" not in what


def test_claims_page_counts_upstream_runs_of_the_same_scale_once() -> None:
    start = {"model.weights": "common:start/last.pt"}
    first = {"model.weights": "experiment:teacher/best.pt"}
    runs = (
        *(replace(run, config=start) for run in RUNS),
        run_of("s0", "bench", 300.0, experiment="start", group="start scale=bench", config=first),
        run_of("t0", "bench", 60.0, experiment="teacher", group="teacher scale=bench"),
        run_of("s1", "demo", 9000.0, experiment="start", group="start"),
    )
    what = section(page_of(runs, table_of("bench", ("b0", "b1"))), "What was run")
    assert "2 runs of 1 arm and 2 upstream runs took 10 min in total" in what
    assert "| `start scale=bench` | upstream run | 1 | 300 s | 5 min |" in what
    assert "| `teacher scale=bench` | upstream run | 1 | 60 s | 1 min |" in what


def test_claims_page_of_other_data_is_another_section() -> None:
    other = "dataset=mfnet dataset.root=/data/x trainer.tested=last"
    real = run_of("r0", "bench", 50.0)
    text = page_of(
        (*RUNS, real),
        table_of("bench", ("b0", "b1"), estimate=1.0),
        table_of("bench", ("r0",), extra=other, estimate=2.0, seeds=8),
    )
    assert "+1.00" in section(text, "CRM, bench scale")
    assert "+2.00" in section(text, "CRM, bench scale, dataset=mfnet")
    index = page_texts(
        replace(report(0), runs=RUNS, tables=(table_of("bench", ("b0",), extra=other),)), ()
    )["index.md"]
    assert "(crm, Table 3 (a); bench scale, dataset=mfnet)" in index


@pytest.mark.parametrize(
    ("extra", "data"),
    [
        ("", ""),
        ("'rows=A,B (x)' trainer.max_steps=2", ""),
        ("dataset.night_light=0.1 dataset=synth", "dataset.night_light=0.1 dataset=synth"),
        ("dataset.root=/a dataset.cache_dir=/b", ""),
    ],
)
def test_chosen_data_are_overrides_of_the_images_without_folders(extra: str, data: str) -> None:
    assert chosen_data(extra) == data


def test_claims_page_says_what_cannot_be_said() -> None:
    synthetic = {"dataset._target_": "rgbt.synth.datasets.synth"}
    runs = tuple(replace(run, config=synthetic) for run in RUNS)
    stuck = table_of("bench", ("b0", "b1"), seeds_needed=float("inf"))
    text = page_of(runs, stuck, table_of("demo", ("d0",)), table_entry("temporal/table2", {}))
    said = " ".join(section(text, "What cannot be said").split())
    assert "**Networks:** all runs are at bench scale" in said
    assert "**Data:** 2 of 2 runs are on synthetic scenes." in said
    assert "**Images:** 1 claim cannot be decided by more seeds" in said
    assert "up to 0.0 would be called holding" in said
    assert "**Not run, CRM, bench scale:** - Table 3 (a): `waits`." in said


def test_claims_page_counts_verdicts_about_one_start() -> None:
    one = table_of("bench", ("b0", "b1"), extra="'rows=A,B (x)' seeds.start=common")
    said = " ".join(section(page_of(RUNS, one), "What cannot be said").split())
    assert "**Start:** the verdict of 1 claim is from runs that all begin with one" in said
    each = section(page_of(RUNS, table_of("bench", ("b0", "b1"))), "What cannot be said")
    assert "**Start:**" not in each


def test_claims_page_names_a_verdict_at_another_scale_beside_a_claim_not_run() -> None:
    bench = table_of("bench", ("b0", "b1"))
    demo = replace(
        table_entry("crm/table4", {}), claims=(claim("falls", "undecided", runs=("d0",)),)
    )
    cells = (*demo.cells[:-1], (CellEntry(mean=1.0, runs=("d0",)),))
    text = page_of(RUNS, bench, replace(demo, scale="demo", cells=cells))
    assert "- Table 4: `falls` (demo scale: undecided)." in section(text, "What cannot be said")


def test_claims_page_without_verdicts_says_so() -> None:
    text = page_of((), replace(table_entry("crm/table3a", {}), claims=(claim("a", "not run"),)))
    assert "**No claim has a verdict yet.**" in text
    assert "## What was run" not in text
    assert "**No verdict at all at any scale:** CRM." in text


def test_claims_page_lines_fit() -> None:
    runs = tuple(run_of(f"{n:012x}", "bench", 9.0, seed=n) for n in range(16))
    text = page_of(runs, table_of("bench", tuple(run.key for run in runs)))
    long = [line for line in text.splitlines() if len(line) > WIDTH and line[0] != "|"]
    assert not long
    assert "\n\n\n" not in text


def test_record_of_a_study_is_judged_by_its_file(tmp_path: Any) -> None:
    """A study that was not run is not listed; one that was has the claims of its file."""
    name = "missing_image"
    assert name not in {each.name for each in tables.table_entries([], {}, 100, quiet, [])}
    csv = HEADER + "".join(f"{name},{label},both,50,,1,,,,a\n" for label in ("Baseline", "CRM"))
    record = stored(
        files_of(tmp_path, table__csv=csv),
        rgbt__table=name, rgbt__scale="bench", rgbt__seeds="0",
    )  # fmt: skip
    remarks: list[str] = []
    made = tables.table_entries([record], {}, 100, quiet, remarks)[0]
    assert {each.name for each in made.claims} == {each.name for each in load_table(name).claims}
    assert (made.paper, made.scale) == ("studies", "bench")
    assert not [remark for remark in remarks if "no file" in remark]
    pages = page_texts(replace(report(0), tables=(made,)), ())
    assert "## Missing image (bench scale, `rows=Baseline,CRM`)" in pages["studies.md"]
