"""The command: the list, what each figure needs, and one file per figure."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from analysis.figures.__main__ import entry
from analysis.figures.inputs import FIGURES
from analysis.predictions.scoring import score_folder
from analysis.statistics.collect import SpatialStatistics
from rgbt.data.mfnet import MFNet
from rgbt.metrics.counts import Counts
from rgbt.runs.folder import RunFolder
from tests.analysis.counts import counts_of
from tests.analysis.figures.drawn import statistics, strips
from tests.analysis.figures.framed import write_framed
from tests.analysis.robust_runs import SCORES, write_levels, write_run
from tests.analysis.uncertainty.simulated import pairs_of
from tests.commands import Call
from tests.measured import remeasured

NAMES = [f"{index:05d}{'DN'[index % 2]}" for index in range(12)]


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a data set, predictions of two methods, their scores, and statistics."""
    folder = tmp_path_factory.mktemp("made")
    _write_dataset(folder / "mf")
    dataset = MFNet(str(folder / "mf"))
    for method, shift in (("a", 0), ("b", 1)):
        (folder / method).mkdir()
        for index, name in enumerate(NAMES):
            label = dataset.read(name).label
            assert label is not None
            wrong = (label + shift * (np.arange(96) < index)) % 9
            cv2.imwrite(str(folder / method / f"{name}.png"), wrong.astype(np.uint8))
        scored = score_folder(folder / method, dataset, "test", regions=5)
        scored.save(folder / method)
    labels = np.random.default_rng(0).integers(0, 3, (20, 64, 96), dtype=np.uint8)
    night = np.arange(20) % 2 == 0
    measured = statistics(labels, strips(5, "ring"), night)
    replace(measured, fingerprint=dataset.fingerprint()).save(folder / "statistics.npz")
    for method, agree in (("a", 0.5), ("b", 0.7)):
        pairs_of(12, agree).save(folder / method / "pairs.npz")
        write_levels(folder / method / "failing", SCORES)
    write_framed(folder / "framed")
    write_run(folder, "run", "trained", 0, SCORES)
    RunFolder(folder / "run").append(10, "train", {"loss": 1.0})
    return folder


def _write_dataset(root: Path) -> None:
    rng = np.random.default_rng(0)
    for folder in ("images", "labels"):
        (root / folder).mkdir(parents=True)
    for split in ("train", "test"):
        (root / f"{split}.txt").write_text("\n".join(NAMES))
    for name in NAMES:
        pair = rng.integers(0, 256, (64, 96, 4), dtype=np.uint8)
        cv2.imwrite(str(root / "images" / f"{name}.png"), pair)
        label = np.kron(rng.integers(0, 9, (4, 6), dtype=np.uint8), np.ones((16, 16), np.uint8))
        cv2.imwrite(str(root / "labels" / f"{name}.png"), label)


def arguments(figure: str, folder: Path) -> list[str]:
    """What draws `figure` from the files of `made`."""
    given = {
        "dataset": ["dataset=mfnet", f"dataset.root={folder / 'mf'}"],
        "map folder": [f"maps={folder / 'a'}"],
        "statistics": [f"statistics={folder / 'statistics.npz'}"],
        "statistics folder": [f"statistics={folder}"],
        "methods": [f"methods=A:{folder / 'a'},B:{folder / 'b'}"],
        "one": [f"methods=A:{folder / 'a'}"],
        "pairs": [f"runs=A:{folder / 'a' / 'pairs.npz'},B:{folder / 'b' / 'pairs.npz'}"],
        "runs": [
            f"runs=A:{folder / 'a' / 'counts_ring5.npz'},B:{folder / 'b' / 'counts_ring5.npz'}"
        ],
        "failing": [f"runs=A:{folder / 'a' / 'failing'},B:{folder / 'b' / 'failing'}"],
        "fast": ["resamples=100", "blocks=none"],
        "chosen": ["names=00011N,00010D"],
        "columns": ["layout=columns", "names=00003N,00004D"],
        "missing": [
            f"without_rgb=A:{folder / 'b'},B:{folder / 'b'}",
            f"without_thermal=A:{folder / 'a'},B:{folder / 'a'}",
        ],
        "frames": [
            *("dataset=mfnet", f"dataset.root={folder / 'framed' / 'mf'}"),
            f"pairs={folder / 'framed' / 'pairs'}",
            f"methods=A:{folder / 'framed' / 'a'},B:{folder / 'framed' / 'b'}",
        ],
        "two": ["rows=2"],
        "trained": [f"runs=A:{folder / 'run'}"],
    }
    needed = {
        "spatialseg/fig1": ("map folder", "statistics folder"),
        "spatialseg/fig2": ("methods", "statistics"),
        "spatialseg/fig3": ("one", "statistics"),
        "spatialseg/fig4": ("dataset",),
        "spatialseg/fig5": ("statistics",),
        "spatialseg/fig6": ("dataset",),
        "spatialseg/fig8": ("dataset", "methods", "chosen"),
        "spatialseg/fig9": ("dataset", "methods"),
        "temporal/fig5": ("pairs",),
        "temporal/fig1": ("frames",),
        "temporal/fig6": ("frames", "two"),
        "crm/fig2": ("dataset", "methods", "missing", "columns"),
        "crm/fig4": ("dataset", "one"),
        "crm/fig5": ("dataset",),
        "multihead/fig3": (),
        "robustness": ("failing",),
        "regions/heat": ("runs",),
        "classes": ("runs",),
        "curves": ("trained",),
        "regions/profile": ("runs", "fast"),
    }
    return [word for name in needed[figure] for word in given[name]]


