"""Several tables at once: the order of their runs, the time, the archive."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from analysis.archive import archived
from rgbt.tracking.tracker import Tracking
from sweeps.plan.planner import PlannedPoint
from sweeps.point import Point
from sweeps.reproduce import Options, run_tables, settings_of
from sweeps.run import driver as drivers
from sweeps.run.run_store import RunStore
from tests.sweeps.fakes import (
    Behaviour,
    Call,
    FakeExecutor,
    FakePlanner,
    FakeView,
    Process,
    driven_by,
    fail,
    only,
    succeed,
)

HEAD = "paper: my\nnumber: {0}\ncaption: rows\ndata: none\n"
COLUMNS = "columns: [{name: acc, metric: pixel_accuracy}]\nrows:\n"
ROW = "  - {{label: {0}, experiment: {1}, values: {{acc: 1}}}}\n"
CLAIM = (
    "  - {{name: {0}_{1}, says: more, source: text, rows: [{0}], against: [{1}], "
    "columns: [acc], expected: higher}}\n"
)


def write_table(name: str, rows: Sequence[str], claims: Sequence[tuple[str, str]]) -> None:
    """A table whose rows are named by their experiments."""
    text = HEAD.format(name) + COLUMNS + "".join(ROW.format(row, row) for row in rows)
    text += "claims:\n" + "".join(CLAIM.format(*claim) for claim in claims) if claims else ""
    Path("tables/my").mkdir(parents=True, exist_ok=True)
    Path(f"tables/my/{name}.yaml").write_text(text)


class QuickPlanner(FakePlanner):
    """Networks are named by the experiment; "grbm" does not fit."""

    base = ()

    def plan(self, point: Point) -> PlannedPoint:
        if "+experiment=grbm" in point.overrides:
            point = replace(point, overrides=(*point.overrides, "wrong"))
        return super().plan(point)

    def specify(self, words: Sequence[str]) -> Any:
        return SimpleNamespace(key=words[0])

    def composed(self, point: Point) -> Any:
        plain: dict[str, Any] = dict.fromkeys(("model", "scheme"), {"_target_": point.overrides[0]})
        plain |= {"data": {"batch_size": 2}, "scale": {}, "trainer": {"max_steps": 2}}
        return SimpleNamespace(plain=plain, pending=())


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    # The scores of fake runs are not those of their counts.
    monkeypatch.setattr("analysis.archive.check_result", lambda _: None)
    write_table("one", ("crm", "baseline"), [("crm", "baseline")])
    write_table("two", ("cmx", "rtfnet", "mfnet"), [("cmx", "rtfnet"), ("cmx", "mfnet")])
    write_table("wrong", ("grbm",), [])
    return tmp_path


def run(
    place: Path,
    behaviour: Behaviour = succeed,
    table: str = "my/one,my/two,my/wrong",
    **options: Any,
) -> tuple[int, list[str]]:
    """Exit code, and the experiments that were run, in their order."""
    chosen = Options(table=table, runs_dir=place / "runs", **options)
    runs, planner = RunStore(place / "runs", Tracking()), QuickPlanner()
    with driven_by(executor := FakeExecutor(behaviour), FakeView()):
        code = run_tables(chosen, [], settings_of(chosen), runs, planner)  # type: ignore[arg-type]
    return code, [words[0].removeprefix("+experiment=") for words in executor.started()]


def test_runs_that_decide_most_claims_a_minute_come_first(
    place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    # cmx is needed by two claims of two runs each; with it, the other claims lack one run each.
    assert run(place) == (0, ["cmx", "rtfnet", "mfnet", "crm", "baseline"])
    said = capsys.readouterr().err
    assert "my/wrong is left out: wrong=1 is no key." in said
    assert "5 of 5 runs are finished, 0 failed; 0 of 3 claims are decided" in said


def test_measured_seconds_of_a_network_count(place: Path) -> None:
    """Of seed 0 each run takes 2.5 s; what has not been measured is estimated at four minutes."""
    write_table("more", ("cmx", "crmx"), [("cmx", "crmx")])
    run(place, table="my/one,my/one")
    code, order = run(place, table="my/two,my/one", seeds="2")
    assert (code, order[:2]) == (0, ["crm", "baseline"])


def test_no_run_starts_after_the_time(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    minutes = [0.0]

    def slow(call: Call) -> Process:
        minutes[0] += 1
        return (yield from succeed(call))

    def now() -> float:
        return 60 * minutes[0] + time.monotonic()

    monkeypatch.setattr(drivers, "time", SimpleNamespace(monotonic=now, sleep=time.sleep))
    assert run(place, slow, minutes=1.5) == (0, ["cmx", "rtfnet"])


def test_finished_runs_are_archived_and_count_on_another_machine(place: Path) -> None:
    assert run(place, table="my/two,my/wrong")[0] == 0
    assert len(archived(place / "results")) == 3
    there = place / "there"
    there.mkdir()
    assert run(there, archive=place / "results") == (0, ["crm", "baseline"])
    assert len(archived(place / "results")) == 5


def test_a_failed_run_does_not_end_the_queue(place: Path) -> None:
    first = "+experiment=cmx"
    code, order = run(place, only(first, fail))
    assert (code, sorted(order)) == (1, ["baseline", "cmx", "crm", "mfnet", "rtfnet"])
    assert len(archived(place / "results")) == 4
    assert run(place, fail) == (1, []), "it is not repeated"


def test_commands_and_dry_run_have_the_order_with_minutes(
    place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    order = ["cmx", "crm", "baseline", "rtfnet", "mfnet"]
    assert run(place, commands=place / "file") == (0, [])
    commands = (place / "file").read_text().splitlines()
    assert [line.partition("+experiment=")[2].split()[0] for line in commands] == order
    assert run(place, dry_run=True) == (0, [])
    said = capsys.readouterr().out
    assert "Time with workers=1: known after the first run." in said
    lines = [line.split() for line in said.splitlines() if "seed=0" in line]
    assert [line[0] for line in lines] == order
    assert lines[0][2:] == ["my/two", "1.00", "-", "-"]
    assert lines[-1][2:] == ["my/two", "0.50", "-", "-"]
    assert not (place / "runs").exists()
    run(place, archive=None)
    run(place, dry_run=True, seeds="3")
    said = capsys.readouterr().out
    assert "Time with workers=1: 25 s, without upstream runs" in said, "ten runs of 2.5 s"
    assert said.count(" 2 s ") == 10
    assert not (place / "results").exists(), "nothing is added"


def test_a_table_with_runs_of_another_machine_waits(
    place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert run(place, table="my/two,my/wrong")[0] == 0
    for archive in sorted((place / "results").glob("*.zip"))[1:]:
        archive.unlink()
    there = place / "there"
    there.mkdir()
    monkeypatch.setattr("rgbt.runs.result.RunResult.machine", "another")
    code, order = run(there, archive=place / "results")
    assert (code, order[:2], len(order)) == (0, ["crm", "baseline"], 4)
