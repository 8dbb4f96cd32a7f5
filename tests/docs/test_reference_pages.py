"""The generated reference: every group, experiment, command and table is on its page."""

from __future__ import annotations

from pathlib import Path

import pytest

from rgbt.config.plain_command import COMMANDS

pytestmark = pytest.mark.docs

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def pages() -> dict[str, str]:
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(ROOT / "docs"))
        from reference_pages import generated_pages

        return generated_pages()


def test_every_folder_of_the_configuration_has_a_page(pages: dict[str, str]) -> None:
    folders = {path.parent.relative_to(ROOT / "conf") for path in ROOT.glob("conf/*/**/*.yaml")}
    for folder in {each.as_posix() for each in folders} - {"experiment"}:
        text = pages[f"reference/configuration/{folder.replace('/', '-')}.md"]
        for path in (ROOT / "conf" / folder).glob("*.yaml"):
            assert f"\n### {path.stem}\n" in text
            assert path.read_text().strip() in text


def test_every_group_says_what_it_sets(pages: dict[str, str]) -> None:
    rows = [line for line in pages["reference/configuration/index.md"].splitlines() if "](" in line]
    assert len(rows) == len({path.parent for path in ROOT.glob("conf/*/**/*.yaml")})
    assert not [row for row in rows if not row.split("|")[2].strip()]


def test_the_page_of_a_group_has_keys_types_defaults_and_meanings(pages: dict[str, str]) -> None:
    text = pages["reference/configuration/masker.md"]
    (row,) = (line for line in text.splitlines() if line.startswith("| `ratio` |"))
    assert "number from 0 to 1, or null" in row
    assert "share of the cells" in row
    (row,) = (
        line
        for line in pages["reference/configuration/optimizer.md"].splitlines()
        if line.startswith("| `momentum` |")
    )
    assert "(sgd" in row  # set by a file that is not the default


def test_an_experiment_shows_its_command_and_what_it_expects(pages: dict[str, str]) -> None:
    text = pages["reference/experiments.md"]
    for path in (ROOT / "conf" / "experiment").glob("*.yaml"):
        assert f"\n## {path.stem}\n" in text
    grbm = text.partition("\n## grbm\n")[2].partition("\n## ")[0]
    assert "rgbt run +experiment=grbm" in grbm
    assert "**Expect**: 61.79 mIoU" in grbm


def test_a_command_shows_its_options(pages: dict[str, str]) -> None:
    text = pages["reference/commands.md"]
    for name in COMMANDS:
        assert f"\n## {name}\n" in text
    evaluate = text.partition("\n## evaluate\n")[2].partition("\n## ")[0]
    assert "| `checkpoint` | 'best' or 'last' | `best` |" in evaluate
    assert "\n### weights inspect\n" in text


def test_every_published_table_is_shown_with_its_values(pages: dict[str, str]) -> None:
    text = pages["reference/tables.md"]
    for path in (ROOT / "sweeps" / "tables").rglob("*.yaml"):
        assert f"\n## {path.parent.name}/{path.stem}\n" in text
    assert "61.79" in text.partition("\n## spatialseg/table3\n")[2].partition("\n## ")[0]
