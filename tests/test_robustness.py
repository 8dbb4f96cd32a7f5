"""What is left of a run under every failure: which evaluations, which are made again, the table."""

from __future__ import annotations

import csv
import json
import shutil
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from omegaconf import OmegaConf
from torch import nn

from rgbt import evaluate, robustness
from rgbt.checks import InputError
from rgbt.config.command import plain_command
from rgbt.evaluation.corrupted import Failure, choose
from rgbt.evaluation.robustness import Asked, Measured, asked_of, measure, weights_digest
from rgbt.metrics.counts import Counts
from rgbt.metrics.metric import Regions
from rgbt.requirements import Record
from rgbt.robustness import chosen_of, robustness_grid
from tests.commands import Call, Trained, assert_one_sentence, short
from tests.corruptions.recorded import Recorded

ENTRY = plain_command(robustness.OWN, robustness.main)
EVALUATE = plain_command(evaluate.OWN, evaluate.main)
NOISE = ("degradations=noise_rgb", "degradation.severities=[16,64]")


class Network(nn.Module):
    def __init__(self, views: tuple[str, ...] = ("rgbt", "rgb", "thermal")) -> None:
        super().__init__()
        self.record = Record(views=views)
        self.weight = nn.Parameter(torch.arange(4.0))


@dataclass(frozen=True)
class Opened:
    """A session, as far as it is asked here."""

    model: Any
    dataset: Any
    regions: Regions
    config: Any
    trainer: Any
    domains: Any


def opened(**changes: Any) -> Any:
    source = SimpleNamespace(view=None)
    session = Opened(
        model=Network(),
        dataset=Recorded(),
        regions=Regions(partition="ring", regions=1, aspect="image", absent="released"),
        config=OmegaConf.create({"transform": {"_target_": "x", "test_short_edge": 120}}),
        trainer=SimpleNamespace(precision="32-true"),
        domains=SimpleNamespace(source=source),
    )
    return replace(session, **changes)


class Evaluator:
    """Stands for `rgbt.build.session.evaluate`; the accuracy tells what was evaluated."""

    def __init__(self, stop_at: int = 99) -> None:
        self.calls: list[tuple[float, str]] = []
        self.stop_at = stop_at

    def __call__(self, session: Any, model: Any, split: str, *, view: str) -> Any:
        if len(self.calls) == self.stop_at:
            raise KeyboardInterrupt
        severity = getattr(session.dataset, "severity", 0.0)
        self.calls.append((severity, view))
        right = 100 - int(severity)
        counts = Counts(
            counts=np.array([[[[right, 100 - right], [0, 100]]]] * 2),
            names=("1D", "2N"),
            night=(False, True),
            classes=("road", "car"),
            partition="ring1",
            dataset="fingerprint",
            split=split,
        )
        return SimpleNamespace(counts=counts)


@pytest.fixture
def evaluator(monkeypatch: pytest.MonkeyPatch) -> Evaluator:
    made = Evaluator()
    monkeypatch.setattr("rgbt.build.session.evaluate", made)
    return made


def noise(**changes: Any) -> list[Any]:
    words = [f"degradation.{key}={value}" for key, value in changes.items()]
    return [choose("noise", ["degradation.severities=[10,50]", *words])]


def test_clean_first_then_branches_then_every_severity() -> None:
    session = opened()
    asked = asked_of(session, [*noise(), choose("rgb_removed")])
    assert [(each.mark, each.row, each.severity, each.view) for each in asked] == [
        ("clean", "clean", 0.0, "rgbt"),
        ("features-thermal", "features-thermal", 1.0, "thermal"),
        ("features-rgb", "features-rgb", 1.0, "rgb"),
        ("noise-10", "noise", 10.0, "rgbt"),
        ("noise-50", "noise", 50.0, "rgbt"),
        ("rgb_removed-1", "rgb_removed", 1.0, "rgbt"),
    ]
    # Changed settings are a row of their own.
    changed = asked_of(session, [choose("occluded", ["degradation.block=16"])])
    assert {each.row for each in changed[3:]} == {"occluded_block-16"}


