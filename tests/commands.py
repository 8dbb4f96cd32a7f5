"""Calling the commands on a small data set, as a user would."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

SPLITS = {
    "train": [f"{n:05d}{'DN'[n % 2]}" for n in range(1, 9)],
    "val": ["00101D", "00102N"],
    "test": ["00201D", "00202N", "00203D"],
}
ON_CPU = ("trainer.accelerator=cpu", "trainer.threads=1", "tracking=none")
SMALL = (
    *("scale.batch_size=2", "scale.eval_batch_size=2", "scale.num_points=64"),
    *("scale.crop_hw=[48,64]", "scale.train_sizes=[48,56]", "scale.test_short_edge=48"),
    *("masker.patch_size=32", "trainer.log_every=1", *ON_CPU),
)
DAYS_AND_NIGHTS = (
    *("dataset=synth_freiburg", "dataset.num_train_day=6", "dataset.num_train_night=5"),
    *("dataset.num_val=2", "dataset.num_test=4", "trainer.log_every=1", *ON_CPU),
    *("scale.batch_size=2", "scale.eval_batch_size=4", "scale.critic_width=4"),
)
"""The small embedded data set of days and nights for runs on two domains."""


@dataclass(frozen=True)
class NoOptions:
    """Of a command that takes none."""


Call = Callable[..., tuple[int, str, str]]
Trained = Callable[..., Path]


@contextmanager
def without_pictures() -> Iterator[None]:
    """Pictures of runs are empty files: drawing takes as long as the steps of these tests."""
    from rgbt.evaluation.pairs import files
    from rgbt.tracking import pair_pictures
    from rgbt.training import train as training

    def draw(*things: Any) -> None:
        things[-1].parent.mkdir(parents=True, exist_ok=True)
        things[-1].touch()

    with pytest.MonkeyPatch.context() as patch:
        for name in ("draw_panel", "draw_region_heat"):
            patch.setattr(training, name, draw)
        patch.setattr(training, "draw_extremes", lambda *_, **__: [])
        for module in (pair_pictures, files):
            patch.setattr(module, "draw_pairs", draw)
        yield


def short(steps: int) -> tuple[str, ...]:
    return (
        f"trainer.max_steps={steps}",
        f"trainer.eval_every={steps}",
        "trainer.checkpoint_minutes=0",
    )


def words_of(data: Path, runs: Path, *overrides: str) -> list[str]:
    """Arguments of `rgbt.run`."""
    if any(word.startswith("dataset=") for word in overrides):
        return [f"runs_dir={runs}", f"dataset.cache_dir={data.parent / 'cache'}", *overrides]
    return [f"runs_dir={runs}", f"dataset.root={data}", "dataset=mfnet", *SMALL, *overrides]


def train(call: Call, data: Path, runs: Path, *overrides: str) -> tuple[int, str, str]:
    from rgbt.run import main

    return call(main, *words_of(data, runs, *overrides))


def edit_config(folder: Path, old: str, new: str) -> None:
    """Write another ``config.yaml`` with the checksum that fits it."""
    from rgbt.runs.folder import RunFolder

    lines = (folder / "config.yaml").read_text().splitlines(keepends=True)
    text = "".join(line for line in lines if not line.startswith("#"))
    assert old in text
    RunFolder(folder).write_config(text.replace(old, new, 1))


def only_run(runs: Path) -> Path:
    (result,) = runs.glob("*/result.json")
    return result.parent


def logged(folder: Path, kind: str = "") -> list[dict[str, Any]]:
    """Lines of ``metrics.jsonl``, of one kind or all."""
    lines = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    return [line for line in lines if kind in ("", line["kind"])]


def losses(folder: Path) -> list[dict[str, float]]:
    """Losses by name of every training step."""
    steps = [line["values"] for line in logged(folder, "train")]
    return [{name: step[name] for name in step if name.startswith("loss")} for step in steps]


def assert_one_sentence(err: str, sentence: str) -> None:
    messages = [line for line in err.splitlines() if line.startswith("rgbt: ")]
    assert (len(messages), "Traceback" in err) == (1, False), err
    assert sentence in messages[0], messages[0]


def code_of(entry: Any, words: list[str]) -> int:
    """Exit code of a command with its own options."""
    from rgbt.config.plain_command import exit_code

    return exit_code(lambda: entry.run(words))
