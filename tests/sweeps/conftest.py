"""Fixtures of all tests of `sweeps`."""

from __future__ import annotations

import pytest

from sweeps.worker import executors


@pytest.fixture(autouse=True)
def no_template(monkeypatch: pytest.MonkeyPatch) -> None:
    """A command called in this process forks no copy of it; `test_executors` forks its own."""

    def forks_nothing(*, with_mlflow: bool) -> None:
        del with_mlflow

    monkeypatch.setattr(executors, "fork_template", forks_nothing)
