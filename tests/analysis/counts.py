"""Counts of any shape for the tests of the analysis."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

import numpy as np

from rgbt.metrics.counts import Counts
from rgbt.metrics.scores import summary
from tests.measured import measurement


def counts_of(array: Any, **changed: Any) -> Counts:
    """(N, R, K, K), or of one image (R, K, K), counts as `Counts`.

    `changed`: other attributes of the counts, and fields of their measurement.
    """
    counts = np.asarray(array)
    counts = counts if counts.ndim == 4 else counts[None]
    values: dict[str, Any] = {
        "names": tuple(f"{index:05d}D" for index in range(len(counts))),
        "night": None,
        "classes": tuple(f"class{index}" for index in range(counts.shape[-1])),
        "partition": f"ring{counts.shape[1]}",
    }
    values |= changed
    own = {
        name: values.pop(name)
        for name in [field.name for field in fields(Counts)]
        if name in values
    }
    return Counts(counts=counts, **({"measurement": measurement(**values)} | own))


def result_of(key: str, counts: Counts) -> dict[str, Any]:
    """``result.json`` of the run `key` that ended with these counts."""
    return {"key": key, "dataset": counts.dataset, "test": summary(counts, counts.absent)}