MORE = {
    "spatialseg/fig1": ("part=night",),
    "spatialseg/fig3": ("split=train", "metric=ring5"),  # as the file says itself
    "regions/heat": ("split=test",),
}
"""What is given beside `arguments` where the figure is drawn."""

SAID = {
    "spatialseg/fig1": (
        *("(a) IoU: a, test, all images", "(b) sample occupancy: toy, train, night"),
        *("mIoU: centre ", "SOR: centre ", "inner and outer region of ring5, pixels pooled"),
    ),
    "spatialseg/fig2": (
        *("IoU (A)", "Acc (B)", "SOR: split train; scores: split test"),
        "(c) rings (inside to outside)",
    ),
    "spatialseg/fig8": ("RGB", "thermal", "ground truth", "00011N", "car stop"),
    "temporal/fig1": ("ground truth", "00001N", "synthesised", "predictions of both frames differ"),
    "temporal/fig6": ("thermal", "00000D", "00001N", "synthesised"),
    "crm/fig2": ("RGB", "no RGB", "no thermal", "both", "00003N"),
    "temporal/fig5": ("virtual views, first frame warped into the second",),
    "crm/fig5": ("square", "16 x 16 pixels", "thermal"),
    "multihead/fig3": ("entropy minimisation", "maximum squares", "gradient magnitude"),
}
"""Texts of the drawn figure."""


@pytest.mark.parametrize("figure", FIGURES)
def test_every_figure_is_drawn(call: Call, made: Path, tmp_path: Path, figure: str) -> None:
    out = tmp_path / "drawn" / "figure.svg"
    words = [*arguments(figure, made), *MORE.get(figure, ())]
    code, said, err = call(entry, f"figure={figure}", f"out={out}", *words)
    assert (code, said.split()[:1]) == (0, [str(out)]), err
    drawn = out.read_text()
    assert "<svg" in drawn[:1000]
    for text in SAID.get(figure, ()):
        assert text in drawn, text
    lines = out.with_suffix(".csv").read_text().splitlines()
    assert len(out.with_suffix(".md").read_text().splitlines()) == len(lines) + 3
    if figure == "spatialseg/fig8":
        assert lines[:2] == ["image,method,mIoU", "00011N,A,100"]


def test_lists_every_figure_with_its_options(call: Call) -> None:
    code, out, _ = call(entry)
    assert code == 0
    for name, spec in FIGURES.items():
        (line,) = [line for line in out.splitlines() if line.split()[:1] == [name]]
        assert spec.shows in line
        assert ("methods" in line) == ("methods=..." in spec.words or name == "spatialseg/fig3")


@pytest.mark.parametrize(
    ("figure", "words", "word"),
    [
        ("spatialseg/fig7", [], "did you mean 'spatialseg/fig"),
        ("spatialseg/fig5", ["out=f.jpg"], "ends in .pdf, .svg, .png"),
        ("spatialseg/fig1", [], "statistics: needed"),
        ("spatialseg/fig1", ["maps=m.npz", "part=night"], "part=night"),
        ("spatialseg/fig2", [], "needs methods=..."),
        ("spatialseg/fig4", [], "give one of maps=..."),
        ("crm/fig5", [], "no data set is named"),
        ("regions/heat", ["frames=next"], "'frames' has no effect on figure="),
        ("multihead/fig3", ["metric=ring9"], "'metric' has no effect on"),
        ("spatialseg/fig2", ["methods=a:x,a:y"], "different label:folder"),
    ],
)
def test_bad_input_is_one_sentence(call: Call, figure: str, words: list[str], word: str) -> None:
    given = dict(word.split("=", 1) for word in ("out=f.pdf", *words))
    code, out, err = call(entry, f"figure={figure}", *(f"{k}={v}" for k, v in given.items()))
    assert (code, out) == (2, "")
    assert word in err
    assert "Traceback" not in err


