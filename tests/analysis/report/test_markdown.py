"""The results pages: their texts from plain data, the comparisons from counts, the command."""

from __future__ import annotations

import re
import shlex
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from analysis.report import collect, networks
from analysis.report.__main__ import entry
from analysis.report.contrasts import contrast_entries, verdict
from analysis.report.data import CellEntry, ContrastEntry, FormsEntry, ReportData
from analysis.report.markdown import WIDTH, anchor, command_lines, page_texts, without_paths
from analysis.report.networks import NetworkEntry, network_entries
from analysis.report.page import page_text
from analysis.report.results_file import Contrast, load_results_file
from analysis.report.runs import ReportRun
from analysis.report.store import RunFiles
from analysis.report.views import table_views
from analysis.uncertainty import Resampling, compare
from rgbt.config.compose import available
from rgbt.runs.naming import row_name
from sweeps.table.load_table import PUBLISHED, load_table
from tests.analysis.report.pages import report, run_entry, table_entry
from tests.analysis.report.stores import counts_of
from tests.analysis.report.test_collect import quiet
from tests.analysis.report.test_page import rows_of
from tests.commands import Call

ROOT = Path(__file__).resolve().parents[3]
RESAMPLES = 200
BRANCHES = ("rgb", "thermal")
SIZES = tuple(
    NetworkEntry(each, tuple(float(len(model)) for model in each.models))
    for each in load_results_file().networks
)


@pytest.fixture(scope="module")
def data() -> ReportData:
    contrast = ContrastEntry(
        question="One against the other",
        source="CRM, Table 1",
        reference="baseline",
        method="crm",
        metric="mIoU",
        expected="higher",
        scale="demo",
        values=(50.0, 52.5),
        seeds=(3, 3),
        difference=2.5,
        low=-0.4,
        high=5.4,
        covers="images and seeds",
        p=0.08,
        verdict="Undecided.",
        command="rgbt compare a=baseline b=crm",
    )
    return replace(report(), contrasts=(contrast,))


@pytest.fixture(scope="module")
def pages(data: ReportData) -> dict[str, str]:
    return page_texts(data, SIZES)


def table_lines(text: str) -> list[str]:
    return [line for line in text.splitlines() if line.startswith("|")]


def test_page_texts_equal_data_equal_pages(data: ReportData, pages: dict[str, str]) -> None:
    assert page_texts(data, SIZES) == pages
    papers = {path.name for path in PUBLISHED.iterdir()}
    assert set(pages) == {"index.md", "claims.md", "networks.md", *(f"{p}.md" for p in papers)}


def test_page_texts_later_date_changes_only_the_date(
    data: ReportData, pages: dict[str, str]
) -> None:
    later = page_texts(replace(data, made="2027-01-02T00:00:00+00:00"), SIZES)
    assert later != pages
    assert {name: text.replace("2027-01-02", "2026-11-22") for name, text in later.items()} == pages


def test_index_without_paper_gpu_and_real_data_says_so_first() -> None:
    text = page_texts(replace(report(0), tables=()), ())["index.md"]
    top = text[: text.index("## Where")]
    assert "**Paper scale:** no run." in top
    assert "**GPU:** no run." in top
    assert "**Real data:** no run" in top


def test_index_runs_on_gpu_and_real_data_are_counted() -> None:
    synth = {"dataset._target_": "rgbt.synth.datasets.synth"}
    runs = (
        replace(run_entry(0, 0), hardware="NVIDIA H100", scale="paper", config={}),
        replace(run_entry(0, 1), hardware="EPYC, 2 cores", config=synth),
    )
    text = page_texts(replace(report(0), tables=(), runs=runs), ())["index.md"]
    assert "**Paper scale:** 1 run. All other runs are at demo scale." in text
    assert "**GPU:** 1 run." in text
    assert "**Real data:** 1 run on other data" in text
    assert "| hardware | EPYC, 2 cores, NVIDIA H100 |" in text


def test_page_row_with_runs_shows_mean_spread_interval_and_difference() -> None:
    cell = CellEntry(
        mean=60.5, sd=0.5, seeds=3, low=59.0, high=62.0, published=61.2, difference=-0.7,
        covers="images and seeds", runs=("k",), rank=1,
    )  # fmt: skip
    entry = table_entry("crm/table3a", {})
    cells = (*entry.cells[:-1], (cell,))
    made = replace(entry, scale="demo", cells=cells)
    text = page_texts(replace(report(0), tables=(made,)), ())["crm.md"]
    assert "| Ours | 3 | 60.50 ± 0.50 | [59.00, 62.00] | 61.2 | −0.70 |" in text
    assert "| Baseline | not run (a) | – | – | 59.5 | – |" in text
    assert "Demo scale: compare the verdicts" in text
    # Nothing is marked best: a rank is no evidence.
    assert not any("**" in line or "<u>" in line for line in table_lines(text))


