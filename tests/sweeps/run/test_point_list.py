"""Lists of points: planned once, each run once, what is remembered, and their commands."""

from __future__ import annotations

import json
import shlex
import subprocess
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from rgbt.checks import InputError, RunError
from rgbt.files.atomic import holding
from rgbt.files.plain_files import write_json
from rgbt.runs.naming import TAGS, VARIED
from rgbt.runs.provenance import code
from rgbt.runs.result import RunResult
from rgbt.tracking.tracker import Tracking
from sweeps.plan.planner import PlannedPoint
from sweeps.point import Outcome, Point
from sweeps.run.optuna_study import study_folder
from sweeps.run.point_list import (
    ListSource,
    commands_line,
    estimated_seconds,
    other_code_line,
    preview_points,
)
from sweeps.run.point_state import evaluated_runs
from sweeps.run.run_store import RunStore
from tests.sweeps.fakes import (
    FakePlanner,
    ListDesk,
    fail,
    finish,
    leave,
    measure,
    only,
    plan_of,
    points,
)


def named(*words: str, **more: Any) -> list[Point]:
    return [Point(word, (word,), tags={"t": "grid"}, **more) for word in words]


def previewed(desk: ListDesk) -> list[str]:
    return [outcome.state for outcome in preview_points(desk.points, desk.settings)]


def test_points_that_lack_something_are_missing(tmp_path: Path) -> None:
    """They have not failed; a plan shows them even where nothing else is left."""
    desk = ListDesk(tmp_path, named("x=0", "data", "checkout", "wrong"))
    outcomes = preview_points(desk.points, desk.settings)
    assert [outcome.state for outcome in outcomes] == ["waiting", "missing", "missing", "failed"]
    assert [outcome.reason for outcome in outcomes[1:3]] == ["no data", "no checkout"]
    assert previewed(ListDesk(tmp_path, named("data", "checkout"))) == ["missing", "missing"]
    desk = ListDesk(tmp_path, named("data"))
    with pytest.raises(InputError, match="no data"):
        desk.run()


def test_a_wrong_point_of_a_strict_list_starts_nothing(tmp_path: Path) -> None:
    desk = ListDesk(tmp_path, named("x=0", "wrong"))
    with pytest.raises(InputError, match="wrong: wrong=1"):
        desk.run(strict=True)
    assert (desk.executor.submits, list(tmp_path.glob("*/*.json"))) == ([], [])


def test_wrong_points_fail_unless_all_are_wrong(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"^wrong=1 is no key"):
        previewed(ListDesk(tmp_path, named("wrong", "wrong")))
    desk = ListDesk(tmp_path, named("x=0", "wrong", "x=1"))
    assert previewed(desk) == ["waiting", "failed", "waiting"]
    assert list(tmp_path.iterdir()) == []
    assert desk.run().states() == ["finished", "failed", "finished"]


