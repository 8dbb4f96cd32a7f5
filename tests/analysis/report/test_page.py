"""The page: one file that loads nothing, with every number, drawn by a real browser."""

from __future__ import annotations

import html
import json
import re
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from analysis.report import page
from analysis.report.data import PagePicture, ReportData
from rgbt.checks import InputError
from tests.analysis.report import pages

HOSTILE = "<img src=x onerror=\"document.title='run'\"></script><script>throw 1</script>\u2028&amp;"
EXTRAS = ("loss.spatial.alpha=1", "loss.spatial.alpha=-1")
CLICKS = Path(__file__).with_name("clicks.js")
CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "chrome"))), None)
browser = pytest.mark.skipif(CHROMIUM is None, reason="no chromium on the PATH")


@pytest.fixture(scope="module")
def data() -> ReportData:
    """60 runs; one of them has a name, and one table a note, that try to be markup.

    The table stands there twice more, run with overrides that differ by a sign.
    """
    made: ReportData = pages.report()
    runs = (replace(made.runs[0], name=HOSTILE, command=HOSTILE), *made.runs[1:])
    table = replace(made.tables[0], notes=(HOSTILE, *made.tables[0].notes))
    again = (replace(made.tables[0], extra=extra) for extra in EXTRAS)
    return replace(made, title=HOSTILE, runs=runs, tables=(table, *again, *made.tables[1:]))


@pytest.fixture(scope="module")
def text(data: ReportData) -> str:
    return page.page_text(data)


def payload(text: str) -> Any:
    (found,) = re.findall(r'<script type="application/json" id="data">(.*?)</script>', text, re.S)
    return json.loads(found)


def unpacked(packed: dict[str, Any]) -> dict[str, Any]:
    """The inverse of `packed`, as the page's script does it."""
    common = packed.pop("common_config")
    for run in packed["runs"]:
        lacks = run.pop("config_lacks")
        run["config"] = {k: v for k, v in (common | run["config"]).items() if k not in lacks}
    return packed


def test_data_in_the_page_is_the_data(data: ReportData, text: str) -> None:
    assert unpacked(payload(text)) == json.loads(json.dumps(data.to_json()))


def test_common_configuration_is_stored_once() -> None:
    configs = [{"lr": "1", "a": "x"}, {"lr": "1", "a": "y", "b": "z"}, {"lr": "2", "a": "y"}]
    packed = page.packed({"title": "t", "runs": [{"config": config} for config in configs]})
    assert packed["common_config"] == {"lr": "1", "a": "y", "b": "z"}
    assert [run["config"] for run in packed["runs"]] == [{"a": "x"}, {}, {"lr": "2"}]
    assert [run["config_lacks"] for run in packed["runs"]] == [["b"], [], ["b"]]
    assert [run["config"] for run in unpacked(packed)["runs"]] == configs


def test_embedded_text_cannot_leave_its_element() -> None:
    plain = {HOSTILE: [HOSTILE, "\u2029", "\udc80", float("inf"), 0.1]}
    written = page.embedded(plain)
    assert written.isascii()
    assert not set("<>&") & set(written)
    assert json.loads(written) == {HOSTILE: [HOSTILE, "\u2029", "\udc80", None, 0.1]}


def test_text_of_the_store_is_nowhere_markup(text: str) -> None:
    assert "<img" not in text
    assert text.count("<script") == text.count("</script>") == 3
    (title,) = re.findall("<title>(.*?)</title>", text)
    assert html.unescape(title) == HOSTILE


def test_page_loads_nothing(text: str) -> None:
    markup = re.sub(r"<script.*?</script>", "", text, flags=re.S)
    assert not re.findall(r"https?://|//cdn|@import|url\(", markup)
    assert re.findall(r'(?:src|href)="([^"#][^"]*)"', markup) == ["data:,"]
    scripts = "".join((page.STATIC / "scripts" / name).read_text() for name in page.SCRIPTS)
    assert set(re.findall(r"https?://[^\"']*", scripts)) == {"http://www.w3.org/2000/svg"}
    assert not re.search(r"\b(fetch|XMLHttpRequest|import)\s*\(|innerHTML|\beval\b", scripts)
    assert "default-src &#39;none&#39;" in text


