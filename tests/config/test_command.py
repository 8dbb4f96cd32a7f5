"""The command line itself: signals, and words that Hydra's own errors lack."""

from __future__ import annotations

import os
import signal
from pathlib import Path

import pytest

from rgbt.config.plain_command import PlainCommand
from tests.commands import Call, NoOptions, assert_one_sentence


def test_sigterm_is_answered_by_plain_commands_too(call: Call) -> None:
    tidied: list[bool] = []

    def main(options: NoOptions, overrides: list[str]) -> int:
        del options, overrides
        try:
            os.kill(os.getpid(), signal.SIGTERM)
            signal.pause()
        finally:
            # The second signal of a cluster must not end the tidying up.
            os.kill(os.getpid(), signal.SIGTERM)
            tidied.append(True)
        return 0

    before = signal.getsignal(signal.SIGTERM)
    code, _, err = call(PlainCommand(NoOptions, main))
    assert (code, tidied) == (143, [True])
    assert_one_sentence(err, "stopped by SIGTERM")
    assert signal.getsignal(signal.SIGTERM) is before


@pytest.mark.parametrize(
    ("word", "sentence"),
    [
        ("hydra.sweeper.worker=2", "did you mean 'workers'"),
        ("hydra.sweeper.objectives=[{metric: val/mIou, direction: maximize}]", "val/mIou"),
    ],
)
def test_misspelt_sweep_setting_names_the_nearest(
    call: Call, tmp_path: Path, word: str, sentence: str
) -> None:
    from rgbt.run import main

    place = (f"runs_dir={tmp_path}", "tracking=none")
    code, _, err = call(main, "-m", "+experiment=grbm", "seed=0,1", *place, word)
    assert code == 2
    assert_one_sentence(err, sentence)
    assert list(tmp_path.iterdir()) == []
