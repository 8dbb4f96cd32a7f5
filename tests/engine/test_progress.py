"""A training that becomes much slower says so, once."""

from __future__ import annotations

import re
from collections.abc import Callable

import pytest

from rgbt.engine.progress import watch_pace


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
