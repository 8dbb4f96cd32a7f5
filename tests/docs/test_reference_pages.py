"""The generated reference: every group, experiment, command and table is on its page."""

from __future__ import annotations

from pathlib import Path

import pytest

from rgbt.config.plain_command import COMMANDS
from tests.published.recipes import Row, Side, missing, sections

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


def test_page_of_group_has_keys_types_defaults_and_meanings(pages: dict[str, str]) -> None:
    text = pages["reference/configuration/masker.md"]
    (row,) = (line for line in text.splitlines() if line.startswith("| `ratio` |"))
    assert "number from 0 to 1 or null" in row
    assert "share of the cells" in row
    (row,) = (
        line
        for line in pages["reference/configuration/optimizer.md"].splitlines()
        if line.startswith("| `momentum` |")
    )
    assert "(sgd" in row  # set by a file that is not the default
    (row,) = (
        line
        for line in pages["reference/configuration/model.md"].splitlines()
        if line.startswith("| `pool_windows` |")
    )
    assert "sides of the windows" in row  # a comment of the file, not the docstring


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
    assert "| `checkpoint` | 'best', 'last' | `best` |" in evaluate
    assert "\n### weights inspect\n" in text


def test_external_networks_say_what_they_need_and_what_was_tried(pages: dict[str, str]) -> None:
    text = pages["reference/external-networks.md"]
    for row in (
        "| `rtfdnet` | mmengine, matplotlib and mmcv-lite before 2.1 | built, trained, "
        "evaluated and predicted (2026-11-30) |",
        "| `sigma_t` | timm, einops and fvcore | built (2026-11-26) |",
        "| `ecm` | - | built and predicted (2026-11-26) |",
    ):
        assert f"\n{row}\n" in text
    recipes = [path.stem for path in (ROOT / "conf/model/external").glob("*.yaml")]
    assert all(text.count(f"\n| `{name}` |") == 3 for name in recipes), "in all three tables"


def test_every_published_table_is_shown_with_its_values(pages: dict[str, str]) -> None:
    text = pages["reference/tables.md"]
    for path in (ROOT / "sweeps" / "tables").rglob("*.yaml"):
        assert f"\n## {path.parent.name}/{path.stem}\n" in text
    assert "61.79" in text.partition("\n## spatialseg/table3\n")[2].partition("\n## ")[0]


def test_every_published_setting_is_shown_with_its_sources(pages: dict[str, str]) -> None:
    text = pages["reference/recipes.md"]
    for section in sections():
        own = text.partition(f"\n### {section.title}\n")[2].partition("\n### ")[0]
        for row in section.rows:
            lines = [line for line in own.splitlines() if line.startswith(f"| `{row.key}` |")]
            places = [row.sides[each].place for each in ("paper", "release") if each in row.sides]
            assert any(all(f"({place})" in line for place in places) for line in lines), row.key
    (decay,) = (
        line for line in text.splitlines() if "Sec. IV-B" in line and "weight_decay" in line
    )
    cells = [cell.strip() for cell in decay.strip("|").split("|")]
    assert cells[2:4] == ["`0.001` (Sec. IV-B)", "`0.01` (config.py, weight_decay)"]
    assert cells[4] == "release: `cmx`, `temporal_con_released`; paper: the others"


def test_experiments_show_what_keeps_users_from_their_numbers(pages: dict[str, str]) -> None:
    text = pages["reference/recipes.md"]
    for name, sentence in missing().items():
        (line,) = (row for row in text.splitlines() if f"(experiments.md#{name})" in row)
        assert line.endswith(f" | {sentence} |")
    (line,) = (row for row in text.splitlines() if "#temporal_con)" in row)
    assert line.split(" | ")[1:3] == ["MFNet", "your file, mit_b2.pth"]
    (line,) = (row for row in text.splitlines() if "#sh_adversarial)" in row)
    assert line.split(" | ")[1:3] == ["Freiburg", "`experiment:sh_source/last.pt`"]


def test_the_side_of_a_row_is_named() -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(ROOT / "docs"))
        from reference_pages.recipes import _here
    same, other = Side(1, "p"), Side(2, "o")
    assert _here(Row("k", {"paper": same, "release": same}, {"a": "paper"})) == "both"
    assert _here(Row("k", {"paper": same, "release": other}, {"a": "release"})) == "release"
    assert _here(Row("k", {"paper": same, "ours": other}, {"a": "ours"})) == "`2` (o)"
    both = Row("k", {"paper": same, "ours": other}, {"a": "ours", "b": "paper", "c": "paper"})
    assert _here(both) == "ours, `2` (o): `a`; paper: the others"