def test_page_without_runs_every_row_says_not_run(pages: dict[str, str]) -> None:
    multihead = pages["multihead.md"]
    section = multihead[multihead.index("## TABLE IV") : multihead.index("## TABLE V\n")]
    labels = [row.label for row in load_table("multihead/table4").rows]
    lines = {line.split(" | ")[0]: line for line in table_lines(section)}
    assert all("not run" in lines[f"| {label}"] for label in labels)
    assert "**No row of this table has been run.**" in section


def test_page_finished_run_without_a_score_says_no_value() -> None:
    entry = table_entry("spatialseg/table3", {})
    gone = tuple(CellEntry(runs=("k",), reason="the file is damaged") for _ in entry.columns)
    made = replace(entry, scale="demo", cells=(gone, *entry.cells[1:]))
    text = page_texts(replace(report(0), tables=(made,)), ())["spatialseg.md"]
    assert "| CRM baseline | ours | – | no value (a) |" in text
    assert "- (a) The file is damaged." in text


def test_page_two_rows_of_the_same_runs_are_noted() -> None:
    cell = CellEntry(mean=60.5, seeds=1, runs=("k",))
    entry = table_entry("crm/table3a", {})
    made = replace(entry, scale="demo", cells=(*entry.cells[:-2], (cell,), (cell,)))
    text = page_texts(replace(report(0), tables=(made,)), ())["crm.md"]
    assert "At scale=demo the same runs as row (4)." in text


def test_page_claims_of_a_table_have_verdicts_places_and_printed_values(
    pages: dict[str, str],
) -> None:
    text = pages["spatialseg.md"]
    section = text[text.index("## TABLE III") : text.index("## TABLE IV")]
    claims = section[section.index("### Claims of the paper about TABLE III") :]
    assert "4 claims: 1 holds, 1 contradicted, 1 undecided, 1 not run." in claims
    contrast = "Ny/4 - CRM baseline, Var"
    assert (
        f"| `true` | ✓ holds | {contrast} | −1.25 | [−2.00, −0.50] | −2.47 | 2.25 | 3 | – |"
        in claims
    )
    assert f"| `open` | ? undecided | {contrast} |" in claims
    said = " ".join(claims.split())
    place = "(Sec. V-C1, second paragraph)"
    assert f"- `true`, **holds**: The statement called true. {place} The printed values" in said
    assert "agree. - `false`" in said
    assert "    - A reading of ours." in claims
    assert "nothing can be shown. - `waiting`, **not run**" in said
    assert f"The printed values do not agree: {contrast} is −2.47. Not run: CRM" in said


def test_index_claims_are_counted_by_paper_and_listed_with_a_verdict(
    pages: dict[str, str],
) -> None:
    text = pages["index.md"]
    section = text[text.index("## Verdicts per claim") : text.index("## Speed")]
    assert "| [crm](crm.md) | demo |" in section
    assert "| [temporal](temporal.md) | – | 5 | 0 | 0 | 0 | 5 | 0 | 5 |" in section
    stated = "| The statement called true. (spatialseg, TABLE III; demo scale) | ✓ holds |"
    assert stated in section
    assert "called waiting" not in section
    assert "Not measured yet" not in section


def test_page_heading_has_overrides_as_code_without_quotes() -> None:
    made = replace(table_entry("crm/table3a", {}), extra="'rows=Baseline,Ours (x)' a=1")
    text = page_texts(replace(report(0), tables=(made,)), ())["crm.md"]
    assert "## Table 3 (a) (`rows=Baseline,Ours (x)` `a=1`)" in text


def test_page_differences_of_the_forms_are_a_table() -> None:
    entry = table_entry("crm/table3a", {})
    forms = FormsEntry(header=("row, column", "shown"), rows=(("Ours, mIoU", "not shown"),))
    made = replace(report(0), tables=(replace(entry, forms=forms, form="both"),))
    text = page_texts(made, ())["crm.md"]
    assert "## Table 3 (a) (both forms)" in text
    assert "| Ours, mIoU | not shown |" in text
    page = page_text(made)
    assert rows_of(page, "forms of table-crm-table3a-both-forms") == [["Ours, mIoU", "not shown"]]


