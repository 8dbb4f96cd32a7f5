"""The launchers that a sweep works with, and what is said of the others."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from hydra.errors import MissingConfigException

from rgbt.checks import InputError
from rgbt.config.overrides import hydra_sentence
from sweeps.run import executors
from sweeps.run.executors import check_launcher, open_executor
from sweeps.run.local import LocalExecutor
from sweeps.settings import Launcher


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("joblib", r"works with .*, ray \(its n_jobs is hydra\.sweeper\.workers\)\.$"),
        ("rq", r"=rq: a sweep works with basic, submitit_local, submitit_slurm, ray\.$"),
        ("ray", r"ray: it needs pip install 'rgbt\[ray\]'"),
    ],
)
def test_other_and_missing_launchers_are_refused(
    monkeypatch: pytest.MonkeyPatch, name: str, said: str
) -> None:
    monkeypatch.setattr(executors, "find_spec", lambda _: None)
    check_launcher(Launcher())
    with pytest.raises(InputError, match=said):
        check_launcher(Launcher(name))


def test_a_launcher_that_is_not_installed_names_the_extra() -> None:
    for name in ("submitit_slurm", "submitit_local"):
        error = MissingConfigException("", f"hydra/launcher/{name}", ["basic", "ray"])
        said = f"hydra/launcher={name}: it needs pip install 'rgbt[slurm]'."
        assert hydra_sentence(error, []) == said


def test_gpus_are_chosen_for_jobs_of_this_machine_alone() -> None:
    with pytest.raises(InputError, match=r"gpus=\[0\]: hydra/launcher=ray chooses"):
        open_executor(Launcher("ray"), None, [0])
    found = [open_executor(Launcher(), workers, None) for workers in (None, 3)]
    assert [(type(each), each.slots) for each in found] == [(LocalExecutor, 1), (LocalExecutor, 3)]


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
