"""Executors of launchers, and what is said of a launcher that is not installed."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from hydra.errors import MissingConfigException

from rgbt.checks import InputError
from rgbt.config.overrides import hydra_sentence
from sweeps.run.executors import open_executor
from sweeps.run.local import LocalExecutor
from tests.sweeps.fakes import settings


def test_a_launcher_that_is_not_installed_names_the_extra() -> None:
    for name in ("submitit_slurm", "submitit_local"):
        error = MissingConfigException("", f"hydra/launcher/{name}", ["basic", "ray"])
        said = f"hydra/launcher={name}: it needs pip install 'rgbt[slurm]'."
        assert hydra_sentence(error, []) == said


def test_gpus_are_chosen_for_jobs_of_this_machine_alone() -> None:
    with pytest.raises(InputError, match=r"gpus=\[0\]: hydra/launcher=ray chooses"):
        open_executor(settings(launcher="ray", gpus=(0,)))


def test_jobs_of_this_machine_are_waited_for() -> None:
    found = [open_executor(settings(workers=workers)) for workers in (None, 3)]
    assert [type(executor) for executor in found] == [LocalExecutor, LocalExecutor]
    assert [executor.slots for executor in found] == [1, 3]


def test_jobs_of_slurm_are_found_with_any_variables_of_the_user(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Those of squeue filter its list, and USER may name another person."""
    submitit_jobs = pytest.importorskip("sweeps.run.submitit_jobs", exc_type=ImportError)
    squeue = tmp_path / "squeue"
    squeue.write_text('#!/bin/sh\nenv | grep -q ^SQUEUE_ || echo "7_${5#--user=}|PENDING"\n')
    squeue.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}{os.pathsep}{os.environ['PATH']}")
    for name in ("USER", "LOGNAME", "SQUEUE_PARTITION", "SQUEUE_NAMES"):
        monkeypatch.setenv(name, "other")
    assert submitit_jobs.states_of_slurm() == {f"7_{os.getuid()}": "queued"}
