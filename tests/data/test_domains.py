"""Domains: heads that cannot be distinguished are refused, and which head predicts an image."""

from __future__ import annotations

import itertools
from typing import Any

import pytest

from rgbt.checks import InputError
from rgbt.data.domains import Domain, Domains
from rgbt.types import VIEWS


def domain(**changes: Any) -> Domain:
    given: dict[str, Any] = {"split": "train", "view": None, "head": None, "labels": "given"}
    return Domain(**{**given, **changes})


def domains(**changes: Any) -> Domains:
    given: dict[str, Any] = {"source": domain(), "target": None, "target_is": None}
    return Domains(**{**given, "tested_head": "own", **changes})


def two(target_is: str, **changes: Any) -> Domains:
    return domains(
        source=domain(view="rgb", head="day"),
        target=domain(view="thermal" if target_is == "view" else "rgb", head="dark"),
        **{"target_is": target_is, **changes},
    )


def test_confidence_of_labels_without_one_is_refused() -> None:
    for labels in ("given", "none"):
        with pytest.raises(InputError, match=f"confidence=true requires .* labels={labels}"):
            domain(labels=labels, confidence=True)
    assert domain(labels="experiment:x/best.pt", confidence=True).confidence


def heads(source: str | None, target: str | None, **changes: Any) -> dict[str, Any]:
    return {"source": domain(head=source), "target": domain(head=target), **changes}


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"source": domain(labels="none")}, "domains.source.labels=none"),
        (heads("day", None), "got day and null"),
        (heads(None, "dark"), "got null and dark"),
        (heads("a", "b"), "domains.target_is=null .* with 2 heads"),
        (heads(None, None, target_is="view"), "domains.target_is=view .* with 0 heads"),
        (heads("a", "a", target_is="night"), "domains.target_is=night .* with 1 heads"),
        (heads("a", "a", tested_head="source"), "tested_head=source with 1 heads"),
        (heads("a", "b", target_is="view"), "target_is=view selects the head of an image"),
    ],
)
def test_domains_that_cannot_be_distinguished_are_refused(
    changes: dict[str, Any], sentence: str
) -> None:
    with pytest.raises(InputError, match=sentence):
        domains(**changes)
    same = {"source": domain(view="rgb", head="a"), "target": domain(view="rgb", head="b")}
    with pytest.raises(InputError, match="target_is=view"):
        domains(**same, target_is="view")


def test_the_only_head_predicts_everything() -> None:
    alone, both = domains(source=domain(head="a")), two("night")
    assert (list(alone.named), alone.heads) == (["source"], ("a",))
    assert (list(both.named), both.heads) == (["source", "target"], ("day", "dark"))
    assert domains(source=domain(head="a"), target=domain(head="a")).heads == ("a",)
    for view, night in itertools.product(VIEWS, (True, False, None)):
        assert domains(target=domain()).head_of(view, night, "own") is None
        assert alone.head_of(view, night, "own") == "a"
    for requested in ("source", "target"):
        with pytest.raises(InputError, match=f"head={requested} selects one of two heads"):
            alone.head_of("rgb", None, requested)


def test_the_head_of_a_view() -> None:
    found = two("view")
    for night in (True, False, None):
        assert found.head_of("thermal", night, "own") == "dark"
        assert found.head_of("rgb", night, "own") == "day"
        assert found.head_of("rgbt", night, "own") == "day"


def test_the_head_of_a_night() -> None:
    found = two("night")
    for view in VIEWS:
        assert found.head_of(view, True, "own") == "dark"
        assert found.head_of(view, False, "own") == "day"
        with pytest.raises(InputError, match="does not state which images were taken at night"):
            found.head_of(view, None, "own")