def test_pages_lines_fit_and_links_resolve(data: ReportData, pages: dict[str, str]) -> None:
    for name, text in pages.items():
        long = [line for line in text.splitlines() if len(line) > WIDTH and line[0] != "|"]
        assert not long, f"{name}: {long[0]}"
        assert text.count("\n# ") == 1
        assert "\n\n\n" not in text, name
    for page, wanted in re.findall(r"\((\w+)\.md#([\w-]+)\)", pages["index.md"]):
        if page == "measurements":  # written by hand
            continue
        assert wanted in {anchor(v) for v in table_views(data) if v.entry.name.startswith(page)}


def test_pages_names_of_machines_and_users_are_left_out(pages: dict[str, str]) -> None:
    text = "".join(pages.values())
    assert not re.findall(r"lab-2|/home|/data/lab|/tmp", text)


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("dataset.root=/home/me/MFNet x", "dataset.root=.../MFNet x"),
        ("(/home/me/MFNet)", "(.../MFNet)"),
        ("~/me/MFNet", "~.../MFNet"),
        ("https://host.org/a/b and val/mIoU, ../x/y.md, sweeps/tables/crm", None),
    ],
)
def test_without_paths_absolute_paths_are_cut(text: str, shown: str | None) -> None:
    assert without_paths(text) == (text if shown is None else shown)


def test_command_lines_long_command_is_the_same_command() -> None:
    words = ["rgbt", "compare", "a=one two three", *(f"option_{n}=value" for n in range(12))]
    text = command_lines(shlex.join(words))
    assert len(text.splitlines()) > 1
    assert max(map(len, text.splitlines())) < WIDTH
    assert shlex.split(text.replace("\\\n", " ")) == words


def run_of(group: str, seed: int, right: float, folder: Path | None = None) -> ReportRun:
    made = replace(run_entry(0, seed), key=f"{group}{seed}", group=group, scale="demo")
    counts = counts_of(seed, right)
    files = RunFiles(() if folder is None else (folder,))
    return ReportRun(entry=made, test_counts=counts, absent="released", config={}, files=files)


CLEAN = Contrast(
    question="clean",
    source="own",
    reference="baseline",
    method="crm",
    expected={"mIoU": "higher"},
)
DECLARED = (
    CLEAN,
    replace(CLEAN, question="missing", counts="evaluations/robustness/test/thermal_removed-1.npz"),
    replace(CLEAN, question="loss", reference="grbm", expected={"Var": "lower"}),
)


def entries_of(runs: list[ReportRun]) -> dict[tuple[str, str], ContrastEntry]:
    found = contrast_entries(DECLARED, runs, RESAMPLES, quiet)
    return {(each.question, each.metric): each for each in found}


def test_contrast_entries_two_groups_are_compared_over_images_and_seeds() -> None:
    runs = [run_of("baseline", seed, 0.6) for seed in (0, 1, 2)]
    runs += [run_of("crm scale=demo", seed, 0.8) for seed in (2, 0, 1)]
    found = entries_of(runs)["clean", "mIoU"]
    sides = [[counts_of(seed, right) for seed in (0, 1, 2)] for right in (0.6, 0.8)]
    settings = Resampling(resamples=RESAMPLES, absent="released")
    (wanted,) = compare(*sides, ["mIoU"], settings, paired=True).differences
    both = wanted.difference.both
    assert both is not None
    assert (found.difference, found.low, found.high, found.p) == (
        *(wanted.value, both.low, both.high, wanted.difference.p),
    )
    assert (found.seeds, found.covers) == ((3, 3), "images and seeds")
    assert found.verdict == "Holds."
    assert found.command == "rgbt compare a=baseline b=crm metrics=mIoU"


def test_contrast_entries_missing_runs_and_counts_are_named(tmp_path: Path) -> None:
    runs = [run_of(group, seed, 0.7, tmp_path) for group in ("baseline", "crm") for seed in (0, 1)]
    found = entries_of(runs)
    missing = found["missing", "mIoU"]
    assert missing.verdict.startswith("Not measured: run baseline0 has no evaluations/robustness/")
    assert missing.values is None
    waiting = found["loss", "Var"]
    assert waiting.verdict == "Not run: grbm."


def test_contrast_entries_other_data_sets_are_not_mixed() -> None:
    ours = [run_of("baseline", seed, 0.6) for seed in (0, 1)]
    theirs = [run_of("crm", seed, 0.8) for seed in (0, 1)]
    theirs = [replace(run, entry=replace(run.entry, dataset="other")) for run in theirs]
    found = entries_of(ours + theirs)["clean", "mIoU"]
    assert found.verdict == "Not run: crm."


