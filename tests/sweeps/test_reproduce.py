from __future__ import annotations

import csv
import itertools
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest

from rgbt.config.options import types_of
from rgbt.runs.result import OWN
from sweeps.point import Outcome, Point
from sweeps.reproduce import Options, entry, settings_of
from sweeps.run import point_list
from sweeps.run.point_list import PointList
from sweeps.settings import SweepSettings
from tests.commands import Call, assert_one_sentence
from tests.sweeps.tabled import FakeResult, right

OWN_TABLE = """\
paper: my
number: small
caption: rows of a test
data: nothing
columns:
  - {name: acc, metric: pixel_accuracy}
rows:
  - {label: one, experiment: grbm, overrides: [masker.sigma_div=1], values: {acc: 60.5}}
  - {label: two, experiment: grbm, overrides: [masker.sigma_div=2], values: {acc: 61.5}}
  - {label: theirs, values: {acc: 62.0}}
"""

Requests = list[tuple[PointList, SweepSettings]]
Driven = Callable[..., Requests]


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "tables" / "my").mkdir(parents=True)
    (tmp_path / "tables" / "my" / "small.yaml").write_text(OWN_TABLE)
    return tmp_path


@pytest.fixture
def driven(monkeypatch: pytest.MonkeyPatch) -> Driven:
    """Put a driver in place that tells `states` in turn instead of running anything."""

    def drive(*states: str) -> Requests:
        requests: Requests = []

        def work(wanted: PointList, settings: SweepSettings) -> Sequence[Outcome]:
            requests.append((wanted, settings))
            turns = itertools.cycle(states)
            return [_outcome(*known) for known in zip(wanted.points, turns, range(99))]

        monkeypatch.setattr(point_list, "run_points", work)
        monkeypatch.setattr(point_list, "preview_points", work)
        return requests

    return drive


def _outcome(point: Point, state: str, index: int) -> Outcome:
    found: Any = FakeResult(f"k{index}", {OWN: right(40 + index)})
    if state == "finished":
        return Outcome(point, "finished", results=(found,), keys=(f"k{index}",))
    return Outcome(point, state, "it broke" if state == "failed" else "")  # type: ignore[arg-type]


def test_a_whole_table(call: Call, place: Path, driven: Driven) -> None:
    requested = driven("finished")
    words = ("table=my/small", "seeds=2", "workers=2", "tracking=none", "dataset.root=/x")
    code, out, err = call(entry, *words)
    assert (code, err) == (0, "")
    (wanted, settings), *others = requested
    assert not others
    assert wanted.study == "table/my/small demo 0 1"
    assert wanted.planner.base == ("runs_dir=runs", "tracking=none")
    assert [point.overrides for point in wanted.points][:2] == [
        ("+experiment=grbm", "masker.sigma_div=1", "dataset.root=/x", "seed=0"),
        ("+experiment=grbm", "masker.sigma_div=2", "dataset.root=/x", "seed=0"),
    ]
    assert (settings.workers, settings.retry, settings.dry_run) == (2, "none", False)
    folder = place / "runs" / "tables" / "my" / "small_demo"
    assert "one" in out
    assert "41.00 ± 1.41" in out  # 40 and 42
    assert sorted(path.name for path in folder.iterdir()) == [
        *("figure.png", "table.csv", "table.md", "table.tex"),
    ]
    rows = list(csv.DictReader((folder / "table.csv").open()))
    assert [row["mean"] for row in rows] == ["41.0", "42.0", ""]


def test_reproduce_failed_cell_prints_table(call: Call, place: Path, driven: Driven) -> None:
    requested = driven("finished", "failed")
    code, out, err = call(entry, "table=my/small", "tracking=none", "out=here", "trust=my_lab")
    assert (code, requested[0][1].trust) == (1, "my_lab")
    assert "[1] seed 0: it broke." in out
    assert_one_sentence(err, "1 of 2 runs failed")
    assert "failed" in (place / "here" / "table.md").read_text()


def test_dry_run_lists_the_cells_and_writes_nothing(
    call: Call, place: Path, driven: Driven
) -> None:
    driven("waiting", "failed")
    code, out, err = call(entry, "table=my/small", "seeds=1", "dry_run=true", "tracking=none")
    assert (code, err) == (0, "")
    assert [line.split()[:3] for line in out.splitlines() if "seed=" in line] == [
        ["one", "seed=0", "waiting"],
        ["two", "seed=0", "failed"],
    ]
    assert "it broke" in out
    assert "2 runs: 1 failed, 1 waiting." in out
    assert not (place / "runs").exists()


@pytest.mark.parametrize(
    ("words", "key"),
    [
        ("table=my/smal", "my/small"),
        ("table=my/small scale=papr", "scale"),
        ("table=my/small workers=0", "workers'"),
        ("table=my/small +experiment=crm", "experiment"),
        ("table=my/small camera@consistency.view.camera=synth", "rgbt consistency"),
        ("table=my/small hydra/launcher=joblib", "its n_jobs is workers"),
        ("table=my/small hydra.launcher.partition=gpu", "partition"),
        ("table=my/small hydra.sweeper.workers=2", "hydra.sweeper.workers=2: of Hydra's words"),
        ("table=my/small +hydra.launcher.key=1", "+hydra.launcher.key=1: of Hydra's words"),
        ("", "'table'"),
    ],
)
def test_mistakes_are_reported_in_one_sentence(
    call: Call, place: Path, driven: Driven, words: str, key: str
) -> None:
    requested = driven("finished")
    code, _, err = call(entry, *words.split())
    assert (code, requested) == (2, [])
    assert_one_sentence(err, key)


def test_options_of_execution_are_sweep_settings() -> None:
    changes: dict[str, Any] = {
        "dry_run": True,
        "workers": 2,
        "gpus": (0, 1),
        "retry": "failed",
        "wait": True,
        "stop_jobs": True,
        "commands": Path("file"),
        "timeout_minutes": 3.0,
        "trust": "my_lab",
    }
    assert set(types_of(Options)) & set(SweepSettings.__dataclass_fields__) == set(changes)
    words = ("hydra/launcher=ray", "hydra.launcher.num_gpus=0.25")
    found = settings_of(Options("my/small", **changes), words)
    assert vars(found).items() >= {**changes, "commands": "file"}.items()
    assert (found.launcher, found.launcher_options["num_gpus"]) == ("ray", 0.25)


def test_other_rows_seeds_and_scales_are_other_studies(
    place: Path, call: Call, driven: Driven
) -> None:
    """Their commands run at the same time: the driver of one does not run the others."""
    requested = driven("failed")
    for more in ((), ("rows=1",), ("seeds=2",), ("scale=bench",)):
        call(entry, "table=my/small", *more)
    assert len({points.study for points, _ in requested}) == 4
