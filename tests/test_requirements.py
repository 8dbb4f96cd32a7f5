"""What a component provides and requires, and which missing requirement is reported."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from rgbt.checks import InputError
from rgbt.requirements import PLAIN, Record, Requirement, check_requirements
from rgbt.types import VIEWS


@pytest.mark.parametrize(
    ("key", "value", "record", "is_met"),
    [
        ("outputs", "scores", PLAIN, True),
        ("outputs", "masks", PLAIN, False),
        ("views", ("thermal",), Record(views=("rgb", "thermal")), True),
        ("views", VIEWS, Record(views=("rgb", "thermal")), False),
        ("heads", ("day",), PLAIN, False),
        ("num_classes", 9, Record(num_classes=9), True),
        ("num_classes", 9, Record(num_classes=5), False),
        ("num_classes", 9, PLAIN, True),  # None is not compared
        ("shift", True, PLAIN, False),
        ("shift", False, PLAIN, True),
        ("shift", True, Record(others={"shift": True}), True),
    ],
)
def test_requirement_is_met(key: str, value: Any, record: Record, is_met: bool) -> None:
    need = Requirement("model", key, value, "scheme.pairs=2", advice="name a flow")
    assert need.is_met_by(record) == is_met
    components = {
        "scheme": SimpleNamespace(record=Record(requires=(need,))),
        "model": SimpleNamespace(record=record),
    }
    if is_met:
        check_requirements(components)
    else:
        with pytest.raises(InputError, match=f"scheme.pairs=2 requires {key}=.*; name a flow, or"):
            check_requirements(components)
    del components["model"]
    check_requirements(components)


def test_loss_without_record_requires_class_scores() -> None:
    masks = SimpleNamespace(record=Record(outputs="masks"))
    with pytest.raises(InputError, match="outputs=scores"):
        check_requirements({"loss": object(), "model": masks})
    check_requirements({"loss": object(), "model": object()})
