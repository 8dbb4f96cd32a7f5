"""Robustness of a network: which measurements, which are made again, the table."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from torch import nn

from rgbt.assembly.session import Session, open_session
from rgbt.checks import InputError
from rgbt.config.compose import compose
from rgbt.config.corruption_node import ChosenCorruption, choose_corruption
from rgbt.data.mfnet import MFNet
from rgbt.evaluation.measure import Measured
from rgbt.evaluation.robustness import conditions, measure_all, robustness_grid, write_tables
from rgbt.metrics.counts import Counts
from rgbt.metrics.measurement import Measurement
from rgbt.metrics.scores import summary
from rgbt.requirements import NetworkRecord
from rgbt.runs.specify import specify
from tests.commands import SPLITS, words_of
from tests.measured import measurement

CLASSES = ("road", "car")


class Network(nn.Module):
    record = NetworkRecord(views=("rgbt", "rgb", "thermal"))


class Opener:
    """Opens a run whose folder is `folder`, on the small data set."""

    def __init__(self, data: Path, folder: Path) -> None:
        self.data, self.folder = data, folder

    def __call__(self, *words: str, **changes: Any) -> Session:
        given = words_of(self.data, self.folder.parent, "+experiment=mfnet", *words)
        session = open_session(specify(compose([*given, "masker.patch_size=null"])))
        run: dict[str, Any] = {"model": Network(), "run": self.folder.name, "folder": self.folder}
        return replace(session, **run | changes)


@pytest.fixture
def opened(data: Path, tmp_path: Path) -> Opener:
    return Opener(data, tmp_path / "key")


class Evaluator:
    """Stands for `measure`; the accuracy follows from the severity."""

    def __init__(self, stop_at: int = 99) -> None:
        self.calls: list[tuple[float, str]] = []
        self.stop_at = stop_at

    def __call__(self, session: Session, wanted: Measurement) -> Measured:
        if len(self.calls) == self.stop_at:
            raise KeyboardInterrupt
        self.calls.append((wanted.severity, wanted.view))
        right = 100 - int(wanted.severity)
        names = session.dataset.names(wanted.split)
        counts = np.zeros((len(names), 5, 2, 2), int)
        counts[:, 0] = [[right, 100 - right], [0, 100]]
        night = session.dataset.nights(names)
        return Measured(
            Counts(counts=counts, names=names, night=night, classes=CLASSES, measurement=wanted), {}
        )


EVERY = [(0.0, "rgbt"), (0.0, "thermal"), (0.0, "rgb"), (10.0, "rgbt"), (50.0, "rgbt")]
"""What is measured of `noise()`."""


@pytest.fixture
def evaluator(monkeypatch: pytest.MonkeyPatch) -> Evaluator:
    made = Evaluator()
    monkeypatch.setattr("rgbt.evaluation.robustness.measure", made)
    return made


def noise(**changes: Any) -> list[ChosenCorruption]:
    words = [f"corruption.{key}={value}" for key, value in changes.items()]
    return [choose_corruption("noise", ["corruption.severities=[10,50]", *words])]


def test_conditions_are_clean_branches_and_severities(opened: Opener) -> None:
    session = opened()
    found = [
        measured
        for _, measured in conditions(session, "test", [*noise(), choose_corruption("removed:rgb")])
    ]
    assert [
        (measured.file_name, measured.condition, measured.severity, measured.view)
        for measured in found
    ] == [
        ("counts_test.npz", "clean", 0.0, "rgbt"),
        ("test_thermal.npz", "thermal", 0.0, "thermal"),
        ("test_rgb.npz", "rgb", 0.0, "rgb"),
        ("test_noise-10.npz", "noise", 10.0, "rgbt"),
        ("test_noise-50.npz", "noise", 50.0, "rgbt"),
        ("test_rgb_removed.npz", "rgb_removed", 1.0, "rgbt"),
    ]
    # Changed settings are a row of their own.
    changed = [choose_corruption("occluded", ["corruption.block=16"])]
    rows = [measured.condition for _, measured in conditions(session, "test", changed)]
    assert set(rows[3:]) == {"occluded_block-16"}


@pytest.mark.parametrize("is_beside", [True, False])
def test_counts_are_stored_with_their_measurement_and_found_again(
    opened: Opener, evaluator: Evaluator, tmp_path: Path, is_beside: bool
) -> None:
    """In the folder of the run, or in another one."""
    out = tmp_path / "out" if is_beside else None
    measured = measure_all(opened(), "test", noise(), out)
    assert evaluator.calls == EVERY
    # Of 100 pixels of road 50 are seen as car: IoU 50 / 100 and 100 / 150.
    assert summary(measured[-1], "released")["mIoU"] == pytest.approx((50 / 100 + 100 / 150) / 2)
    assert summary(measured[0], "released")["mIoU"] == 1
    folder = out or tmp_path / "key" / "evaluations"
    saved = Counts.load(folder / "test_noise-50.npz")
    assert saved.counts[0, 0, 0].tolist() == [50, 50]
    made = saved.measurement
    assert (made.run, made.dataset) == ("key", opened().dataset.fingerprint())
    assert (made.corruption, made.severity, made.view) == ("noise", 50.0, "rgbt")
    assert {"corruption.image": '"both"', "corruption.seed": "0"}.items() <= dict(
        made.settings
    ).items()
    # Clean images are those that the run is tested with.
    clean = (out or tmp_path / "key") / "counts_test.npz"
    assert Counts.load(clean).measurement.is_own
    again = measure_all(opened(), "test", noise(), out)
    assert len(evaluator.calls) == 5, "nothing is made again"
    assert [counts.measurement for counts in again] == [counts.measurement for counts in measured]
    assert all(np.array_equal(a.counts, b.counts) for a, b in zip(again, measured, strict=True))


class OtherFiles(MFNet):
    def fingerprint(self) -> str:
        return "0123456789abcdef"


SETTINGS: dict[str, tuple[tuple[str, ...], str]] = {
    "precision": (("trainer.precision=bf16-mixed",), "trainer.precision"),
    "transform": (("scale.test_short_edge=24",), "transform.test_short_edge"),
    "prediction": (("prediction.mirrored=true",), "prediction.mirrored"),
    "regions": (("metric.regions=9",), "partition"),
    "files": ((), "dataset"),
    "weights": ((), "weights"),
}


def changed_session(opened: Opener, kind: str) -> Session:
    words, key = SETTINGS[kind]
    if kind == "weights":
        return opened(run="", digest="cd" * 32)
    session = opened(*words, changed=(key,))
    return replace(session, dataset=OtherFiles(str(opened.data))) if kind == "files" else session


@pytest.mark.parametrize("kind", SETTINGS)
def test_measure_repeats_after_other_settings(
    opened: Opener, evaluator: Evaluator, tmp_path: Path, kind: str
) -> None:
    """And the first counts lie there as they were."""
    first = opened(run="", digest="ab" * 32) if kind == "weights" else opened()
    measure_all(first, "test", noise(), tmp_path / "out")
    before = {path: path.read_bytes() for path in (tmp_path / "out").iterdir()}
    other = changed_session(opened, kind)
    found = measure_all(other, "test", noise(), tmp_path / "out")
    assert evaluator.calls == EVERY + EVERY
    assert {path: path.read_bytes() for path in before} == before
    assert len([*(tmp_path / "out").iterdir()]) == 10
    stored = {Counts.load(path).measurement for path in before}
    assert not stored & {counts.measurement for counts in found}
    # What nobody names as changed would get the name of the counts that are there.
    if kind != "weights":
        with pytest.raises(InputError, match=f"holds another measurement .*{SETTINGS[kind][1]}"):
            measure_all(replace(other, changed=()), "test", noise(), tmp_path / "out")
    assert {path: path.read_bytes() for path in before} == before


def test_measure_replaces_no_damaged_or_other_file(
    opened: Opener, evaluator: Evaluator, tmp_path: Path
) -> None:
    measure_all(opened(), "test", noise(), tmp_path)
    measure_all(opened(), "test", noise(seed=1), tmp_path)
    assert evaluator.calls[5:] == [(10.0, "rgbt"), (50.0, "rgbt")]
    assert (tmp_path / "test_noise_seed-1-10.npz").exists()
    damaged = tmp_path / "test_noise-10.npz"
    damaged.write_bytes(b"half")
    with pytest.raises(InputError, match=r"test_noise-10\.npz.*is not a readable file of counts"):
        measure_all(opened(), "test", noise(), tmp_path)
    assert damaged.read_bytes() == b"half"
    damaged.unlink()
    measure_all(opened(), "test", noise(), tmp_path)
    assert evaluator.calls[7:] == [(10.0, "rgbt")]
    # Under the same name, but of a file that says otherwise since.
    (own,) = noise()
    of_rgb = own._replace(node=choose_corruption("noise:rgb").node)
    with pytest.raises(InputError, match=r"holds another measurement \(corruption\.image\)"):
        measure_all(
            opened(), "test", [of_rgb._replace(node={**of_rgb.node, "severities": [10]})], tmp_path
        )
    assert len(evaluator.calls) == 8


def test_counts_without_some_images_are_made_again(
    opened: Opener, evaluator: Evaluator, tmp_path: Path
) -> None:
    """They may be readable now; those of the run's own test are its result."""
    every = measure_all(opened(), "test", noise(), tmp_path)
    for counts in every:
        counts.select(counts.names[1:]).save(tmp_path / counts.measurement.file_name)
    found = measure_all(opened(), "test", noise(), tmp_path)
    assert evaluator.calls[5:] == EVERY[1:]
    assert [len(counts.names) for counts in found] == [2, 3, 3, 3, 3]
    assert found[0].names == tuple(SPLITS["test"][1:])


