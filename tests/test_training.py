"""What a run tells of itself, without a run."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from rgbt.training import Run


def told(
    capsys: pytest.CaptureFixture[str], lines: list[tuple[str, dict[str, float]]], cache: str | None
) -> str:
    """What a run with these lines in its log says of waiting."""
    kept = [SimpleNamespace(kind=kind, values=values) for kind, values in lines]
    folder: Any = SimpleNamespace(lines=lambda: kept)
    nothing: Any = None
    session: Any = SimpleNamespace(loading=SimpleNamespace(cache=cache))
    capsys.readouterr()
    Run(nothing, folder, nothing, nothing)._tell_waiting(session)
    return capsys.readouterr().err


def steps(*shares: float) -> list[tuple[str, dict[str, float]]]:
    return [("train", {"loss": 1.0, "wait_share": share}) for share in shares]


def test_much_waiting_is_told_with_what_helps(capsys: pytest.CaptureFixture[str]) -> None:
    # The median of 0.1, 0.5 and 0.9: one slow step, as the first always is, says nothing.
    assert told(capsys, steps(0.9, 0.1, 0.5), None) == (
        "rgbt: 50% of the time of a step was waiting for images; data.cache=auto decodes every "
        "image once, and data.num_workers=... gives more processes to reading them.\n"
    )
    assert told(capsys, steps(0.9, 0.1, 0.5), "auto") == (
        "rgbt: 50% of the time of a step was waiting for images; data.num_workers=... gives more "
        "processes to reading them.\n"
    )


def test_little_waiting_is_not_told(capsys: pytest.CaptureFixture[str]) -> None:
    assert told(capsys, steps(0.3, 0.3), None) == "", "no more than the limit"
    assert told(capsys, steps(0.99, 0.1, 0.2), None) == ""
    assert told(capsys, [], None) == ""
    earlier = [("train", {"loss": 1.0}), ("val", {"wait_share": 0.9})]
    assert told(capsys, earlier, None) == "", "lines of before it was measured, and of no step"
    assert "31%" in told(capsys, [*earlier, *steps(0.31)], None)


@pytest.mark.parametrize(
    ("saved", "said"),
    [
        (2, "rgbt: steps 3 to 5 were not saved before and are repeated.\n"),
        (5, ""),
    ],
)
def test_steps_that_were_not_saved_are_named_on_resuming(
    capsys: pytest.CaptureFixture[str], saved: int, said: str
) -> None:
    folder: Any = SimpleNamespace(lines=lambda: [SimpleNamespace(step=step) for step in (1, 5)])
    nothing: Any = None
    Run(nothing, folder, nothing, nothing)._tell_repeated(saved)
    assert capsys.readouterr().err == said