def test_every_script_is_part_of_the_page() -> None:
    names = {path.name for path in (page.STATIC / "scripts").iterdir()}
    assert names == {*page.SCRIPTS, page.EARLY}
    assert {path.name for path in page.STATIC.glob("*.css")} == set(page.STYLES)


@pytest.mark.skipif(shutil.which("node") is None, reason="no node on the PATH")
def test_scripts_are_javascript(tmp_path: Path) -> None:
    joined = tmp_path / "joined.js"
    joined.write_text("".join((page.STATIC / "scripts" / n).read_text() for n in page.SCRIPTS))
    done = subprocess.run(["node", "--check", joined], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_page_of_60_runs_is_small(text: str) -> None:
    assert len(text.encode()) < 1_000_000  # The issue asks for 5 MB; masks are tiny here.


def test_written_page_replaces_the_old_one(data: ReportData, tmp_path: Path) -> None:
    out = tmp_path / "new" / "report"
    assert page.write_page(data, out) == out / "index.html"
    page.write_page(replace(data, title="second"), out)
    assert "<title>second</title>" in (out / "index.html").read_text()
    assert [path.name for path in out.iterdir()] == ["index.html"]


def test_folder_that_cannot_be_made_is_one_sentence(data: ReportData, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match=r"^out=.*file/report: .*; give a folder"):
        page.write_page(data, tmp_path / "file" / "report")


def test_picture_outside_the_data_is_refused(data: ReportData) -> None:
    far = PagePicture(title="m", caption="", address="https://x.org/m.png", width=1, height=1)
    with pytest.raises(ValueError, match="picture m: https"):
        page.page_text(replace(data, masks=(far,)))


def dump(folder: Path, text: str, script: str = "") -> tuple[str, list[str]]:
    """The document after `text` and then `script` ran in a browser, and what the console says."""
    if script:
        # The page's own policy would refuse what a test puts in.
        text = re.sub(r'<meta http-equiv="Content-Security-Policy"[^>]*>', "", text)
        text = text.replace("</body>", f"<script>{script}</script></body>")
    file = folder / "index.html"
    file.write_text(text)
    done = subprocess.run(
        [
            *(str(CHROMIUM), "--headless=new", "--no-sandbox", "--disable-gpu", "--dump-dom"),
            *("--enable-logging=stderr", "--v=0", "--virtual-time-budget=3000"),
            f"--user-data-dir={folder / 'profile'}",
            file.as_uri(),
        ],
        capture_output=True,
        text=True,
        timeout=60,
        check=True,
    )
    return done.stdout, [line for line in done.stderr.splitlines() if "CONSOLE" in line]


def visible(dom: str) -> str:
    """Text of the document's tables and titles, without its scripts."""
    body = re.sub(r"<script.*?</script>|<style.*?</style>", "", dom, flags=re.S)
    return html.unescape(re.sub(r"<[^>]+>", "", body))


@browser
def test_classes_that_are_left_out_of_means_say_so(data: ReportData, tmp_path: Path) -> None:
    runs = tuple(replace(run, unscored=(run.classes[1],)) for run in data.runs)
    drawn, console = dump(tmp_path, page.page_text(replace(data, runs=runs)))
    assert console == []
    first, second = data.runs[0].classes[:2]
    rows = re.findall(r'<th scope="row">([^<]*)</th>', drawn)
    assert f"{second} (not in means)" in rows
    assert first in rows


@browser
def test_browser_draws_every_value(data: ReportData, text: str, tmp_path: Path) -> None:
    dom, console = dump(tmp_path, text)
    assert console == []
    assert 'data-drawn="yes"' in dom
    assert "<img src" not in dom.replace('<img src="data:image/png', "")
    shown = visible(dom)
    assert HOSTILE.replace("\u2028", "") in shown.replace("\u2028", "")
    for table in data.tables:
        assert all(row in shown for row in table.rows)
        assert all(note in shown for note in table.notes)
        assert table.command in shown
        for cell in (cell for row in table.cells for cell in row):
            wanted = [f"{cell.mean:.2f}", f"[{cell.low:.2f}, {cell.high:.2f}]"] if cell.runs else []
            wanted += [] if cell.published is None else [f"{cell.published:g}"]
            assert all(each.replace("-", "−") in shown for each in wanted)
    assert all(difference.effect in shown for difference in data.differences)
    assert all(f'id="{name}"' in dom for name, _ in page.SECTIONS)


@pytest.fixture(scope="module")
def clicked(text: str, tmp_path_factory: pytest.TempPathFactory) -> Any:
    """What a reader sees who sorts, filters, hides intervals, and clicks a number."""
    if CHROMIUM is None:
        pytest.skip("no chromium on the PATH")
    dom, console = dump(tmp_path_factory.mktemp("clicks"), text, CLICKS.read_text())
    assert console == []
    found = re.search(r'data-result="([^"]*)"', dom)
    assert found is not None, "the clicks did not get to their end"
    return json.loads(html.unescape(found.group(1)))


def test_columns_sort_best_first_then_back(data: ReportData, clicked: Any) -> None:
    table = data.tables[0]
    assert table.name == "spatialseg/table3"

    def order(column: str, sign: int) -> list[str]:
        index = table.columns.index(column)
        pairs = zip(table.rows, table.cells, strict=True)
        return [row for row, _ in sorted(pairs, key=lambda pair: sign * (pair[1][index].mean or 0))]

    assert clicked["asGiven"] == clicked["again"] == list(table.rows)
    assert clicked["highest"] == order("mIoU", -1)
    assert clicked["sorted"].startswith("mIoU")
    assert clicked["lowest"] == order("mIoU", 1)
    assert clicked["lowestVar"] == order("Var", 1)


def test_filter_and_toggles(clicked: Any) -> None:
    assert clicked["filtered"] == ["Ny/16"]
    assert clicked["hidden"] is True
    assert clicked["intervals"] == 0
    assert clicked["intervalsBack"] is True


def test_click_on_a_number_shows_where_it_comes_from(data: ReportData, clicked: Any) -> None:
    table = data.tables[0]
    cell = table.cells[table.rows.index("Ny/4")][table.columns.index("mIoU")]
    runs = [run for key in cell.runs for run in data.runs if run.key == key]
    assert clicked["open"] is True
    assert clicked["panel"] == "Ny/4, mIoU"
    assert clicked["commands"] == [runs[0].repeat, runs[0].command]
    assert clicked["differing"] == clicked["onlyShown"] == ["masker.sigma_div", "seed"]
    assert clicked["onlyLabel"] == "only the 2 that differ"
    assert clicked["third"] == runs[2].repeat
    assert clicked["patch"] == ["masker.patch_size16"]
    assert clicked["hash"] == "#cell=table-spatialseg-table3-demo%2F3%2F5"
    assert clicked["closed"] is True
    assert clicked["focused"] is True
    assert clicked["run"] == data.runs[4].name


def test_keys_that_cannot_matter_stand_in_the_whole_list_alone(clicked: Any) -> None:
    (row,) = clicked["silent"]  # of the fourth row of a table of seven
    assert row.startswith("recipe.demo_steps243")
    assert "240 (3), 241 (3), 242 (3), 244 (3)" in row
    assert clicked["silentMore"] == "2 more are no part of the config key"
    assert clicked["silentMarked"] == 0


def test_tables_run_with_other_overrides_are_told_apart(clicked: Any) -> None:
    assert len(set(clicked["ids"])) == len(clicked["ids"])
    first, second, third = clicked["titles"][:3]
    assert not any(extra in first for extra in EXTRAS)
    assert (second, third) == (f"{first[:-1]} {EXTRAS[0]}#", f"{first[:-1]} {EXTRAS[1]}#")


def test_summary_names_the_best_row_of_those_with_all_seeds(data: ReportData, clicked: Any) -> None:
    table = data.tables[0]
    miou = table.columns.index("mIoU")
    cells = [row[miou] for row in table.cells]
    highest = max(range(len(cells)), key=lambda row: cells[row].mean or 0)
    assert cells[highest].seeds == 2
    whole = [row for row in range(len(cells)) if cells[row].seeds == 3]
    best = max(whole, key=lambda row: cells[row].mean or 0)
    printed = max(range(len(cells)), key=lambda row: cells[row].published or 0)
    shown = dict(zip(clicked["overviewHeads"], clicked["overview"][0], strict=True))
    assert (shown["best of ours"], shown["best published"]) == (
        table.rows[best],
        table.rows[printed],
    )
    assert shown["same?"] == ("✓ yes" if best == printed else "✗ no")


def test_summary_says_where_the_best_published_row_was_not_run(
    data: ReportData, clicked: Any
) -> None:
    table = next(table for table in data.tables if table.name == "multihead/table2")
    assert [row[0].published_rank for row in table.cells if row[0].rank] == [0, 0]
    (shown,) = (row for row in clicked["overview"] if row[0] == "multihead/table2")
    assert shown[-1] == "– not run"


def test_summary_does_not_judge_by_intervals_of_single_rows(clicked: Any) -> None:
    assert "overlap" not in clicked["legend"]
    said = "Intervals of single rows do not answer whether two rows differ; rgbt compare"
    assert said in clicked["legend"]


def test_marks_that_can_be_reached_are_not_inside_a_picture(clicked: Any) -> None:
    assert clicked["focusableInPictures"] == 0
    assert clicked["groups"] == [
        "masks: val/mIoU against val/Var",
        "patch-size/grid: mIoU by trial",
    ]
    assert clicked["trialsInGroups"] == 34 + 12


@browser
def test_empty_store_has_a_page(tmp_path: Path) -> None:
    dom, console = dump(tmp_path, page.page_text(pages.report(num_rows=0)))
    assert console == []
    shown = visible(dom)
    assert "The store has no runs yet." in shown
    assert "Not run yet (25)" in shown
    assert "The store has no studies yet." in shown


FRAME = """
const frame = document.querySelector("iframe");
frame.srcdoc = JSON.parse(document.getElementById("page").textContent);
frame.addEventListener("load", () => {
  const inside = frame.contentDocument;
  inside.querySelectorAll("details").forEach((each) => (each.open = true));
  const list = inside.querySelector(".list-runs");
  document.body.dataset.result = JSON.stringify({
    list: list.scrollWidth - list.clientWidth,
    width: inside.documentElement.scrollWidth, drawn: inside.documentElement.dataset.drawn,
    menu: getComputedStyle(inside.querySelector("nav")).display,
    sticky: getComputedStyle(inside.querySelector("tbody th")).position });
});
"""


def framed(folder: Path, text: str, width: int) -> Any:
    """Measures of the page in a frame: headless windows are 500 pixels wide at least."""
    wrapper = (
        f'<!DOCTYPE html><body><iframe style="width:{width}px;height:800px;border:0"></iframe>'
        f'<script type="application/json" id="page">{page.embedded(text)}</script></body>'
    )
    dom, console = dump(folder, wrapper, FRAME)
    assert console == []
    found = re.search(r'data-result="([^"]*)"', dom)
    assert found is not None
    return json.loads(html.unescape(found.group(1)))


@browser
@pytest.mark.slow
def test_list_of_runs_fits_a_laptop(text: str, tmp_path: Path) -> None:
    result = framed(tmp_path, text, 1280)
    assert result["drawn"] == "yes"
    assert result["list"] == 0


@browser
@pytest.mark.slow
def test_phone_scrolls_tables_and_not_the_page(text: str, tmp_path: Path) -> None:
    result = framed(tmp_path, text, 390)
    assert result.pop("width") <= 390
    assert result.pop("list") > 0
    assert result == {"drawn": "yes", "menu": "none", "sticky": "sticky"}
