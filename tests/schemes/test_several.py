"""Losses and gradients of several processes equal those of one, for every scheme and loss."""

from __future__ import annotations

from functools import cache

import pytest

from tests.processes import run_in_processes
from tests.schemes.several import CASES, Values, run_case

TOLERANCE = 1e-5
"""Of float32 sums in another order, relative to the largest value of a kind."""


@cache
def alone() -> dict[str, Values]:
    return everything()


@cache
def together() -> list[dict[str, Values]]:
    """By rank. Processes are started once for all tests."""
    return run_in_processes(everything, 2)


def everything() -> dict[str, Values]:
    return {name: run_case(name) for name in CASES}


def kind(name: str) -> str:
    """Gradients of one network in one phase have one scale; every other value is its own."""
    phase, what, network, *_ = (*name.split(), "")
    return f"{phase} {what} {network}" if what == "gradient" else name


def assert_same(found: Values, expected: Values) -> None:
    assert found.keys() == expected.keys()
    largest: dict[str, float] = {}
    for name, value in expected.items():
        here = float(value.detach().abs().max()) if value.numel() else 0.0
        largest[kind(name)] = max(largest.get(kind(name), 0.0), here)
    for name, value in expected.items():
        apart = (found[name] - value).abs()
        assert not apart.numel() or apart.max() <= TOLERANCE * largest[kind(name)], name


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_processes_compute_the_step_of_one(name: str) -> None:
    expected = alone()[name]
    for found in together():
        assert_same(found[name], expected)
    # Neither is nothing.
    losses = [value for key, value in expected.items() if " loss " in key]
    gradients = [value for key, value in expected.items() if " gradient " in key]
    assert all(value.isfinite().all() for value in expected.values())
    assert all(value != 0 for value in losses)
    assert any(value.any() for value in gradients)
