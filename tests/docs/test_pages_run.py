"""Every page of the documentation can be followed, with trainings of two steps: minutes."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from tests.docs.blocks import Page, pages

pytestmark = pytest.mark.docs

WITH_BLOCKS = [
    page
    for page in pages()
    if any(
        block.language in ("bash", "python") and not block.needs and "--cfg" not in block.text
        for block in page.blocks
    )
]
"""Pages with something to run; a configuration that is only printed is checked elsewhere."""


@pytest.mark.slow
@pytest.mark.parametrize("page", WITH_BLOCKS, ids=lambda page: page.name)
def test_page_can_be_followed(page: Page, follow: Callable[..., int]) -> None:
    assert follow(page) > 0
