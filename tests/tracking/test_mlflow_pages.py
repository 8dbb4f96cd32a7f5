"""MLflow's pages in a browser: what its lists and plots show before anybody clicks."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from rgbt.runs.folder import RunFolder
from rgbt.runs.naming import VARIED, describe
from rgbt.tracking.mlflow_upload import read_upload_state
from rgbt.tracking.mlflow_view import view_path
from tests.browser import CHROMIUM, Page, open_page
from tests.composed import specified
from tests.sweeps.servers import mlflow_server
from tests.tracking.test_mlflow import TABLES, client, tracking

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(CHROMIUM is None, reason="Chromium is not installed"),
]

SEARCHED = ("loss.spatial.alpha", "masker.patch_size", "masker.sigma_div")
TRIALS = ((2.6113, 32, 2.3731), (1.8298, 8, 3.5778), (2.5649, 32, 0.9607))
RINGS = [f"IoU{number}" for number in range(1, 6)]
CONSTANT = "trainer.log_every=1"


def trained(folder: RunFolder, words: tuple[str, ...], varied: str, score: float) -> str:
    """Send a run as it goes on, training values first; the id of its MLflow run."""
    method = "spatialseg" if "sigma_div" in varied else "grbm"
    spec = replace(specified((f"+experiment={method}",)), overrides=(CONSTANT, *words))
    tracker = tracking(folder.path.parent)
    tracker.start(folder, describe(spec, {VARIED: varied}))
    folder.append(1, "train", {"loss/class": 3.0, "loss": 5.0})
    tracker.after_step()
    folder.append(1, "val", {"mIoU": score})
    tracker.update()
    rings = {f"region/{number}": score + number / 100 for number in range(1, 6)}
    folder.append(1, "test", {"mIoU": score, "Var": 9.5, "class/car": 0.3, **rings})
    folder.write_tables(TABLES)
    for name in ("panel", "regions"):
        path = folder.figure_path(name)
        cv2.imwrite(str(path), np.full((90, 160, 3), 100 * score, np.uint8))
    folder.finish({"mIoU": score})
    tracker.finish("FINISHED")
    sent = read_upload_state(folder)
    assert sent is not None
    return sent.run_id


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[str]]:
    """A folder of runs, and the MLflow runs of three trials of a search and of two maskers."""
    folder, ids = tmp_path_factory.mktemp("runs"), []
    for number, values in enumerate(TRIALS):
        words = tuple(f"{key}={value}" for key, value in zip(SEARCHED, values, strict=True))
        ids.append(trained(RunFolder(folder / f"trial{number}"), words, " ".join(SEARCHED), 0.4))
    for masker in ("crm", "grbm_paper"):
        ids.append(trained(RunFolder(folder / masker), (f"masker={masker}",), "masker", 0.5))
    return folder, ids


@pytest.fixture(scope="module")
def pages(
    runs: tuple[Path, list[str]], tmp_path_factory: pytest.TempPathFactory
) -> Iterator[tuple[Page, str]]:
    scratch = tmp_path_factory.mktemp("browser")
    with (
        mlflow_server(f"sqlite:///{runs[0] / 'mlflow.db'}", scratch / "artifacts") as url,
        open_page(scratch / "profile") as page,
    ):
        yield page, url


def texts(page: Page, selector: str) -> list[str]:
    """The text of every element that a CSS selector finds."""
    found = page.value(f"[...document.querySelectorAll({selector!r})].map(e => e.innerText.trim())")
    return [str(text) for text in found or ()]


def compare_path(ids: list[str]) -> str:
    runs = json.dumps(ids, separators=(",", ":")).replace('"', "%22")
    return f"/#/compare-runs?runs={runs}&experiments=[%221%22]"


def test_the_list_opens_with_scores_seed_and_method(
    runs: tuple[Path, list[str]], pages: tuple[Page, str]
) -> None:
    page, url = pages
    experiment = client(runs[0]).get_experiment_by_name("rgbt").experiment_id
    assert experiment == "1"
    path = view_path(experiment).replace("&compareRunsMode=CHART", "")
    page.go(url + path, "document.body.innerText.includes('5 matching runs')")
    page.value("document.querySelector('[data-component-id$=\"chat_panel.close\"]').click()")
    cells = (
        "[...document.querySelectorAll('.ag-header-cell')].filter(e => e.innerText.trim()).sort("
        "(a, b) => a.getBoundingClientRect().x - b.getBoundingClientRect().x)"
    )
    page.wait(f"{cells}.length >= 11")
    header = page.value(f"{cells}.map(e => e.innerText.trim())")
    assert header[:2] == ["Run Name", "Created"]
    assert header[2:11] == ["mIoU", "Var", *RINGS, "seed", "rgbt.experiment"]
    widths = page.value(
        "[document.querySelector('.ag-header-viewport').getBoundingClientRect().right, "
        f"{cells}[10].getBoundingClientRect().right]"
    )
    assert widths[1] <= widths[0] + 1, "every column is seen at 1280 pixels"
    names = {text for text in texts(page, "[col-id*='Run Name'] a") if text}
    assert "α 2.61 · patch 32 · σ 2.37 · s0 · spatialseg · log_every 1" in names
    assert "crm · s0 · grbm · log_every 1" in names


def test_trials_are_compared_by_what_varies_and_by_miou(
    runs: tuple[Path, list[str]], pages: tuple[Page, str]
) -> None:
    page, url = pages
    page.go(url + compare_path(runs[1][:3]), "document.querySelector('.js-plotly-plot .parcoords')")
    chosen = texts(page, "[class*='select-selection-item-content']")
    assert chosen == [*SEARCHED, "mIoU"]
    axes = page.value("[...document.querySelectorAll('.axis-title')].map(e => e.textContent)")
    assert axes == [*SEARCHED, "mIoU"]
    settings = texts(page, ".mlflow-compare-run-table tbody tr th")
    assert "trainer.log_every" not in settings, "constants are folded away"
    assert {*SEARCHED, "name", "seed"} <= {*settings}
    scatter = (
        "[...document.querySelectorAll('[role=tab]')].find(e => e.innerText == 'Scatter Plot')"
    )
    page.value(
        f"{scatter}.dispatchEvent(new MouseEvent('mousedown', {{bubbles: true, button: 0}}))"
    )
    page.wait("document.querySelector('.xtitle')")
    titles = page.value("['.xtitle', '.ytitle'].map(e => document.querySelector(e).textContent)")
    assert titles == [SEARCHED[0], "IoU1"]


def test_two_methods_are_compared_by_region_without_a_click(
    runs: tuple[Path, list[str]], pages: tuple[Page, str]
) -> None:
    page, url = pages
    page.go(url + compare_path(runs[1][3:]), "document.querySelector('.js-plotly-plot .parcoords')")
    assert texts(page, "[class*='select-selection-item-content']") == ["masker", "mIoU"]
    assert [text for text in page.text().splitlines() if text in RINGS] == RINGS


def test_the_charts_show_the_profile_and_the_pictures(pages: tuple[Page, str]) -> None:
    page, url = pages
    page.size(1280, 2400)
    page.go(url + view_path("1"), "document.querySelectorAll('.js-plotly-plot').length >= 4")
    page.wait("[...document.images].filter(image => image.naturalWidth > 50).length >= 10")
    assert "profile/iou_by_region" in page.text()
    pictures = page.value("[...document.images].map(image => decodeURIComponent(image.src))")
    assert {name for name in ("panel", "regions") if f"images/{name}+" in str(pictures)} == {
        "panel",
        "regions",
    }