def test_counts_of_an_earlier_step_are_replaced(
    opened: Opener, evaluator: Evaluator, tmp_path: Path
) -> None:
    measure_all(opened(step=1), "test", [], tmp_path)
    found = measure_all(opened(step=2), "test", [], tmp_path)
    assert evaluator.calls == EVERY[:3] + EVERY[:3]
    assert {counts.measurement.step for counts in found} == {2}
    assert Counts.load(tmp_path / "test_rgb.npz").measurement.step == 2
    assert len([*tmp_path.glob("*.npz")]) == 3


def test_reused_counts_are_scored_as_requested(
    opened: Opener, evaluator: Evaluator, tmp_path: Path
) -> None:
    """Which classes take part in means, and how absent ones score, is no part of the counts."""
    measure_all(opened(), "test", noise(), tmp_path)
    before = {path: path.read_bytes() for path in tmp_path.glob("*.npz")}
    session = opened("metric.absent=exclude")
    session.dataset.unscored = ("car",)
    found = measure_all(session, "test", noise(), tmp_path)
    assert len(evaluator.calls) == 5, "nothing is made again"
    assert {path: path.read_bytes() for path in before} == before
    assert {(counts.absent, counts.unscored) for counts in found} == {("exclude", ("car",))}


def test_measure_stopped_resumes(
    opened: Opener, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    stopped, later = Evaluator(stop_at=3), Evaluator()
    monkeypatch.setattr("rgbt.evaluation.robustness.measure", stopped)
    with pytest.raises(KeyboardInterrupt):
        measure_all(opened(), "test", noise(), tmp_path)
    monkeypatch.setattr("rgbt.evaluation.robustness.measure", later)
    measure_all(opened(), "test", noise(), tmp_path)
    assert later.calls == [(10.0, "rgbt"), (50.0, "rgbt")]


def counts_with(miou: float, **described: Any) -> Counts:
    """Counts of one image, of whose road so many of 100 pixels are right; the car is not scored."""
    right = round(100 * miou)
    return Counts(
        counts=np.array([[[[right, 100 - right], [0, 0]]]]),
        names=("1D",),
        night=(False,),
        classes=CLASSES,
        unscored=("car",),
        measurement=measurement(run="key", partition="ring1", view="rgbt", **described),
    )


def of_noise(severity: float) -> dict[str, Any]:
    return {"corruption": "noise", "title": "noise", "unit": "levels", "severity": severity}


def measured_by_hand() -> list[Counts]:
    removed = {"corruption": "removed", "title": "removed", "severity": 1.0}
    return [
        counts_with(0.5),
        counts_with(0.2, changed=("severity",), **removed),
        counts_with(0.4, changed=("severity",), **of_noise(8)),
        counts_with(0.3, changed=("severity",), **of_noise(16)),
    ]


def test_robustness_grid_of_two_rows() -> None:
    measured = measured_by_hand()
    grid = robustness_grid(measured, "of x")
    assert grid.header == ("", "severities", "level 0", "level 1", "level 2")
    assert grid.rows == (
        ("removed", "", "50.00", "20.00", ""),
        ("noise", "8, 16 levels", "50.00", "40.00", "30.00"),
    )
    assert robustness_grid(measured[:1], "of x").rows == (("clean", "", "50.00"),)


def test_tables_have_a_line_for_every_measurement(tmp_path: Path) -> None:
    measured = measured_by_hand()
    path = tmp_path / "robustness_noise-0.5"
    write_tables(measured, robustness_grid(measured, "of x"), path)
    assert "| noise | 8, 16 levels |" in (tmp_path / "robustness_noise-0.5.md").read_text()
    with (tmp_path / "robustness_noise-0.5.csv").open() as file:
        header, *lines = csv.reader(file)
    assert header == ["condition", "title", "unit", "severity", "view", "mIoU"]
    assert [[*line[:-1], float(line[-1])] for line in lines] == [
        ["clean", "", "", "0", "rgbt", pytest.approx(50)],
        ["removed", "removed", "", "1", "rgbt", pytest.approx(20)],
        ["noise", "noise", "levels", "8", "rgbt", pytest.approx(40)],
        ["noise", "noise", "levels", "16", "rgbt", pytest.approx(30)],
    ]
