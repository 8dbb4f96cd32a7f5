"""Own runs at the top of the HTML page: what is shown of them, and how a browser shows it."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from analysis.results import finished_runs
from rgbt.metrics.counts import Counts
from rgbt.metrics.scores import extremes
from rgbt.runs.folder import GROUP, RunFolder
from rgbt.tracking.pictures import write_strip
from rgbt.types import Sample
from sweeps.score.reader import RunReader
from sweeps.show.html import html_page
from sweeps.show.own import own_section
from tests.browser import CHROMIUM, open_page
from tests.measured import remeasured, store
from tests.sweeps.show.planted import plant, set_tag

TABLE3 = {"CRM baseline": (50.0, 51.0), "Ny/4": (60.0,)}
DATASET: Any = SimpleNamespace(classes=("road", "car"), palette=((0, 0, 0), (64, 0, 128)))


def finish(folder: Path, time: int) -> None:
    """Give a planted run what its training leaves: a log, and pictures of three images."""
    run = RunFolder(folder)
    for step in (10, 20):
        run.append(step, "train", {"loss": 1 / step})
        run.append(step, "val", {"mIoU": step / 100})
    lines = [replace(line, time=float(time)).text() for line in run.lines()]
    (folder / "metrics.jsonl").write_bytes(b"".join(lines))
    rng = np.random.default_rng(time)
    for word, (name, _) in extremes(Counts.load(folder / "counts_test.npz")).items():
        rgb = rng.integers(0, 255, (24, 32, 3)).astype(np.uint8)
        label = rng.integers(0, 2, (24, 32)).astype(np.uint8)
        sample = Sample(rgb=rgb, thermal=rgb[..., 0], label=label, name=name)
        write_strip(sample, label, DATASET, run.figure_path(word))


@pytest.fixture(scope="module")
def planted(tmp_path_factory: pytest.TempPathFactory, composed_once: None) -> Path:
    """Three runs of two methods, the last one the newest and measured under corruptions."""
    root = tmp_path_factory.mktemp("own")
    folders = plant(root / "runs", "spatialseg/table3", TABLE3)
    for time, folder in enumerate(folders, 1):
        finish(folder, time)
    counts = Counts.load(folders[-1] / "counts_test.npz")
    shown = {"corruption": "noise", "title": "noise, RGB", "unit": "grey levels"}
    store(folders[-1], counts, severity=8.0, **shown)
    return root / "runs"


@pytest.fixture
def runs(planted: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(planted, tmp_path / "runs"))


def section(runs: Path) -> tuple[dict[str, Any], list[str]]:
    found, remarks = finished_runs(runs, runs / "none"), []
    return own_section(found, RunReader(found), runs, 100, remarks), remarks


def page(own: dict[str, Any], texts: Sequence[str] = ("", "- one")) -> str:
    return html_page({**own, "left": "2 claims and 1 table"}, *texts, {})


def test_newest_run_comes_first_with_its_images_and_charts(runs: Path) -> None:
    own, remarks = section(runs)
    assert remarks == []
    assert own["range"] == " to ".join(sorted(own["range"].split(" to "))), "lowest to highest"
    newest, second, third = own["pictured"]
    assert newest["miou"] > max(second["miou"], third["miou"])
    assert {second["label"][-6:], third["label"][-6:]} == {"seed 0", "seed 1"}
    assert "seed" not in newest["label"]
    assert [image["word"] for image in newest["images"]] == ["best", "median", "worst"]
    of = extremes(newest["counts"])
    assert [(each["name"], float(each["score"])) for each in newest["images"]] == [
        (name, pytest.approx(score, abs=0.005)) for name, score in of.values()
    ]
    (kind,) = own["kinds"]
    titles = ["mIoU by region", "IoU by class", "Learning curves", "mIoU under corruptions"]
    assert [title for title, _ in kind["charts"]] == titles
    text = page(own)
    assert text.index(newest["key"]) < text.index(second["key"])
    assert (
        f"3 runs in the folder of runs, newest first; mIoU on the test images: <b>{own['range']}"
        in text
    )


@pytest.mark.parametrize(
    ("overrides", "named"),
    [
        (("masker.sigma_div=2", "masker.sigma_div=4"), {"grbm · σ 2", "grbm · σ 4"}),
        (("~a.lr", "seed.b=1.23456"), {"grbm · ~a.lr", "grbm · b 1.23"}),
        (("a.lr=1", "b.lr=1"), {"grbm a.lr=1", "grbm b.lr=1"}),  # alike when short
    ],
)
def test_methods_are_named_by_short_words(
    runs: Path, overrides: Sequence[str], named: set[str]
) -> None:
    folders = [path.parent for path in sorted(runs.glob("*/run.json"))]
    shutil.rmtree(folders[2])
    for folder, override in zip(folders, overrides, strict=False):
        set_tag(folder, GROUP, f"grbm {override} scale=bench")
    assert {run["label"] for run in section(runs)[0]["own"]} == named


@pytest.mark.parametrize(
    "names",
    [
        [f"grbm {' '.join(f'a.b{key}={number}' for key in range(50))}" for number in range(3)],
        ["_a", "a", "__"],  # no legend of Matplotlib has a name that begins with "_"
    ],
)
def test_methods_of_long_and_odd_names_stay_apart(runs: Path, names: Sequence[str]) -> None:
    for path, name in zip(sorted(runs.glob("*/run.json")), names, strict=True):
        set_tag(path.parent, GROUP, name)
    (kind,) = section(runs)[0]["kinds"]
    assert [*kind["codes"]] == ["M1", "M2", "M3"]


def test_runs_of_one_seed_are_no_seeds_of_one_method(runs: Path) -> None:
    """Their overrides are alike, and the files of their settings were changed in between."""
    keys = [path.parent.name for path in sorted(runs.glob("*/run.json"))]
    for key, seed in zip(keys, "110", strict=True):
        set_tag(runs / key, GROUP, "grbm")
        set_tag(runs / key, "rgbt.seed", seed)
    own, _ = section(runs)
    assert {run["key"]: run["line"] for run in own["own"]} == {
        keys[0]: f"grbm · {keys[0]}",
        keys[1]: f"grbm · {keys[1]}",
        keys[2]: "grbm",
    }


def test_undefined_scores_and_a_resumed_training_are_said(
    runs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first, second, _ = (path.parent for path in sorted(runs.glob("*/run.json")))
    counts = Counts.load(first / "counts_test.npz")
    matrices = counts.counts.copy()
    matrices[..., 1:, :] = 0  # labels of one class
    undefined = remeasured(replace(counts, counts=matrices), absent="exclude")
    undefined.save(first / "counts_test.npz")
    RunFolder(second).add_provenance({"started": "2026-01-02T00:00:00+00:00"})
    (second / "figures" / "best.png").unlink()
    runs.rename(tmp_path / "my runs")
    monkeypatch.chdir(tmp_path)
    own, _ = section(Path("my runs"))
    text = page(own)
    assert len(own["own"]) == 3
    assert "nan" not in own["range"]
    assert "<b>mIoU - %</b> · variance over regions - ·" in text
    assert text.count(" in the last of 2 processes") == 1
    assert f"<code>rgbt evaluate &#39;run=my runs/{second.name}&#39;</code>" in text


def test_numbers_that_no_axis_holds_are_a_remark(runs: Path) -> None:
    run = RunFolder(next(runs.glob("*/run.json")).parent)
    run.append(10**400, "train", {"loss": 1.0})
    own, remarks = section(runs)
    assert [remark for remark in remarks if remark.startswith("Learning curves: ")]
    assert len(own["kinds"][0]["charts"]) == 3


def test_one_run_is_one_run_and_none_names_a_command(runs: Path, tmp_path: Path) -> None:
    for folder in [path.parent for path in sorted(runs.glob("*/run.json"))][1:]:
        shutil.rmtree(folder)
    assert "<p>1 run in " in page(section(runs)[0])
    assert "rgbt run +experiment=grbm" in page(section(tmp_path / "nothing")[0])


def test_missing_wrong_and_damaged_things_are_named(runs: Path) -> None:
    newest = section(runs)[0]["own"][0]["run"].folder
    figures = newest / "figures"
    (figures / "median.png").unlink()
    (figures / "worst.png").write_bytes((figures / "best.png").read_bytes())
    (newest / "metrics.jsonl").write_text('{"step": 1}\n')
    others = [path.parent for path in runs.glob("*/run.json") if path.parent != newest]
    (others[0] / "figures" / "best.png").write_text("no image")
    (others[1] / "result.json").unlink()
    own, remarks = section(runs)
    assert [remark for remark in remarks if f"Learning curve of {newest.name}" in remark]
    found = {run["key"]: run for run in own["pictured"]}
    assert len(found) == 2
    spoilt = found[newest.name]
    assert spoilt["missing"][0] == "median.png is missing"
    assert spoilt["missing"][1].startswith("worst.png is of '")
    assert spoilt["missing"][1].endswith(": remove it"), "the command draws missing ones alone"
    assert "best.png cannot be decoded" in found[others[0].name]["missing"][0]
    (unfinished,) = own["unfinished"]
    assert unfinished.startswith(f"{others[1].name} is not finished: ")
    assert "step 20 of " in unfinished
    text = page(own)
    assert f"<code>rgbt evaluate run={newest.name}</code>" in text
    assert unfinished.split(":")[0] in text


def test_text_of_a_run_is_no_markup(runs: Path) -> None:
    for path in runs.glob("*/run.json"):
        set_tag(path.parent, GROUP, "_<img src=http://evil.example/x.png> $x^{")
    own, remarks = section(runs)
    assert remarks == []
    image = "![x](http://evil.example/y.png) <b onclick=a>"
    text = page(own, (image, image))
    assert "<img src=http" not in text
    assert 'src="http' not in text
    assert "<b onclick" not in text
    assert "<h2>_&lt;img" in text


LOOK = """(() => {
  const charts = [...document.querySelectorAll("svg.chart")], images = [...document.images];
  const seen = (text) => text.getBBox().width > 0 && text.getBBox().height > 0;
  const loaded = performance.getEntriesByType("resource").map((entry) => entry.name);
  const ink = getComputedStyle(document.querySelector("svg.chart text")).fill;
  return {
    ink,
    width: document.documentElement.scrollWidth,
    pictures: images.length,
    broken: images.filter((i) => !(i.complete && i.naturalWidth && i.alt)).map((i) => i.src),
    charts: charts.length,
    bare: charts.filter((c) => ![...c.querySelectorAll("text")].some(seen)).length,
    first: document.querySelector(".facts b").getBoundingClientRect().bottom,
    loaded: loaded.filter((name) => !name.startsWith("data:")),
    page: getComputedStyle(document.body).backgroundColor,
  };
})()"""


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="Chromium is missing: apt-get install chromium")
def test_page_is_readable_in_a_browser(runs: Path, tmp_path: Path) -> None:
    """At the width of a telephone and of a laptop, in light and dark: whole, and nothing loaded."""
    wide = "| " + " | ".join(f"column {number}" for number in range(30)) + " |\n"
    rest = f"# Runs\n\n{wide}{'|---' * 30}|\n{wide}\n`{'x' * 300}`\n"
    path = tmp_path / "index.html"
    path.write_text(page(section(runs)[0], (rest, "- one")))
    inks = set()
    with open_page(tmp_path / "profile") as shown:
        shown.go(path.as_uri(), "document.readyState == 'complete'")
        for width in (390, 1280):
            for scheme in ("light", "dark"):
                shown.size(width, 800)
                feature = {"name": "prefers-color-scheme", "value": scheme}
                shown.call("Emulation.setEmulatedMedia", features=[feature])
                look = shown.value(LOOK)
                assert look["width"] <= width
                assert (look["broken"], look["bare"], look["loaded"]) == ([], 0, [])
                assert (look["pictures"], look["charts"]) == (36, 4)
                assert look["first"] < 800, "an own number is on the first screen"
                inks.add((scheme, look["ink"], look["page"]))
    assert len(inks) == 2, "a dark page has bright letters in its charts"
    assert len({ink for _, ink, _ in inks}) == len({ground for *_, ground in inks}) == 2