@pytest.mark.parametrize(
    ("views", "source", "marks"),
    [
        (("rgbt",), None, ["clean"]),
        (("rgb", "thermal"), None, ["clean"]),
        (("rgbt", "thermal"), None, ["clean", "features-thermal"]),
        (("rgbt", "rgb", "thermal"), "rgb", ["clean"]),
    ],
)
def test_single_branches_as_far_as_the_network_decodes_them(
    views: tuple[str, ...], source: str | None, marks: list[str]
) -> None:
    domains = SimpleNamespace(source=SimpleNamespace(view=source))
    session = opened(model=Network(views), domains=domains)
    assert [each.mark for each in asked_of(session, [])] == marks


def test_measures_and_keeps_counts_with_what_made_them(
    evaluator: Evaluator, tmp_path: Path
) -> None:
    measured = measure(opened(), "test", noise(), tmp_path / "out")
    assert evaluator.calls == [
        *((0.0, "rgbt"), (0.0, "thermal"), (0.0, "rgb")),
        *((10.0, "rgbt"), (50.0, "rgbt")),
    ]
    # Of 100 pixels of road 50 are seen as car: IoU 50 / 100 and 100 / 150.
    assert measured[-1].mious["mIoU"] == pytest.approx((50 / 100 + 100 / 150) / 2)
    assert measured[-1].mious["day/mIoU"] == pytest.approx((50 / 100 + 100 / 150) / 2)
    assert measured[0].mious["mIoU"] == 1
    made = json.loads((tmp_path / "out" / "noise-50.json").read_text())
    assert made["format"] == "rgbt robustness 1"
    assert (made["row"], made["severity"], made["view"]) == ("noise", 50.0, "rgbt")
    assert (made["dataset"], made["split"]) == ("fingerprint", "test")
    assert made["failure"]["settings"] == {"image": "both"}
    stored = Counts.load(tmp_path / "out" / "noise-50.npz")
    np.testing.assert_array_equal(stored.counts, measured[-1].counts.counts)


def test_what_is_there_is_not_made_again(evaluator: Evaluator, tmp_path: Path) -> None:
    first = measure(opened(), "test", noise(), tmp_path)
    again = measure(opened(), "test", noise(), tmp_path)
    assert len(evaluator.calls) == 5
    assert [each.mious for each in again] == [each.mious for each in first]


@pytest.mark.parametrize(
    "changes",
    [
        {"dataset": "files"},
        {"model": "weights"},
        {"trainer": SimpleNamespace(precision="bf16-mixed")},
        {"config": OmegaConf.create({"transform": {"_target_": "x", "test_short_edge": 60}})},
    ],
    ids=["files", "weights", "precision", "transform"],
)
def test_other_data_weights_or_settings_make_everything_again(
    evaluator: Evaluator, tmp_path: Path, changes: dict[str, Any]
) -> None:
    measure(opened(), "test", noise(), tmp_path)
    if "dataset" in changes:
        other = Recorded()
        other.fingerprint = lambda: "other"  # type: ignore[method-assign]
        changes = {"dataset": other}
    if "model" in changes:
        trained = Network()
        trained.weight.data[3] += 1e-6
        changes = {"model": trained}
    measure(opened(**changes), "test", noise(), tmp_path)
    assert len(evaluator.calls) == 10