def test_contrast_entries_seeds_of_one_group_only_are_left_out() -> None:
    """Seed 0 and 1 are in both; the interval is that of their two differences."""
    runs = [run_of("baseline", seed, 0.6) for seed in (0, 1, 3)]
    runs += [run_of("crm", seed, 0.8) for seed in (1, 0, 4)]
    found = entries_of(runs)["clean", "mIoU"]
    assert found.seeds == (2, 2)
    runs = [run_of("baseline", 0, 0.6), run_of("crm", 1, 0.8)]
    found = entries_of(runs)["clean", "mIoU"]
    assert found.verdict == "Not measured: the runs have no seed in common: 0 and 1."


def test_verdict_says_what_the_interval_shows() -> None:
    low, high = ([counts_of(seed, right) for seed in range(3)] for right in (0.6, 0.8))
    settings = Resampling(resamples=RESAMPLES)
    (up,) = compare(low, high, ["mIoU"], settings, paired=True).differences
    assert verdict(up, "higher", 0.95) == "Holds."
    assert verdict(up, "lower", 0.95) == "Contradicted."
    (alone,) = compare(low[:1], high[:1], ["mIoU"], settings, paired=True).differences
    assert verdict(alone, "higher", 0.95) == "Undecided: both methods need two seeds or more."
    again = [counts_of(seed, 0.6) for seed in range(3, 6)]
    (same,) = compare(low, again, ["mIoU"], settings, paired=True).differences
    both = same.difference.both
    assert both is not None
    said = verdict(same, "higher", 0.95)
    assert said.startswith(
        f"Undecided: with these seeds and images, a difference below {both.half:.2f} points "
        "cannot be shown. "
    )
    assert said.endswith((" seeds would show the present difference.", "any number of seeds."))


def test_results_file_names_what_exists() -> None:
    file = load_results_file()
    assert set(file.papers) == {path.name for path in PUBLISHED.iterdir()}
    for contrast in file.contrasts:
        for group in (contrast.reference, contrast.method):
            assert group.split()[0] in available("experiment")
    listed = {model.split()[0] for network in file.networks for model in network.models}
    # The network of model=external is that of the user's checkout.
    assert listed == set(available("model")) - {"external"}
    for network in file.networks:
        assert all((ROOT / test).is_file() for test in network.tests)
        assert all(address.startswith("https://") for _, address in network.weights)


def test_results_file_counts_are_named_as_runs_store_them() -> None:
    folder = "evaluations/robustness/test"
    known = {
        **{f"{folder}/features-{each}.npz": f"corruption=features-{each}" for each in BRANCHES},
        **{
            f"{folder}/{row_name(f'removed:{each}')}-1.npz": f"corruption=removed:{each}"
            for each in BRANCHES
        },
    }
    assert {each.counts: each.options for each in load_results_file().contrasts} == known


def test_network_entries_parameters_are_those_of_the_built_network(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    (mfnet,) = (each for each in load_results_file().networks if each.name == "MFNet")
    only = replace(load_results_file(), networks=(replace(mfnet, models=("mfnet",)),))
    monkeypatch.setattr(networks, "load_results_file", lambda: only)
    (found,) = network_entries(quiet)
    assert found.millions == (pytest.approx(0.736275),)
    text = page_texts(replace(report(0), tables=()), (found,))["networks.md"]
    assert "| MFNet | `model=mfnet` | 0.74 |" in text
    assert "| MFNet | MFNet (final.pth) | <https://github.com/haqishen/MFNet-pytorch> |" in text
    assert "| MFNet | `tests/models/test_golden.py` |" in text


def test_command_markdown_writes_the_pages_and_leaves_others(
    call: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "results"
    out.mkdir()
    (out / "measurements.md").write_text("by hand")

    def fake(*_: Any) -> ReportData:
        return replace(report(0), tables=())

    monkeypatch.setattr(collect, "collect", fake)
    monkeypatch.setattr(networks, "network_entries", lambda track: SIZES)
    code, said, _ = call(entry, "format=markdown", f"out={out}", f"runs_dir={tmp_path}")
    assert code == 0
    assert "index.md" in said
    made = {path.name for path in out.iterdir()}
    assert made == {"measurements.md", "index.md", "claims.md", "networks.md"} | {
        f"{name}.md" for name in load_results_file().papers
    }
    assert (out / "measurements.md").read_text() == "by hand"
