"""CITATION.cff, CHANGELOG.md and the forms of issues agree with the package."""

from __future__ import annotations

import re

import pytest
import yaml

import rgbt
from tests.docs.pages import ROOT, Page, problems_of

CFF_KEYS = {
    *("cff-version", "message", "type", "title", "abstract", "authors", "version", "license"),
    *("keywords", "references", "date-released", "repository-code", "url", "doi", "identifiers"),
}
"""Keys of CFF 1.2.0 at the top that this project may use."""

REFERENCE_KEYS = {
    *("type", "title", "authors", "notes", "year", "journal", "collection-title", "identifiers"),
    *("doi", "url", "volume", "issue", "start", "end", "institution", "thesis-type", "conference"),
}


def test_citation_has_the_fields_of_its_format() -> None:
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert citation["cff-version"] == "1.2.0"
    assert {"message", "title", "authors", "version", "references"} <= citation.keys() <= CFF_KEYS
    assert citation["version"] == rgbt.__version__
    assert citation["authors"] == [{"name": "The rgbt authors"}]
    for reference in citation["references"]:
        assert {"type", "title", "authors", "year"} <= reference.keys() <= REFERENCE_KEYS
        assert all(each.keys() == {"family-names", "given-names"} for each in reference["authors"])


def test_changelog_describes_this_version() -> None:
    text = (ROOT / "CHANGELOG.md").read_text()
    headings = re.findall(r"^## \[(.+?)\](?: - (\d{4}-\d\d-\d\d))?$", text, re.MULTILINE)
    assert headings[0] == ("Unreleased", "")
    assert headings[1][0] == rgbt.__version__, f"CHANGELOG.md: expected [{rgbt.__version__}] first"
    assert all(date for _, date in headings[1:])
    problems = problems_of(Page.read(ROOT / "CHANGELOG.md"))
    assert [each for each in problems if "link" in each] == []


@pytest.mark.parametrize("name", ["bug_report", "question_about_numbers", "new_component"])
def test_form_of_an_issue_is_complete(name: str) -> None:
    form = yaml.safe_load((ROOT / f".github/ISSUE_TEMPLATE/{name}.yml").read_text())
    assert {"name", "description", "body"} <= form.keys()
    identities = [each["id"] for each in form["body"]]
    assert len(set(identities)) == len(identities)
    for each in form["body"]:
        assert each["type"] in ("input", "textarea", "dropdown", "checkboxes")
        assert each["attributes"]["label"]
