"""How long runs took, and the runs upstream of them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rgbt.checks import InputError
from rgbt.runs.folder import RunFolder
from rgbt.runs.result import RunResult
from sweeps.rendering.times import time_lines


def took(folder: Path, seconds: float) -> RunResult:
    RunFolder(folder).finish({"key": folder.name, "seconds_of_last_process": seconds})
    return RunResult(folder)


@dataclass(frozen=True)
class Spec:
    """Stands for `rgbt.runs.run_spec.RunSpec`."""

    name: str
    folder: Path
    upstream: tuple[Spec, ...] = ()

    @property
    def key(self) -> str:
        return self.folder.name

    @property
    def is_finished(self) -> bool:
        return (self.folder / "result.json").exists()


def test_time_lines_count_each_run_once(tmp_path: Path) -> None:
    """Two rows share a start, which has a teacher; one row has a start of its own."""
    runs = [took(tmp_path / str(seconds), seconds) for seconds in (60, 80, 1000)]
    teacher = Spec("teacher", took(tmp_path / "t", 40).folder)
    shared = Spec("start", took(tmp_path / "s", 200).folder, (teacher,))
    rows = {
        "a": Spec("crm", tmp_path / "a", (shared,)),
        "b": Spec("baseline", tmp_path / "b", (shared,)),
        "c": Spec("grbm", tmp_path / "c", (Spec("start", tmp_path / "o"),)),
    }

    class Planner:
        base = ("runs_dir=x",)

        def specify(self, words: tuple[str, ...]) -> Spec:
            assert words[:1] == self.base
            if words[1] not in rows:
                raise InputError("no such row")
            return rows[words[1]]

    planner: Any = Planner()
    words = [("a",), ("b",), ("c",), ("wrong",)]
    assert time_lines([*runs, runs[0]], words, planner) == [
        # 60 + 80 + 1,000 s are 19 minutes, and the middle one is 80 s.
        "Time: 3 runs, 19 min in total, 80 s for a run (median).",
        "Upstream of these: 3 runs (start: 1 of 2 finished, 3 min; "
        "teacher: 1 of 1 finished, 40 s).",
    ]
    assert time_lines([], [("wrong",)], planner) == []
