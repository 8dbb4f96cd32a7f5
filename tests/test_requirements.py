"""What a component provides and requires, and which missing requirement is reported."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from rgbt.checks import InputError
from rgbt.requirements import (
    DatasetRecord,
    LossRecord,
    NetworkRecord,
    Record,
    Requirement,
    SchemeRecord,
    check_requirements,
    record_of,
)
from rgbt.types import VIEWS

UNDECLARED = object()


def declaring(record: Record) -> Any:
    return SimpleNamespace(record=record)


@pytest.mark.parametrize(
    ("node", "key", "value", "component", "is_met"),
    [
        ("model", "outputs", "scores", UNDECLARED, True),
        ("model", "outputs", "masks", UNDECLARED, False),
        ("model", "views", ("thermal",), declaring(NetworkRecord(views=("rgb", "thermal"))), True),
        ("model", "views", VIEWS, declaring(NetworkRecord(views=("rgb", "thermal"))), False),
        ("model", "views", VIEWS, UNDECLARED, True),
        ("network of domains.target.labels", "views", VIEWS, UNDECLARED, True),
        ("model", "heads", ("day",), UNDECLARED, False),
        ("dataset", "num_classes", 9, declaring(DatasetRecord(num_classes=9)), True),
        ("dataset", "num_classes", 9, declaring(DatasetRecord(num_classes=5)), False),
        ("dataset", "num_classes", 9, UNDECLARED, True),  # None is not compared
        ("masker", "hides_cells", False, UNDECLARED, False),
        ("model", "shift", True, UNDECLARED, False),
        ("model", "shift", False, UNDECLARED, True),
        ("model", "shift", True, declaring(NetworkRecord(others={"shift": True})), True),
        ("model.weights", "pretrained", True, declaring(Record(others={"pretrained": True})), True),
    ],
)
def test_requirement_is_met(node: str, key: str, value: Any, component: Any, is_met: bool) -> None:
    need = Requirement(node, key, value, "scheme.pairs=2", advice="name a flow")
    components = {"scheme": declaring(SchemeRecord(requires=(need,))), node: component}
    if is_met:
        check_requirements(components)
    else:
        with pytest.raises(InputError, match=f"scheme.pairs=2 requires {key}=.*; name a flow, or"):
            check_requirements(components)
    del components[node]
    check_requirements(components)


def test_loss_without_record_requires_class_scores() -> None:
    masks = declaring(NetworkRecord(outputs="masks"))
    with pytest.raises(InputError, match="outputs=scores"):
        check_requirements({"loss": UNDECLARED, "model": masks})
    check_requirements({"loss": UNDECLARED, "model": UNDECLARED})
    check_requirements({"loss": declaring(LossRecord()), "model": masks})


@pytest.mark.parametrize("record", [Record(), NetworkRecord(), None, {"frames": 1}])
def test_record_of_another_kind_is_refused(record: Any) -> None:
    with pytest.raises(InputError, match=r"record is .*; expected rgbt.requirements.LossRecord"):
        record_of(SimpleNamespace(record=record), LossRecord)


def test_error_of_a_record_is_not_taken_for_a_missing_one() -> None:
    class Wrong:
        @property
        def record(self) -> LossRecord:
            return LossRecord(frames=self.no_such_attribute)  # type: ignore[attr-defined]

    with pytest.raises(AttributeError, match="no_such_attribute"):
        record_of(Wrong(), LossRecord)
    assert record_of(object(), LossRecord) == LossRecord()
