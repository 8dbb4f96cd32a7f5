"""Every experiment, command and configuration group has a page (docs/guides.yaml)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import yaml

from rgbt.config.plain_command import COMMANDS
from tests.docs.pages import ROOT

GUIDES = ROOT / "docs" / "guides.yaml"
PLACE = "docs/guides.yaml"


def names() -> dict[str, list[str]]:
    """What needs a page, by the key of the file that lists it."""
    conf = ROOT / "conf"
    folders = sorted(path for path in conf.rglob("*") if path.is_dir())
    with_files = [path for path in folders if any(path.glob("*.yaml"))]
    return {
        "experiments": sorted(path.stem for path in (conf / "experiment").glob("*.yaml")),
        "commands": list(COMMANDS),
        "groups": [path.relative_to(conf).as_posix() for path in with_files],
    }


def problems_of(guides: Any, docs: Path, expected: dict[str, list[str]]) -> list[str]:
    """What is wrong with the list of pages, one sentence each.

    Args:
        guides: content of the file.
        docs: folder of the pages.
        expected: what needs a page, by key of the file.
    """
    problems = []
    for kind, needed in expected.items():
        listed = (guides or {}).get(kind) or {}
        one = kind.removesuffix("s")
        for name in needed:
            if name not in listed:
                problems.append(
                    f"{PLACE}: the {one} '{name}' has no page. Describe it on a page of docs/ and "
                    f"add the line '{name}: PAGE.md' below '{kind}:' (PAGE.md relative to docs/)."
                )
                continue
            page = docs / str(listed[name])
            if not page.is_file():
                problems.append(f"{PLACE}: {kind}.{name}: {listed[name]} is not a file of docs/.")
            elif name not in page.read_text():
                problems.append(
                    f"docs/{listed[name]} does not name the {one} '{name}', of which {PLACE} says "
                    "that it is the page. Name it there, or list the page that describes it."
                )
        for name in sorted(set(listed) - set(needed)):
            problems.append(
                f"{PLACE}: there is no {one} '{name}' any more. Remove the line, and what the page "
                f"{listed[name]} says about it."
            )
    return problems


def test_every_experiment_command_and_group_has_a_page() -> None:
    if not GUIDES.is_file():
        pytest.fail(f"{PLACE} is missing: it lists the page of every experiment, command and group")
    problems = problems_of(yaml.safe_load(GUIDES.read_text()), ROOT / "docs", names())
    assert not problems, "\n" + "\n".join(problems)


def test_names_are_read_from_the_repository() -> None:
    found = names()
    assert "grbm" in found["experiments"]
    assert "evaluate" in found["commands"]
    assert {"masker", "model/inputs", "hydra/sweeper"} <= set(found["groups"])


@pytest.mark.parametrize(
    ("guides", "problem"),
    [
        ({}, "the experiment 'grbm' has no page. Describe it on a page of docs/ and add the line"),
        (None, "the experiment 'grbm' has no page."),
        ({"experiments": {"grbm": "gone.md"}}, "experiments.grbm: gone.md is not a file of docs/."),
        ({"experiments": {"grbm": "b.md"}}, "docs/b.md does not name the experiment 'grbm', of"),
        ({"experiments": {"grbm": "a.md", "crn": "a.md"}}, "there is no experiment 'crn' any more"),
    ],
)
def test_missing_page_is_named(guides: Any, problem: str, tmp_path: Path) -> None:
    (tmp_path / "a.md").write_text("# Masking\n\n`+experiment=grbm`\n")
    (tmp_path / "b.md").write_text("# Nothing\n")
    (found,) = problems_of(guides, tmp_path, {"experiments": ["grbm"]})
    assert problem in found


def test_complete_list_has_no_problem(tmp_path: Path) -> None:
    (tmp_path / "a.md").write_text("rgbt run +experiment=grbm\n")
    guides = {"experiments": {"grbm": "a.md"}, "commands": {"run": "a.md"}}
    assert problems_of(guides, tmp_path, {"experiments": ["grbm"], "commands": ["run"]}) == []
