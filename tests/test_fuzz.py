"""Every value of a key is refused in one sentence, or can be used in training."""

from __future__ import annotations

import os
import random
from pathlib import Path

import pytest
from omegaconf import DictConfig

from rgbt.config.compose import conf_dir
from tests.fuzz import EXPERIMENTS, Case, cases, checked, composed, outcome, used

FINE = ("refused", "accepted")
SEED = 17
NUM_CHECKED = 600
"""In the quick test; the slow one checks every case."""

NUM_TRAINED = 250
"""Of the accepted cases, as many are built and trained for a step in the slow test."""


def test_no_senseless_value_passes_the_check() -> None:
    configs = {name: composed(name) for name in EXPERIMENTS[:3]}
    wrong = [
        f"{case}: {found}"
        for config, case in random.Random(SEED).sample([*cases(configs)], NUM_CHECKED)
        if (found := outcome(checked, config, case)) not in FINE
    ]
    assert not wrong, "\n".join(wrong)


@pytest.fixture
def configs(tmp_path: Path) -> dict[str, DictConfig]:
    """Every experiment, and every option of a group that no experiment chooses by itself."""
    place = (f"dataset.cache_dir={tmp_path / 'cache'}", f"runs_dir={tmp_path / 'runs'}")
    names = sorted(path.stem for path in (conf_dir() / "experiment").glob("*.yaml"))
    made = {name: composed(name, *place) for name in [*EXPERIMENTS, *names]}
    made |= {
        f"grbm {word}": composed("grbm", *place, word)
        for word in ("tracking=mlflow", "consistency=views", "dataset=synth_kp")
    }
    return made


@pytest.mark.slow
def test_accepted_configurations_can_be_trained(
    configs: dict[str, DictConfig], tmp_path: Path
) -> None:
    found: list[tuple[DictConfig, Case, str]] = [
        (config, case, outcome(checked, config, case)) for config, case in cases(configs)
    ]
    wrong = [f"{case}: {each}" for _, case, each in found if each not in FINE]
    accepted = [(config, case) for config, case, each in found if each == "accepted"]
    number = int(os.environ.get("RGBT_FUZZ", NUM_TRAINED))
    for config, case in random.Random(SEED).sample(accepted, min(number, len(accepted))):
        each = outcome(used(tmp_path / "trained"), config, case)
        wrong += [] if each in FINE else [f"{case}: {each}"]
    assert not wrong, "\n".join(wrong)
