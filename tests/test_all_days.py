"""Training on all days of Freiburg Thermal: no validation split, in chains of runs as well."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from rgbt.checks import InputError
from rgbt.run import main
from rgbt.spec.run_spec import RunSpec
from sweeps.search import _probe
from sweeps.settings import Objective
from tests.commands import Call, assert_one_sentence
from tests.composed import specified
from tests.data.freiburg_files import write_freiburg
from tests.test_run import ADAPTATION, EXPERIMENTS

THESIS = [
    name for name in EXPERIMENTS if name.startswith(ADAPTATION) and not name.startswith("start_")
]
QUICK = ("multi_head_modified_night_init", "heatnet_rgb_only", "heatnet_released")
ON_THE_TEST_IMAGES = {"heatnet_released", "heatnet_original"}
"""HeatNet's release and its port select the best checkpoint on the test images."""


@pytest.fixture
def words(tmp_path: Path) -> tuple[str, ...]:
    root = write_freiburg(tmp_path / "freiburg")
    return (
        *("+debug=smoke", "dataset=freiburg", f"dataset.root={root}", "dataset.crop=null"),
        *(f"runs_dir={tmp_path / 'runs'}", "tracking=none", "scale.critic_width=4"),
        *("trainer.threads=1", "trainer.accelerator=cpu"),
    )


def chain(run: RunSpec) -> list[RunSpec]:
    """A run and all runs upstream of it."""
    return [run, *(each for upstream in run.upstream for each in chain(upstream))]


@pytest.mark.parametrize(
    "name",
    [pytest.param(each, marks=() if each in QUICK else pytest.mark.slow) for each in THESIS],
)
def test_experiment_of_the_thesis_trains_on_all_days_at_paper_scale(name: str) -> None:
    run = specified((f"+experiment={name}", "scale=paper", "dataset.root=/data"))
    for each in chain(run):
        assert each.dataset.plain["val_sequences"] == [], each.name
        selected = ("best", "test") if each.name in ON_THE_TEST_IMAGES else ("last", "val")
        assert (each.trainer.tested, each.trainer.selection_split) == selected, each.name


def test_chain_without_validation_split_reports_its_last_checkpoints(
    call: Call, words: tuple[str, ...], tmp_path: Path
) -> None:
    code, _, err = call(main, "+experiment=sh_adversarial", *words)
    assert code == 0, err
    results = sorted((tmp_path / "runs").glob("*/result.json"))
    assert len(results) == 2
    for path in results:
        result = json.loads(path.read_text())
        assert (result["best_step"], result["steps"]) == (2, 2)
        assert "val" not in result
        assert "best_score" not in result
        assert result["test"]["mIoU"] is not None
        assert not (path.parent / "counts_val.npz").exists()
        lines = (path.parent / "metrics.jsonl").read_text().splitlines()
        assert {json.loads(line)["kind"] for line in lines} == {"train", "test"}
    assert err.count("not validated: freiburg has no val") == 2
    again, out, _ = call(main, "+experiment=sh_adversarial", *words)
    assert again == 0
    assert "mIoU" in out


def test_best_checkpoint_without_validation_split_is_one_sentence(
    call: Call, words: tuple[str, ...], tmp_path: Path
) -> None:
    code, _, err = call(main, "+experiment=sh_source", *words, "trainer.tested=best")
    assert code == 2
    assert_one_sentence(
        err,
        "trainer.tested=best selects the checkpoint on val: freiburg has no validation split, "
        "because dataset.val_sequences=[]; name day sequences that are held out of training, such "
        "as dataset.val_sequences=[seq_04_day]. Or set trainer.tested=last, which selects none.",
    )
    # At demo scale the thermal teacher is tested with its best checkpoint, so that it needs images.
    code, _, err = call(main, "+experiment=multi_head_night", *words)
    assert code == 2
    assert_one_sentence(
        err, "upstream run thermal_teacher of multi_head_night: trainer.tested=best"
    )
    assert not (tmp_path / "runs").exists()


def test_search_of_runs_that_are_not_validated_needs_a_score_of_the_test(
    words: tuple[str, ...],
) -> None:
    request: Any = SimpleNamespace(fixed=("+experiment=sh_source", *words), parameters=())
    settings: Any = SimpleNamespace(objectives=(Objective("val/mIoU", "maximize"),))
    with pytest.raises(InputError, match=r"'val/mIoU': the data set has no image of val, so"):
        _probe(request, settings)
    settings.objectives = (Objective("test/mIoU", "maximize"),)
    _probe(request, settings)
