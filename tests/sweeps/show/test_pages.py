"""The pages of results from planted runs: values, verdicts, what they rest on, and remarks."""

from __future__ import annotations

import base64
import hashlib
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from html.parser import HTMLParser
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import pandas as pd
import pytest
import yaml

from analysis.archive import _compared, add
from rgbt.checks import InputError
from rgbt.metrics.counts import Counts
from rgbt.runs.folder import GROUP, RunFolder
from rgbt.runs.result import RunResult
from sweeps.report import entry
from sweeps.score.reader import RunReader
from sweeps.show.pages import Report
from sweeps.show.sections import runs_section
from tests.analysis.counts import result_of
from tests.commands import Call
from tests.measured import remeasured
from tests.models.external.standins import STACKED, write_checkout
from tests.sweeps.show.planted import plant, set_tag

PAPERS = ("crm", "multihead", "spatialseg", "temporal")

OWN = """
paper: my
number: planted
caption: outcomes that are known
data: nothing
confirm: [0, 1, 2]
columns: [{name: acc, metric: pixel_accuracy}]
claims:
  - {name: true_one, says: High is above low., source: Sec. I, rows: [high], against: [low],
     columns: [acc], expected: higher}
  - {name: false_one, says: Low is above high., source: Sec. II, rows: [low], against: [high],
     columns: [acc], expected: higher, remarks: [A reading of ours.]}
  - {name: alike, says: High does as well as low., source: Sec. III, rows: [high], against: [low],
     columns: [acc], expected: similar, at_most: 1.0}
  - {name: waits, says: Theirs is below low., source: Sec. IV, rows: [theirs], against: [low],
     columns: [acc], expected: lower}
rows:
  - {label: low, experiment: baseline, values: {acc: 50.0}}
  - {label: high, experiment: baseline, overrides: [masker=crm], values: {acc: 60.0}}
  - {label: theirs, values: {acc: 40.0}}
"""
SHARES = {"low": (50.0, 51.0, 49.0), "high": (60.0, 61.0, 59.0)}
TABLE3 = {"CRM baseline": (50.0, 51.0, 49.0), "Ny/4": (60.0, 61.0, 59.0)}


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory, composed_once: None) -> Path:
    """A folder with a table of the user, and with runs of it and of a paper's table."""
    folder = tmp_path_factory.mktemp("report")
    (folder / "tables" / "my").mkdir(parents=True)
    (folder / "tables" / "my" / "planted.yaml").write_text(OWN)
    (folder / "tables" / "without").mkdir()
    without = {**yaml.safe_load(OWN), "paper": "without", "claims": []}
    (folder / "tables" / "without" / "claims.yaml").write_text(yaml.safe_dump(without))
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        plant(folder / "runs", "my/planted", SHARES)
        plant(folder / "runs", "spatialseg/table3", TABLE3, scale="bench")
        common = "seeds.start=common"
        plant(folder / "runs", "spatialseg/table3", TABLE3, common, scale="bench")
    return folder