def test_other_draws_lie_beside_and_a_damaged_file_is_made_again(
    evaluator: Evaluator, tmp_path: Path
) -> None:
    measure(opened(), "test", noise(), tmp_path)
    measure(opened(), "test", noise(seed=1), tmp_path)
    assert evaluator.calls[5:] == [(10.0, "rgbt"), (50.0, "rgbt")]
    assert (tmp_path / "noise-10_seed-1.npz").exists()
    # Words alone that have changed are written anew.
    made = json.loads((tmp_path / "clean.json").read_text())
    changed = {key: value for key, value in made.items() if key != "crc32"} | {"title": "before"}
    (tmp_path / "clean.json").write_text(json.dumps(changed))
    (tmp_path / "noise-10.npz").write_bytes(b"half")
    (tmp_path / "noise-50.json").write_text("{")
    measure(opened(), "test", noise(), tmp_path)
    assert len(evaluator.calls) == 9
    assert json.loads((tmp_path / "clean.json").read_text()) == made
    # Under the same name, but of a file that says otherwise since.
    (own,) = noise()
    of_rgb = choose("noise_rgb", ["degradation.severities=[10,50]"]).degradation
    measure(opened(), "test", [replace(own, degradation=of_rgb)], tmp_path)
    assert len(evaluator.calls) == 11


