"""Messages and descriptions of a run, without a run."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from rgbt.engine.checkpoint import State
from rgbt.runs.folder import Description, RunFolder
from rgbt.tracking.mlflow_store import NoTracking
from rgbt.training.train import Training


def stderr_of(
    capsys: pytest.CaptureFixture[str], lines: list[tuple[str, dict[str, float]]], cache: str | None
) -> str:
    """What a run with these lines in its log says of waiting."""
    kept: Any = [SimpleNamespace(kind=kind, values=values) for kind, values in lines]
    nothing: Any = None
    setup: Any = SimpleNamespace(session=SimpleNamespace(loading=SimpleNamespace(cache=cache)))
    capsys.readouterr()
    Training(setup, nothing, nothing, nothing)._report(kept)
    return capsys.readouterr().err


def steps(*shares: float) -> list[tuple[str, dict[str, float]]]:
    return [("train", {"loss": 1.0, "wait_share": share}) for share in shares]


def test_much_waiting_is_reported_with_what_helps(capsys: pytest.CaptureFixture[str]) -> None:
    # The median of 0.1, 0.5 and 0.9: one slow step, as the first always is, says nothing.
    said = stderr_of(capsys, steps(0.9, 0.1, 0.5), None)
    assert "50% of the time of a step was spent waiting for images; data.cache=auto" in said
    said = stderr_of(capsys, steps(0.9, 0.1, 0.5), "auto")
    assert "50%" in said
    assert "data.cache" not in said
    # Lines of before it was measured, and of no step.
    earlier = [("train", {"loss": 1.0}), ("val", {"wait_share": 0.9})]
    assert "31%" in stderr_of(capsys, [*earlier, *steps(0.31)], None)
    for lines in (steps(0.3, 0.3), steps(0.99, 0.1, 0.2), [], earlier):
        assert stderr_of(capsys, lines, None) == ""


def test_a_run_that_is_stopped_while_its_tracking_begins_is_closed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Slow(NoTracking):
        """A store that a signal comes before."""

        ended = ""

        def update(self) -> None:
            raise KeyboardInterrupt

        def start(self, *arguments: Any) -> None:
            super().start(*arguments)
            self.update()

        def finish(self, status: str) -> None:
            self.ended = status

    tracking, prepared = Slow(), cast(Any, SimpleNamespace(session=None))
    monkeypatch.setattr(Training, "_claim", lambda *_: None)
    with pytest.raises(KeyboardInterrupt):
        Training(prepared, RunFolder(tmp_path), tracking, Description("a", {}, {})).complete()
    assert tracking.ended == "KILLED"


def test_steps_that_were_not_saved_are_named_on_resuming(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, nothing = RunFolder(tmp_path), cast(Any, None)
    for step in range(1, 6):
        folder.append(step, "train", {"loss": 1.0})
    spec = SimpleNamespace(own_code=dict)
    setup: Any = SimpleNamespace(session=SimpleNamespace(spec=spec))
    for saved, said in (
        (5, ""),
        (2, "rgbt: steps 3 to 5 were not saved and are repeated.\n"),
    ):
        state = State(seed=0, step=saved, evaluated_step=saved)
        trainer: Any = SimpleNamespace(
            resume=lambda _: False, settings=SimpleNamespace(log_every=1)
        )
        Training(setup, folder, nothing, nothing)._resume(trainer, state)
        assert capsys.readouterr().err == said