@pytest.fixture(autouse=True)
def inside(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(place)


def made(runs: Path = Path("runs"), archive: Path = Path("none")) -> Report:
    return Report(runs, archive, 200, counted=False)


@pytest.fixture(scope="module")
def report(place: Path) -> Report:
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(place)
        return made()


@pytest.fixture(scope="module")
def html(report: Report, place: Path) -> str:
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(place)
        return report.html()


def section(text: str, heading: str) -> str:
    """What follows a heading, up to the next one of its level."""
    level = heading.partition(" ")[0]
    return text[text.index(f"{heading}\n") + 1 :].split(f"\n{level} ")[0]


def test_own_table_shows_values_verdicts_and_their_basis(report: Report) -> None:
    text = section(report.page("my"), "## planted (scale=demo)")
    assert "| low | ours | 3 | 49.92 ± 1.31 |\n|  | published |  | 50 |\n" in text
    assert "|  | difference |  | -0.08 |" in text
    assert "4 claims: 1 same direction, 2 opposite direction, 1 not run; 3 by declared" in text
    basis = "synthetic scenes, scale=demo, a start for each seed"
    line = next(line for line in text.splitlines() if line.startswith("- `true_one`"))
    assert "**Same direction** on synthetic scenes: +9.87 [+8.02, +11.72], which includes" in line
    assert "the printed +10.00; confirmation by 3 declared seeds. (Sec. I) The printed" in line
    assert f" high - low, acc; {basis}." in line
    assert "Alike means within 1." in text
    assert "    - A reading of ours." in text
    assert "- `waits`: Theirs is below low. **Not run.** (Sec. IV)" in text
    assert "rgbt reproduce table=my/planted seeds=3\n" in text


@pytest.mark.slow
def test_rows_of_a_missing_checkout_are_found_by_settings(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    write_checkout(tmp_path / "Net", {"model/net.py": STACKED})
    own, rows = yaml.safe_load(OWN), []
    for label, lr in (("low", 0.1), ("high", 0.2)):
        words = ["model=external", "model.checkout=Net", "model.constructor=model.net:Net"]
        rows.append(
            {"label": label, "experiment": "mfnet", "overrides": [*words, f"optimizer.lr={lr}"]}
        )
    table = {**own, "claims": own["claims"][:1], "rows": rows}
    (tmp_path / "tables" / "my").mkdir(parents=True)
    (tmp_path / "tables" / "my" / "net.yaml").write_text(yaml.safe_dump(table))
    for folder in plant(tmp_path / "runs", "my/net", SHARES, scale="paper"):
        add(RunResult(folder), tmp_path / "archive")
    here = made().page("my")
    assert "| high | ours | 3 | **59.79 " in here
    shutil.rmtree(tmp_path / "Net")
    assert made().page("my") == here
    assert made(Path("none"), tmp_path / "archive").page("my") == here
    assert [state for _, state, _, _ in _compared(tmp_path / "archive")] == ["same"] * 6
    (tmp_path / "tables" / "my" / "net.yaml").write_text(
        yaml.safe_dump(table).replace("0.2", "0.3")
    )
    assert "| high | ours |" not in made().page("my")


def test_runs_of_one_start_are_apart_with_a_warning(report: Report) -> None:
    text = report.page("spatialseg")
    own = section(text, "## TABLE III (scale=bench)")
    one = section(text, "## TABLE III (scale=bench, seeds.start=common)")
    assert "exploration with 3 seeds, not confirmed" in own
    assert "a start for each seed" in own
    assert "began from one start" not in own
    assert "one start for all seeds, seeds.start=common." in one
    assert one.count("All seeds began from one start") == one.count(", one start for all seeds")
    assert "Every row of ours was run with seeds.start=common." in one
    assert "seeds=3 scale=bench seeds.start=common" in one
    limits = section(report.page("claims"), "## What the verdicts do not say")
    assert re.search(r"\*\*Start:\*\* the verdict of \d+ claims is from one start", limits)
    assert "is on synthetic scenes" in limits
    assert "no verdict is at paper scale" in limits


def test_claims_are_counted_once_and_shown_for_every_basis(report: Report) -> None:
    found = report.claims[report.claims["table"] == "spatialseg/table3"]
    assert found["claim"].is_unique
    page = section(report.page("claims"), "## SpatialSeg")
    titles = [line for line in page.splitlines() if line.startswith("**")]
    assert len(titles) == 2, "verdicts of several bases are in several tables"
    assert {"a start for each seed" in title for title in titles} == {True, False}
    assert "| verdict | claim | ours | printed | size | seeds | would decide |" in page
    row = next(line for line in report.page("claims").splitlines() if line.startswith("| crm |"))
    assert [cell.strip() for cell in row.split("|")][-4:-1] == ["24", "0", "22 of 23"]


def test_index_has_runs_with_seeds_spread_and_time(report: Report) -> None:
    text = report.page("index")
    assert "**6 runs on synthetic scenes, scale=demo, 6 min in all**" in text
    assert text.index("## Claims by verdict") < text.index("## Runs") < text.index("| git commit |")
    line = next(line for line in text.splitlines() if line.startswith("| `baseline` |"))
    cells = [cell.strip() for cell in line.split("|")]
    assert cells[2] == "0, 1, 2"
    found = re.fullmatch(r"(\d+\.\d\d) ± \d+\.\d\d", cells[3])
    assert found is not None
    assert float(found[1]) > 10, "in percent"
    assert cells[-3:-1] == ["61 s", "my/planted"]
    assert "| git commit | 0123456789 |" in text
    assert "desk" not in text


def test_html_puts_own_results_first_and_folds_the_rest(html: str) -> None:
    parts = ("mIoU by region", "Runs</h2>", "planted (scale=demo)", "Claims</h2>")
    parts = (*parts, "No run yet: ", "TABLE IV: ", "Temporal: claims without a verdict")
    assert sorted(parts, key=html.index) == [*parts]
    assert re.search(r"No run yet: [0-9]+ claims and [0-9]+ tables", html)
    folded = re.findall(r"<details><summary>([^<]*)</summary>", html)
    assert folded[-1] == "Tables and claims without a run"
    assert "What the words mean" in folded
    assert "planted (scale=demo)" not in folded
    assert "needs: " not in html, "a comment for the tests of the pages"
    assert html.count("<details") == html.count("</details>")


class Loaded(HTMLParser):
    """Addresses that a page loads, and its scripts."""

    def __init__(self) -> None:
        super().__init__()
        self.addresses: list[str] = []
        self.tags: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.addresses += [value or "" for name, value in attrs if name in ("src", "data")]


def test_html_loads_nothing_and_runs_its_own_script(html: str) -> None:
    found = Loaded()
    found.feed(html)
    assert found.tags.count("script") == 1
    assert found.addresses == [], "planted runs have no pictures"
    assert found.tags.count("svg") > 5
    script = re.search(r"<script>(.*)</script>", html, re.DOTALL)
    assert script is not None
    digest = base64.b64encode(hashlib.sha256(script[1].encode()).digest()).decode()
    assert f"script-src 'sha256-{digest}'" in html.replace("&#39;", "'")


ODD: dict[str, Callable[[Path], object]] = {
    "seed": lambda run: set_tag(run, "rgbt.seed", "nan"),
    "tags": lambda run: (run / "run.json").write_text('{"name": 1, "tags": [], "params": {}}'),
    "config": lambda run: (run / "config.yaml").write_text("- [a list"),
    "counts": lambda run: (run / "counts_test.npz").write_bytes(b"PK damaged"),
    "time": lambda run: (run / "provenance.json").write_text("[7]"),
    "seconds": lambda run: (run / "result.json").write_text('{"seconds_of_last_process": "x"}'),
}


def test_odd_records_are_remarks_and_not_the_end(
    place: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree(place / "runs", tmp_path / "runs")
    folders = [path.parent for path in sorted((tmp_path / "runs").glob("*/run.json"))]
    chosen = [folder for folder in folders if "table3" in (folder / "run.json").read_text()]
    for folder, spoil in zip(chosen, ODD.values(), strict=False):
        spoil(folder)
    found = made(tmp_path / "runs")
    said = found.page("index") + capsys.readouterr().err
    for folder, kind in zip(chosen, ODD, strict=False):
        assert folder.name in said, kind
    assert "| high | ours | 3 |" in found.page("my")


def test_folds_of_a_data_set_are_seeds_of_one_method(place: Path, tmp_path: Path) -> None:
    chosen = [path for path in (place / "runs").glob("*/run.json") if "my/pl" in path.read_text()]
    for path in chosen:
        folder = Path(shutil.copytree(path.parent, tmp_path / path.parent.name))
        tags = RunResult(folder).tags
        seed, row = tags["rgbt.seed"], tags["rgbt.table/my/planted"]
        set_tag(folder, GROUP, f"{row} dataset=mine_fold{seed} dataset.root=a_fold1/b")
        counts = remeasured(Counts.load(folder / "counts_test.npz"), dataset=seed)
        counts.save(folder / "counts_test.npz")  # each has images of its own
        result = {**RunResult(folder).result, **result_of(folder.name, counts)}
        RunFolder(folder).finish(result)
    runs = [RunResult(folder) for folder in sorted(tmp_path.iterdir())]
    (grid,) = runs_section(runs, RunReader(runs), [])["runs"]
    assert "| `low` | 0, 1, 2 | " in grid
    assert "All of them with `dataset=mine dataset.root=a_fold1/b`." in grid
    for run in runs:
        set_tag(run.folder, GROUP, f"low masker=mine_fold{run.tags['rgbt.seed']}")
    runs = [RunResult(run.folder) for run in runs]
    (grid,) = runs_section(runs, RunReader(runs), [])["runs"]
    assert "| `low masker=mine_fold1` | 1" in grid, "that is another method"


def test_runs_whose_keys_have_changed_are_a_remark(place: Path, tmp_path: Path) -> None:
    for number, path in enumerate(sorted((place / "runs").glob("*/run.json"))):
        if "my/planted" in path.read_text():
            shutil.copytree(path.parent, tmp_path / "runs" / f"{number:012d}")
    text = made(tmp_path / "runs").page("index")
    assert "No run that is tagged with 'my/planted' has the key of a row today." in text


@pytest.mark.slow
def test_text_of_run_is_no_markup_without_folders(place: Path, tmp_path: Path) -> None:
    shutil.copytree(place / "runs", tmp_path / "runs")
    files = sorted((tmp_path / "runs").glob("*/run.json"))
    file = next(file for file in files if "my/planted" in file.read_text())
    set_tag(file.parent, "rgbt.group", "<script>alert(1)</script> /home/me/secret/data | x")
    found = made(tmp_path / "runs")
    page = found.html()
    assert "<script>alert" not in page + found.page("index")
    assert "/home/me" not in page
    assert "&amp;lt;script&gt;alert(1)" in page


@pytest.mark.slow
def test_archive_gives_same_pages_and_run_changes_them(
    report: Report, place: Path, tmp_path: Path
) -> None:
    archive = tmp_path / "results"
    folders = [path.parent for path in sorted((place / "runs").glob("*/run.json"))]
    for folder in folders:
        add(RunResult(folder), archive)
    names = ("index", "claims", "spatialseg", "my", "crm")
    own = made(Path("none"), archive)
    pages = {name: own.page(name) for name in names}
    assert pages == {name: report.page(name) for name in names}
    assert own.images == report.images, "equal runs give equal figures"
    gone = next(f for f in folders if "rgbt.table/my/planted" in RunResult(f).tags)
    (archive / f"{gone.name}.zip").unlink()
    less = made(Path("none"), archive)
    changed = {name for name in names if less.page(name) != pages[name]}
    assert {"index", "claims", "my"} <= changed, "tables that share the run change too"
    assert "spatialseg" not in changed


MARKS = """
<!-- results:count -->stale<!-- /results --> claims,
<!-- results:count runs -->stale<!-- /results --> runs.
<!-- results:signs -->stale<!-- /results -->
<!-- results:claim my/planted true_one -->stale<!-- /results -->
<!-- results:cell my/planted acc low -->stale<!-- /results --> points.
<!-- results:effects spatial_bias centre -->stale<!-- /results -->
"""


def test_marked_numbers_are_made_again_and_nothing_else(report: Report) -> None:
    text = report.filled(MARKS)
    assert "<!-- results:count -->162<!-- /results --> claims," in text  # 158 of the papers, 4
    assert f"count runs -->{len(report.runs)}<!-- /results --> runs." in text
    assert "High is above low. **Same direction** on synthetic scenes: +9.87" in text
    assert "signs -->on synthetic scenes at scale=bench, " in text
    assert "scale=demo, 1 of 1 contrasts" not in text, "one contrast is no share"
    assert "acc low -->49.92 ± 1.31<!-- /results --> points." in text
    assert "No run yet: `rgbt reproduce table=spatial_bias rows=tested" in text
    assert report.filled(text) == text
    assert "stale" not in text
    for wrong in (
        "claim my/planted none",
        "cell my/planted acc none",
        "nothing x",
        "effects crm/table1 x",
    ):
        with pytest.raises(InputError, match=wrong.split()[0]):
            report.filled(f"<!-- results:{wrong} --><!-- /results -->")


def test_empty_archive_says_so_with_the_command(tmp_path: Path) -> None:
    found = made(tmp_path, tmp_path)
    assert "No run yet." in found.page("index")
    assert "rgbt reproduce table=missing_image scale=bench seeds=4" in found.page("index")
    assert "158 not run" in found.page("claims") or "| temporal |" in found.page("claims")
    assert found.images == {}
    for paper in PAPERS:
        assert "<summary>" in found.page(paper)


@pytest.mark.slow
def test_command_writes_pages_fills_marks_and_removes_old_figures(
    call: Call, place: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sweeps.show.sections.million_parameters", lambda words: 1.0)
    out, page = tmp_path / "out", tmp_path / "README.md"
    out.mkdir()
    (out / "stale.svg").touch()
    (out / "measurements.md").write_text("by hand")
    page.write_text(MARKS)
    words = (f"out={out}", "format=markdown", f"fill={page}", "resamples=200")
    code, said, err = call(entry, *words)
    assert code == 0, err
    assert {path.stem for path in out.glob("*.md")} == {
        *(
            "index",
            "claims",
            "agreement",
            "real-images",
            "field",
            "networks",
            "studies",
            "my",
            "without",
            "measurements",
            *PAPERS,
        )
    }
    found = {path.name for path in out.glob("*.svg")}
    assert {"my-planted_demo.svg", "spatialseg-table3_bench-20e4b0.svg"} <= found
    assert "stale.svg" not in found
    assert "stale" not in page.read_text()
    for wrong in ("resamples=10", "format=pdf", f"out={page}"):
        assert call(entry, wrong)[0] == 2


@pytest.mark.slow
def test_report_needs_no_torch(place: Path, tmp_path: Path) -> None:
    code = (
        f"import sys; sys.argv = ['report', 'out={tmp_path}', 'resamples=200']\n"
        "import sweeps.report as m\n"
        "try: m.entry()\n"
        "except SystemExit as end: print(end.code, {'torch', 'mlflow'} & set(sys.modules))"
    )
    here = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[3])}
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=place,
        env=here,
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.strip().endswith("0 set()"), done.stderr
    assert (tmp_path / "index.html").is_file()


def test_a_claim_is_shown_where_it_is_judged_best() -> None:
    """Judged comes before the scale, the scale before declared seeds, these before their number."""

    def claim(verdict: str, scale: str, basis: str, seeds: int) -> dict[str, object]:
        known = {"verdict": verdict, "scale": scale, "basis": basis, "seeds": seeds}
        return {"table": "p/t", "claim": "c", **known}

    bench = claim("not shown", "bench", "exploration", 6)
    declared = claim("same direction", "bench", "confirmation", 4)
    real = claim("same direction", "real", "exploration", 1)
    empty = claim("not run", "real", "", 0)
    for every, expected in (
        ([declared, empty], declared),
        ([declared, bench], declared),
        ([real, declared, empty], real),
    ):
        of_report = SimpleNamespace(every=pd.DataFrame(every))
        found = Report._decisive_claims(cast("Report", of_report))
        assert found[list(expected)].to_dict("records") == [expected]


def test_a_page_of_printed_numbers_shows_them_without_a_verdict(report: Report) -> None:
    text = report.page("field")
    assert text.splitlines()[1] == "# The field: printed numbers"
    for words in ("tables beside", "claims", "contrasts", "not run", "ours"):
        assert words not in text
    (row,) = (line for line in text.splitlines() if line.startswith("| CFDHI-Net"))
    assert row.split("|")[-2].strip() == "61.50"
    assert "trained on train and val" in text
    assert "](field.md)" in report.page("index")
    assert "field" not in report.page("claims")
    # A table of a paper without runs is one that could be run.
    assert "Tables that were not run" in report.page("temporal")
