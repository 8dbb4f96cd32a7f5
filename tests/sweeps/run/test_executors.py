"""The launchers that a sweep works with, and what is said of the others."""

from __future__ import annotations

import pytest
from hydra.errors import MissingConfigException

from rgbt.checks import InputError
from rgbt.config.command import hydra_sentence
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