@pytest.mark.parametrize(("trust", "is_refused"), [("", True), ("my_lab", False)])
def test_untrusted_class_is_refused_before_training(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, trust: str, is_refused: bool
) -> None:
    class OwnLoss(FakePlanner):
        def plan(self, point: Point) -> PlannedPoint:
            planned = plan_of(point)
            loss = {"_target_": "my_lab.Loss"}
            runs: Any = [SimpleNamespace(**{**vars(planned.runs[0]), "plain": {"loss": loss}})]
            return replace(planned, runs=tuple(runs))

    (tmp_path / "my_lab.py").write_text("class Loss: ...\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    given = [*named("x=1"), *named("x=2", evaluations=(("modality=rgb",),))]
    desk = ListDesk(tmp_path, given, planner=OwnLoss(), trust=trust)
    first, second = preview_points(desk.points, desk.settings)
    assert first.state == "waiting", "nothing opens its run"
    assert ("my_lab.Loss" in second.reason) == is_refused


def test_equal_points_are_one_run_and_share_their_tags(tmp_path: Path) -> None:
    class SameRun(FakePlanner):
        def plan(self, point: Point) -> PlannedPoint:
            return replace(plan_of(replace(point, overrides=("x=1",))), point=point)

    rows = [Point(label, (f"x={label}",), tags={"table": label}) for label in ("1", "1.0")]
    desk = ListDesk(tmp_path, rows, planner=SameRun()).run()
    tags = {"table": "1 | 1.0", VARIED: "x"}
    assert [outcome.point.tags for outcome in desk.outcomes or ()] == [tags, tags]
    assert (desk.states(), len(desk.executor.calls)) == (["finished"] * 2, 1)
    assert desk.view.counts[-1]["finished"] == 1


def test_a_second_driver_says_who_drives_and_runs_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = study_folder(tmp_path, "study")
    folder.mkdir(parents=True)
    with holding(folder / "lock"):
        desk = ListDesk(tmp_path, 1).run()
        assert (desk.outcomes, desk.executor.submits) == (None, [])
        assert "study study is driven by process" in capsys.readouterr().err
        assert ListDesk(tmp_path, 1, study="other").run().states() == ["finished"]
    assert desk.run().states() == ["finished"]


def test_two_studies_share_their_runs_and_tags(tmp_path: Path) -> None:
    for study, calls in (("one", 2), ("two", 0)):
        given = points(2, tags={f"rgbt.study/{study}": "grid"})
        desk = ListDesk(tmp_path, given, study=study).run()
        assert len(desk.executor.calls) == calls
    tags = RunResult(tmp_path / desk.keys[0]).tags
    assert {name for name in tags if name.startswith("rgbt.study/")} == {
        *("rgbt.study/one", "rgbt.study/two"),
    }


def test_a_failed_point_keeps_its_reason_until_it_is_retried(tmp_path: Path) -> None:
    behaviour = only("x=0", fail, only("x=1", leave(143), only("x=2", leave(-9))))
    first = ListDesk(tmp_path, 4, behaviour).run()
    assert first.states() == ["failed"] * 3 + ["finished"]
    # Whom somebody has stopped, goes on.
    again = ListDesk(tmp_path, 4).run()
    assert again.executor.started() == [("x=1",), ("x=2",)]
    assert (again.outcomes or [])[0].reason == "ValueError: a bad day"
    assert again.view.counts[-1]["failed"] == 1
    assert previewed(again)[0] == "failed"
    retried = ListDesk(tmp_path, 4, fail, retry="failed").run()
    assert retried.executor.started() == [("x=0",)], "once"
    finish(tmp_path / first.keys[0])  # by hand
    assert ListDesk(tmp_path, 4).run().states()[0] == "finished"


def test_a_failed_point_is_finished_once_another_one_trains_its_run(tmp_path: Path) -> None:
    desk = ListDesk(tmp_path, 1)
    source = ListSource(desk.points, desk.settings)
    plan = source.next()
    assert plan is not None
    source.record(plan, plan.outcome("failed", "lost"))
    assert [outcome.state for outcome in source.outcomes()] == ["failed"]
    finish(tmp_path / plan.runs[0].key)
    assert [outcome.state for outcome in source.outcomes()] == ["finished"]


def test_a_point_whose_run_was_deleted_is_run_again(tmp_path: Path) -> None:
    desk = ListDesk(tmp_path, 2).run()
    (tmp_path / desk.keys[1] / "result.json").unlink()
    again = ListDesk(tmp_path, 2)
    assert previewed(again) == ["finished", "waiting"]
    assert again.run().executor.started() == [("x=1",)]


def test_a_preview_shows_runs_that_somebody_trains(tmp_path: Path) -> None:
    desk = ListDesk(tmp_path, 2)
    folder = tmp_path / desk.keys[0]
    folder.mkdir()
    with holding(folder / "lock"):
        assert previewed(desk) == ["running", "waiting"]


def test_a_point_is_finished_with_all_runs_and_evaluations(tmp_path: Path) -> None:
    ring, rgb = ("regions=ring9",), ("modality=rgb",)
    plan = plan_of(Point("p", (), seeds=(0, 1), evaluations=(ring, rgb)))
    runs = RunStore(tmp_path, Tracking())
    for run in plan.runs:
        assert evaluated_runs(plan, runs) == ()
        finish(tmp_path / run.key)
    for run in plan.runs:
        for words in (ring, rgb):
            assert evaluated_runs(plan, runs) == ()
            measure(tmp_path / run.key, words)
    assert [found.key for found in evaluated_runs(plan, runs)] == [run.key for run in plan.runs]
    finish(tmp_path / plan.runs[0].key, dataset="another")
    with pytest.raises(RunError, match="other files"):
        evaluated_runs(plan, runs)


def growing(last: int) -> Callable[[Sequence[Outcome]], list[Point]]:
    """Adds x=1, ... `last` to x=0, each when all others are finished."""

    def more(outcomes: Sequence[Outcome]) -> list[Point]:
        x = len(outcomes)
        is_done = all(outcome.state == "finished" for outcome in outcomes)
        return [Point(f"x={x}", (f"x={x}",))] if is_done and x <= last else []

    return more


def test_a_resumed_list_continues_behind_the_added_points(tmp_path: Path) -> None:
    desk = ListDesk(tmp_path, 1, more=growing(2)).run()
    labels = [outcome.point.label for outcome in desk.outcomes or ()]
    assert labels == [f"x={x}" for x in range(3)]
    again = ListDesk(tmp_path, 1, more=growing(4)).run()
    assert again.states() == ["finished"] * 5
    assert again.executor.started() == [("x=3",), ("x=4",)]


def test_the_point_of_the_highest_rank_is_next(tmp_path: Path) -> None:
    ranks = {"x=0": 1.0, "x=1": 3.0, "x=2": 2.0}

    def more(outcomes: Sequence[Outcome]) -> list[Point]:
        if outcomes[1].state == "finished":
            ranks["x=0"] = 9.0
        return []

    desk = ListDesk(tmp_path, 3, more=more, rank=lambda point: ranks[point.label]).run()
    assert desk.executor.started() == [("x=1",), ("x=0",), ("x=2",)]


FAKE_RUN = f"""
import json, os, sys
with open("said", "a") as file:
    print(json.dumps([sys.argv[1:], json.loads(os.environ["{TAGS}"])]), file=file)
"""


def test_commands_are_a_line_of_shell_for_every_point_that_is_left(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("rgbt").mkdir()
    for name in ("__init__", "run", "evaluate"):
        Path(f"rgbt/{name}.py").write_text(FAKE_RUN if name != "__init__" else "")
    tags, rgb = {"t": "a 'b' $HOME"}, ("modality=rgb",)
    words = ("x=[1, 2]", 'name=it\'s; a $(b) "c"')
    given = [Point("p", words, {}, tags, (), (rgb,)), *named("x=1", "x=2", "x=3", "x=1")]
    desk = ListDesk(tmp_path / "runs", given, commands=str(tmp_path / "all.txt"))
    finish(desk.runs.runs_dir / desk.keys[2])
    before = sorted(desk.runs.runs_dir.rglob("*"))
    assert commands_line(desk.points, desk.settings).startswith("3 commands in ")
    assert sorted(desk.runs.runs_dir.rglob("*")) == before, "nothing is written there"
    lines = Path("all.txt").read_text().splitlines()
    assert ["x=1" in lines[1], "x=3" in lines[2], len(lines)] == [True, True, 3]
    assert shlex.split(lines[0]).count("&&") == 1
    subprocess.run(["sh", "-c", lines[0]], check=True)
    said = [json.loads(line) for line in Path("said").read_text().splitlines()]
    folder = desk.runs.runs_dir / plan_of(given[0]).runs[0].key
    assert [arguments for arguments, _ in said] == [[*words], [f"run={folder}", *rgb]]
    assert all(found["t"] == tags["t"] for _, found in said)


def test_estimated_seconds_is_median_of_untrained_over_workers(tmp_path: Path) -> None:
    known = []
    for seconds in (10, 20, 90):
        folder = finish(tmp_path / str(seconds)).path
        write_json(folder / "result.json", {"seconds_of_last_process": seconds})
        known.append(Outcome(Point("p", ()), "finished", results=(RunResult(folder),)))
    left: list[Any] = [Outcome(Point("q", ()), state) for state in ("waiting", "failed", "running")]
    assert [estimated_seconds([*known, *left], workers) for workers in (1, 2)] == [40.0, 20.0]
    assert estimated_seconds(left, 1) is None
    assert estimated_seconds([replace(known[0], state="waiting")], 1) == 0.0


def test_runs_of_other_code_are_counted_in_one_line(tmp_path: Path) -> None:
    for name, digest in (("a", "0" * 64), ("b", code()["code"])):
        finish(tmp_path / name).add_provenance({"code": digest, "diff": ""})
    old, new = (RunResult(tmp_path / name) for name in "ab")
    assert other_code_line([Outcome(Point("p", ()), "finished", results=(new,))]) == ""
    outcomes = [Outcome(Point("p", ()), "finished", results=(old, new))] * 2
    assert other_code_line(outcomes).startswith("1 of 2 runs")


def test_commands_are_written_to_regular_files_alone(tmp_path: Path) -> None:
    (tmp_path / "link").symlink_to(tmp_path / "elsewhere")
    refused = {
        "link": {"commands": str(tmp_path / "link")},
        "no/such": {"commands": str(tmp_path / "no" / "such" / "lines")},
        "dry_run": {"commands": str(tmp_path / "lines"), "dry_run": True},
    }
    (tmp_path / "no").write_text("a file")
    for words in refused.values():
        desk = ListDesk(tmp_path, 1, **words)
        with pytest.raises(InputError, match="commands"):
            commands_line(desk.points, desk.settings)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["link", "no"]
