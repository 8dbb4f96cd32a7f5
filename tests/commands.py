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
SMALL = (
    *("scale.batch_size=2", "scale.eval_batch_size=2", "scale.num_points=64"),
    *("scale.crop_hw=[48,64]", "scale.train_sizes=[48,56]", "scale.test_short_edge=48"),
    *(
        "masker.patch_size=32",
        "trainer.log_every=1",
        "trainer.accelerator=cpu",
        "trainer.threads=1",
    ),
)


@dataclass(frozen=True)
class NoOptions:
    """Of a command that takes none."""


Call = Callable[..., tuple[int, str, str]]
Trained = Callable[..., Path]


@contextmanager
def without_pictures() -> Iterator[None]:
    """Pictures of runs are empty files: drawing takes as long as the steps of these tests."""
    from rgbt.evaluation import consistency_files
    from rgbt.training import train as training

    def draw(*things: Any) -> None:
        things[-1].parent.mkdir(parents=True, exist_ok=True)
        things[-1].touch()

    with pytest.MonkeyPatch.context() as patch:
        for name in ("draw_panel", "draw_region_heat", "draw_pairs"):
            patch.setattr(training, name, draw)
        patch.setattr(consistency_files, "draw_pairs", draw)
        yield


def short(steps: int) -> tuple[str, ...]:
    return f"trainer.max_steps={steps}", f"trainer.eval_every={steps}", "trainer.checkpoint_every=2"


def words_of(data: Path, runs: Path, *overrides: str) -> list[str]:
    """Arguments of `rgbt.run`."""
    place = (f"dataset.root={data}", f"runs_dir={runs}", "dataset=mfnet", "tracking=none")
    return [*place, *SMALL, *overrides]


def train(call: Call, data: Path, runs: Path, *overrides: str) -> tuple[int, str, str]:
    from rgbt.run import main

    return call(main, *words_of(data, runs, *overrides))


def only_run(runs: Path) -> Path:
    (result,) = runs.glob("*/result.json")
    return result.parent


def logged(folder: Path, kind: str = "") -> list[dict[str, Any]]:
    """Lines of ``metrics.jsonl``, of one kind or all."""
    lines = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    return [line for line in lines if kind in ("", line["kind"])]


def losses(folder: Path) -> list[dict[str, float]]:
    """Losses by name of every training step."""
    return [
        {name: value for name, value in line["values"].items() if name.startswith("loss")}
        for line in logged(folder, "train")
    ]


def assert_one_sentence(err: str, sentence: str) -> None:
    messages = [line for line in err.splitlines() if line.startswith("rgbt: ")]
    assert len(messages) == 1, err
    assert sentence in messages[0], messages[0]
    assert "Traceback" not in err


def code_of(entry: Any, words: list[str]) -> int:
    """Exit code of a command with its own options."""
    from rgbt.config.plain_command import exit_code

    return exit_code(lambda: entry.run(words))
