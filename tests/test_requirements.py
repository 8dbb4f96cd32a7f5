"""What a component provides and requires."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from rgbt.checks import InputError
from rgbt.requirements import PLAIN, Record, Requirement, record_of
from rgbt.types import VIEWS


def test_record_of_component_without_record_has_defaults() -> None:
    record = record_of(object())
    assert record is PLAIN
    assert (record.outputs, record.views, record.heads) == ("scores", VIEWS, ())
    assert (record.frames, record.num_domains, record.shows_views) == (1, 1, False)
    assert (record.hides_cells, record.works_on_batches, record.crop_hw) == (True, False, None)
    assert (record.optimizers, record.networks, record.requires) == ({"main": ()}, {}, ())


def test_record_of_other_type_is_refused() -> None:
    with pytest.raises(InputError, match=r"SimpleNamespace.record is dict with views; expected"):
        record_of(SimpleNamespace(record={"views": 1}))


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
    assert Requirement("model", key, value).is_met_by(record) == is_met
