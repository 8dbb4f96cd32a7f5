"""A training writes lines that one can follow, and says once that it became much slower."""

from __future__ import annotations

import io
import math
import re
from collections.abc import Callable
from types import SimpleNamespace

import pytest
from rich.console import Console

from rgbt.engine.progress import training_log, watch_pace, write_evaluation
from rgbt.terminal import progress, tracked


def warned(
    note: Callable[[float, float], None], capsys: pytest.CaptureFixture[str], *steps: float
) -> list[str]:
    """The output after each of these steps, a quarter of which is waiting."""
    said = []
    for seconds in steps:
        note(seconds, seconds / 4)
        said.append(capsys.readouterr().err)
    return said


def test_pace_ten_times_slower_warns_once(capsys: pytest.CaptureFixture[str]) -> None:
    note = watch_pace(3)
    assert warned(note, capsys, *[0.1] * 150) == [""] * 150
    # The median of the last ten steps is that of the slow ones after six of them.
    *before, sixth = warned(note, capsys, *[1.2] * 6)
    assert before == [""] * 5
    assert re.search(r"^rgbt: warning: a step takes 1\.2 s now, 12 times as long as before", sixth)
    assert "(25% of it waiting for images)" in sixth  # all ten steps waited for a quarter
    assert "trainer.threads=3" in sixth
    assert warned(note, capsys, *[9.9] * 50) == [""] * 50


@pytest.mark.parametrize(
    "steps",
    [
        [0.1] * 150 + [0.9] * 50,  # nine times as long
        [0.1] * 150 + [50.0] + [0.1] * 20,  # a laptop was closed
        [0.1] * 8 + [5.0] * 5,  # too few to compare with
        [5.0] * 3 + [0.1] * 150,  # compiled first
    ],
)
def test_pace_otherwise_is_silent(capsys: pytest.CaptureFixture[str], steps: list[float]) -> None:
    assert not any(warned(watch_pace(1), capsys, *steps))


def test_pace_compares_with_a_start_below_a_hundred_steps(
    capsys: pytest.CaptureFixture[str],
) -> None:
    *before, last = warned(watch_pace(1), capsys, *[0.1] * 30, *[2.0] * 5)
    assert not any(before)
    assert "1.05 s now, 10 times" in last


VALUES = {
    **{"loss/class": 56.897, "loss/mask": 0.001234, "loss": 146.769, "grad_norm": 69.5},
    **{"images_per_s": 20.34, "lr/main_0": 1e-5, "lr/main_1": 1e-4, "peak_memory_mib": 11468.8},
    "seconds_left": 15123.4,
}


def test_log_line_has_the_values_of_its_step(capsys: pytest.CaptureFixture[str]) -> None:
    training_log(35000)(120, VALUES)
    assert capsys.readouterr().err == (
        "  120/35000  left 4:12:03  20.3 img/s  11.2 GiB  lr 1.0e-04  "
        "loss 146.8 class 57   mask 0.0012\n"
    )


def test_log_line_of_crm_fits_in_120_columns(capsys: pytest.CaptureFixture[str]) -> None:
    parts = dict.fromkeys(("class", "mask", "dice", "sdc", "sdn"), 0.1234)
    training_log(35000)(120, {**VALUES, **{f"loss/{name}": v for name, v in parts.items()}})
    assert len(capsys.readouterr().err.rstrip()) <= 120


def test_log_has_ten_lines_then_one_in_ten_seconds(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    now = [100.0]
    monkeypatch.setattr("rgbt.engine.progress.time", SimpleNamespace(monotonic=lambda: now[0]))
    write = training_log(100)
    for step in range(1, 101):
        now[0] += 1
        write(step, VALUES)
    steps = [int(line.split("/")[0]) for line in capsys.readouterr().err.splitlines()]
    assert steps == [*range(1, 11), *range(20, 100, 10), 100]


def test_bar_of_a_terminal_replaces_the_lines(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    shown = io.StringIO()
    console = Console(file=shown, force_terminal=True, width=120)
    monkeypatch.setattr("rgbt.engine.progress.CONSOLE", console)
    monkeypatch.setattr("rgbt.terminal.CONSOLE", console)
    with progress() as display:
        display.add_task("training", total=3, note="loss 1.0")
        training_log(3)(1, VALUES)
        write_evaluation(1, 3, "val", 0.5, (0.5, 1))
    assert capsys.readouterr().err == ""
    assert "loss 1.0" in shown.getvalue()


@pytest.mark.parametrize(
    ("score", "best", "said"),
    [
        (0.4321, (0.45, 3), "val mIoU 43.21 %, best 45.00 % at step 3"),
        (math.nan, (-1.0, 9), "val mIoU nan %"),
    ],
)
def test_line_of_an_evaluation(
    capsys: pytest.CaptureFixture[str], score: float, best: tuple[float, int], said: str
) -> None:
    write_evaluation(9, 35000, "val", score, best)
    assert capsys.readouterr().err == f"    9/35000  {said}\n"


def test_a_log_of_a_long_count_has_a_line_every_ten_seconds(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    now = [0.0]
    monkeypatch.setattr("rgbt.terminal.time", SimpleNamespace(monotonic=lambda: now[0]))
    for step in tracked(range(1000), "reading", 1000):
        now[0] += 0.125 if step < 400 else 0.0
    lines = capsys.readouterr().err.splitlines()
    assert lines[0].startswith("reading 80 of 1000, 0:01:55 left"), "no message of an error"
    assert [line.split()[1] for line in lines] == ["80", "160", "240", "320", "400"]


def test_a_terminal_shows_a_long_count_as_a_bar(monkeypatch: pytest.MonkeyPatch) -> None:
    shown = io.StringIO()
    console = Console(file=shown, force_terminal=True, width=80)
    monkeypatch.setattr("rgbt.terminal.CONSOLE", console)
    assert list(tracked("abc", "reading", 3)) == ["a", "b", "c"]
    last = re.sub(r"\x1b\[[\d;?]*[a-zA-Z]", "", shown.getvalue()).splitlines()[-1]
    assert re.match(r"\S? *reading .* 3/3 0:00:0\d left 0:00:00", last)