def test_stopped_and_given_again_it_goes_on(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    stopped, later = Evaluator(stop_at=3), Evaluator()
    monkeypatch.setattr("rgbt.build.session.evaluate", stopped)
    with pytest.raises(KeyboardInterrupt):
        measure(opened(), "test", noise(), tmp_path)
    monkeypatch.setattr("rgbt.build.session.evaluate", later)
    measure(opened(), "test", noise(), tmp_path)
    assert later.calls == [(10.0, "rgbt"), (50.0, "rgbt")]


def test_counts_of_other_weights_are_never_taken_for_these(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Killed between the two files: what says what made the counts is gone before they change."""
    monkeypatch.setattr("rgbt.build.session.evaluate", Evaluator())
    measure(opened(), "test", [], tmp_path)
    other = Network()
    other.weight.data += 1

    def killed(path: Path, content: bytes) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("rgbt.files.atomic.write_atomic", killed)
    with pytest.raises(KeyboardInterrupt):
        measure(opened(model=other), "test", [], tmp_path)
    assert not (tmp_path / "clean.json").exists()


def test_the_digest_is_of_names_shapes_types_and_bytes() -> None:
    model = Network()
    first = weights_digest(model)
    assert first == weights_digest(Network())
    assert first != weights_digest(model.double())
    model = Network()
    model.weight = nn.Parameter(torch.arange(4.0).reshape(2, 2))
    assert first != weights_digest(model)
    assert weights_digest(nn.BatchNorm2d(3))  # holds a scalar


def measured_row(row: str, unit: str, *values: tuple[float, float]) -> list[Measured]:
    return [
        Measured(Asked(row, row, row, unit, severity, "rgbt"), None, {"mIoU": value})  # type: ignore[arg-type]
        for severity, value in values
    ]


def test_the_table_has_a_line_per_degradation_and_a_column_per_level() -> None:
    measured = [
        *measured_row("clean", "", (0, 0.5)),
        *measured_row("removed", "", (1, 0.2)),
        *measured_row("noise", "levels", (8, 0.4), (16, 0.3)),
    ]
    grid = robustness_grid(measured, "of x")
    assert grid.header == ("", "severities", "level 0", "level 1", "level 2")
    assert grid.rows == (
        ("removed", "", "50.00", "20.00", ""),
        ("noise", "8, 16 levels", "50.00", "40.00", "30.00"),
    )
    assert robustness_grid(measured[:1], "of x").rows == (("clean", "", "50.00"),)


def test_degradations_by_name() -> None:
    assert len(chosen_of("all", [])) == 14
    assert [each.name for each in chosen_of("blur, frozen", ["degradation.seed=2"])] == [
        "blur",
        "frozen",
    ]
    with pytest.raises(InputError, match="did you mean 'frozen'"):
        chosen_of("blur,froze", [])
    with pytest.raises(InputError, match="'blur' stands twice"):
        chosen_of("blur,blur", [])
    with pytest.raises(InputError, match="'degradation.block' is a key of one degradation, but 14"):
        chosen_of("all", ["degradation.block=8"])


MARKS = ("clean", "features-rgb", "features-thermal", "noise_rgb-16", "noise_rgb-64")


@pytest.mark.slow
def test_the_command_measures_a_run_as_evaluate_does(
    call: Call, trained: Trained, tmp_path: Path
) -> None:
    folder = tmp_path / "runs" / "key"
    shutil.copytree(trained("+experiment=crm", *short(1)), folder)
    code, out, err = call(ENTRY, f"run={folder}", *NOISE)
    assert code == 0, err
    place = folder / "evaluations" / "robustness" / "test"
    assert "noise, RGB" in out
    assert f"counts  {place}/" in out
    assert {path.name for path in place.iterdir()} == {
        *("robustness_noise_rgb.md", "robustness_noise_rgb.csv"),
        *(f"{mark}.{end}" for mark in MARKS for end in ("npz", "json")),
    }
    counts = {path.stem: Counts.load(path).counts for path in place.glob("*.npz")}
    np.testing.assert_array_equal(counts["clean"], Counts.load(folder / "counts_test.npz").counts)
    with (place / "robustness_noise_rgb.csv").open() as file:
        lines = list(csv.DictReader(file))
    assert [line["severity"] for line in lines] == ["0", "1", "1", "16", "64"]
    # The same by the other command.
    asked = {
        "noise_rgb-64": ("degradation=noise_rgb", "severity=64"),
        "features-thermal": ("modality=thermal",),
    }
    for mark, words in asked.items():
        file = tmp_path / f"{mark}.npz"
        assert call(EVALUATE, f"run={folder}", f"out={file}", *words)[0] == 0
        np.testing.assert_array_equal(counts[mark], Counts.load(file).counts)
    assert call(EVALUATE, f"run={folder}", "degradation=noise_rgb", "severity=16")[0] == 0
    (named,) = (folder / "evaluations").glob("*noise*.npz")
    assert named.name == "mfnet_test_rgbt_ring5_noise_rgb-16.npz"
    # Over other regions beside them; twice the same run, of which nothing is made again.
    words = ("degradations=thermal_removed", "regions=ring9", "runs_dir=" + str(tmp_path / "runs"))
    code, out, err = call(ENTRY, "run=key,key", *words)
    assert code == 0, err
    assert out.count("thermal removed (zeroed)") == 2
    assert (place.with_name("test_ring9") / "thermal_removed-1.npz").exists()


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["run=a", "degradations=blurr"], "did you mean 'blur'"),
        (["run=a", "transform.test_short_edge=60"], "name a folder for these counts with out="),
        (["run=a", "metric.absent=exclude"], "changes how the run is measured"),
        (["run=a,b", "out=x"], "out= is the folder of one run, but run= names 2"),
        (["run=nowhere", "degradations=blur"], "run=nowhere: neither a run folder"),
        (["degradations=blur"], "'run' has no value"),
    ],
)
def test_bad_input_is_one_sentence(
    call: Call, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, words: list[str], sentence: str
) -> None:
    monkeypatch.chdir(tmp_path)
    code, out, err = call(ENTRY, *words)
    assert (code, out) == (2, "")
    assert_one_sentence(err, sentence)


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["severity=1"], "'severity' has no effect without degradation="),
        (["degradation.block=1"], "'degradation.block' has no effect without degradation="),
        (["degradation=noise"], "needs a number (grey levels (std))"),
    ],
)
def test_evaluate_says_what_a_degradation_needs(
    call: Call, words: list[str], sentence: str
) -> None:
    code, _, err = call(EVALUATE, "run=x", *words)
    assert code == 2
    assert_one_sentence(err, sentence)


def test_a_failure_is_put_in_front_of_the_data() -> None:
    failure = Failure(choose("frozen"), 2.0)
    session = failure.applied(opened(), "test")
    assert session.dataset.shown("00003D") == "00001D"
    assert session.model is not None
