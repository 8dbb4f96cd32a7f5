"""The number of threads is that of the setting, or the run does not begin."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator

import pytest
import torch

from rgbt.checks import InputError
from rgbt.engine.device import fix_threads


@pytest.fixture(autouse=True)
def kept() -> Iterator[None]:
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


def test_fix_threads_does_not_depend_on_the_cores() -> None:
    for num_threads in (1, 3):
        fix_threads(num_threads)
        assert torch.get_num_threads() == num_threads


@pytest.mark.parametrize(
    ("name", "value", "is_refused"),
    [
        ("OMP_DYNAMIC", "TRUE", True),
        ("OMP_DYNAMIC", "false", False),
        ("OMP_THREAD_LIMIT", "1", True),
        ("OMP_THREAD_LIMIT", "2", False),
    ],
)
def test_fix_threads_refuses_what_would_take_fewer(
    monkeypatch: pytest.MonkeyPatch, name: str, value: str, is_refused: bool
) -> None:
    monkeypatch.setenv(name, value)
    if is_refused:
        with pytest.raises(InputError, match=rf"trainer.threads=2: unset {name}={value}"):
            fix_threads(2)
    else:
        fix_threads(2)


@pytest.mark.slow
def test_sums_are_the_same_on_any_machine_with_the_same_threads() -> None:
    """One core, and the variables that libraries read, change nothing; the setting does."""
    script = (
        "import os, sys\n"
        "if sys.argv[2] == 'one core': os.sched_setaffinity(0, list(os.sched_getaffinity(0))[:1])\n"
        "from rgbt.engine.device import fix_threads\n"
        "import torch\n"
        "fix_threads(int(sys.argv[1]))\n"
        "g = torch.Generator().manual_seed(0)\n"
        "x = torch.randn(3_000_001, generator=g)\n"
        "a, b = torch.randn(2, 700, 900, generator=g)\n"
        "print(float(x.sum()).hex(), float((a @ b.T).sum()).hex())\n"
    )

    def sums(threads: int, cores: str = "all", **environment: str) -> str:
        return subprocess.run(
            [sys.executable, "-c", script, str(threads), cores],
            capture_output=True,
            text=True,
            check=True,
            env={"PYTHONPATH": ".", **environment},
        ).stdout

    two = sums(2)
    assert sums(2, "one core") == two
    for variables in (
        {"OMP_NUM_THREADS": "1"},
        {"OMP_NUM_THREADS": "8", "MKL_NUM_THREADS": "1"},
        {"MKL_DYNAMIC": "TRUE", "OMP_WAIT_POLICY": "PASSIVE"},
    ):
        assert sums(2, **variables) == two, variables
    assert sums(1) != two