@pytest.mark.parametrize(
    ("figure", "change", "word"),
    [
        ("spatialseg/fig5", ["dataset=mfnet"], "statistics: expected either"),
        ("spatialseg/fig5", ["split=test"], "statistics.npz has split 'train'"),
        ("spatialseg/fig5", ["metric=vertical5"], "was measured over ring5"),
        ("spatialseg/fig4", ["names=00099D"], "no image '00099D'"),
        ("spatialseg/fig9", ["rows=13"], "rows=13, but there are 12 images"),
        ("spatialseg/fig9", ["suffix=_pred"], "no prediction"),
        ("spatialseg/fig9", ["metric=vertical5"], "no centre to put a box on"),
        ("crm/fig2", ["without_rgb=A:x"], "name the same ones"),
        ("spatialseg/fig1", ["metric=vertical5"], "no centre and no edge"),
        ("spatialseg/fig3", ["methods=A:{0}/a,B:{0}/b"], "shows one method"),
        ("regions/heat", ["runs={}/a/pairs.npz"], "is a score of single"),
        ("temporal/fig5", ["frames=released"], "by aligned3, not frames=released"),
    ],
)
def test_input_that_does_not_fit_is_refused(
    call: Call, made: Path, tmp_path: Path, figure: str, change: list[str], word: str
) -> None:
    words = [*arguments(figure, made), *(word.format(made) for word in change)]
    code, _, err = call(entry, f"figure={figure}", f"out={tmp_path / 'f.svg'}", *words)
    assert code == 2
    assert word in " ".join(err.split())


@pytest.mark.parametrize("figure", ["spatialseg/fig1", "spatialseg/fig4"])
def test_maps_of_another_split_are_refused(call: Call, made: Path, figure: str) -> None:
    words = (f"figure={figure}", "out=f.svg", f"maps={made / 'a'}", "split=val")
    code, _, err = call(entry, *words)
    assert code == 2
    assert "has split 'test'" in " ".join(err.split())


def test_entries_with_one_label_are_seeds_of_one_method(call: Call, tmp_path: Path) -> None:
    for name in ("s0", "s1"):
        rng = np.random.default_rng(len(name))
        # Of "val": a file's split need not be named.
        counts_of(rng.integers(1, 9, (20, 2, 2, 2)), split="val").save(tmp_path / f"{name}.npz")
    runs = ",".join(f"ours:{tmp_path / name}.npz" for name in ("s0", "s1"))
    out = tmp_path / "f.svg"
    words = [f"runs={runs}", f"out={out}", "resamples=100", "blocks=none"]
    code, _, err = call(entry, "figure=regions/profile", *words)
    assert code == 0, err
    assert "2 seeds, 20 images" in out.read_text()


@pytest.mark.parametrize("figure", ["spatialseg/fig2", "regions/heat"])
def test_methods_on_other_images_are_not_shown_together(
    call: Call, made: Path, tmp_path: Path, figure: str
) -> None:
    other = tmp_path / "other"
    other.mkdir()
    for path in (made / "b").glob("counts_*.npz"):
        counts = Counts.load(path)
        remeasured(counts.select(counts.names[:-1]), split="val").save(other / path.name)
    words = [word.replace(f"B:{made / 'b'}", f"B:{other}") for word in arguments(figure, made)]
    code, _, err = call(entry, f"figure={figure}", f"out={tmp_path / 'f.pdf'}", *words)
    assert code == 2
    assert "not of the same images: 12 of split 'test' against 11 of split 'val'" in err


@pytest.mark.parametrize("figure", ["spatialseg/fig2", "spatialseg/fig3"])
def test_statistics_of_another_data_set_are_refused(
    call: Call, made: Path, tmp_path: Path, figure: str
) -> None:
    other = replace(SpatialStatistics.load(made / "statistics.npz"), fingerprint="other")
    other.save(tmp_path / "statistics.npz")
    words = [word for word in arguments(figure, made) if not word.startswith("statistics")]
    words.append(f"statistics={tmp_path}")
    code, _, err = call(entry, f"figure={figure}", f"out={tmp_path / 'f.pdf'}", *words)
    assert code == 2
    assert "the scores of another data set" in err
