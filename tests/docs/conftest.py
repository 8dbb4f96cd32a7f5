"""Fixtures of the tests on the documentation."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from tests.commands import Call
from tests.docs.blocks import Page
from tests.docs.reader_folder import reading_in
from tests.docs.run_page import ENOUGH, SMOKE, Reader, copied


@pytest.fixture(scope="session")
def finished_runs(tmp_path_factory: pytest.TempPathFactory) -> Callable[[Path], None]:
    """Puts a finished run into a folder of runs; it is trained when it is first needed."""
    source = tmp_path_factory.mktemp("finished") / "runs"

    def make(runs: Path) -> None:
        from rgbt.run import main

        if not source.exists():
            words = ["+experiment=grbm", f"runs_dir={source}", "tracking=none", *SMOKE, ENOUGH]
            with pytest.MonkeyPatch.context() as patch:
                patch.setattr(sys, "argv", ["rgbt", *words])
                with pytest.raises(SystemExit) as left:
                    main()
            assert not left.value.code
        copied(source)(runs)

    return make


@pytest.fixture
def follow(
    tmp_path: Path, call: Call, finished_runs: Callable[[Path], None]
) -> Iterator[Callable[..., int]]:
    """Follows a page in an empty folder; how many of its commands and Python blocks ran."""

    def run(page: Page, *, quick: bool = False) -> int:
        return Reader(page, tmp_path, call, variables, finished_runs, quick).follow()

    with reading_in(tmp_path) as variables:
        yield run
