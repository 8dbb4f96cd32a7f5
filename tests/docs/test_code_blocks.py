"""Every page of the documentation is well formed, and its commands exist; nothing is trained.

`tests/docs/test_pages_run.py` follows the pages.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from tests.docs.blocks import Page, pages, tutorials_of_own_parts
from tests.docs.check_page import problems_of

pytestmark = pytest.mark.docs


@pytest.mark.parametrize("page", pages(), ids=lambda page: page.name)
def test_page_is_well_formed_and_its_commands_exist(page: Page, tmp_path: Path) -> None:
    problems = problems_of(page, tmp_path)
    assert not problems, "\n" + "\n".join(problems)


@pytest.mark.parametrize("page", tutorials_of_own_parts(), ids=lambda page: page.name)
def test_tutorial_of_own_parts_runs(page: Page, follow: Callable[..., int]) -> None:
    assert follow(page, quick=True), (
        f"{page.name} runs nothing; expected at least one block without a mark"
    )
