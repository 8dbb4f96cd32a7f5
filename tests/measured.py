"""Measurements of counts that tests make by hand, and their files in the folder of a run."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from rgbt.evaluation.measure import EVALUATIONS
from rgbt.metrics.counts import Counts
from rgbt.metrics.details import details_of
from rgbt.metrics.measurement import Measurement
from rgbt.metrics.pairs import protocol_of

# Fields of measurements of a run that are no change of what it ends with.
OWN = {"run", "step", "split", "statistics_of"}


def measurement(**fields: Any) -> Measurement:
    """What a run without a name ends with, counted in five rings, or with other fields."""
    usual = {"dataset": "fingerprint", "split": "test", "view": "rgbt", "partition": "ring5"}
    return Measurement(**(usual | fields))


def remeasured(counts: Counts, **fields: Any) -> Counts:
    """The same counts with other fields of their measurement."""
    return replace(counts, measurement=replace(counts.measurement, **fields))


def differing(counts: Counts, **fields: Any) -> Counts:
    """Counts of a run that ended with another measurement than these fields; `changed` says so.

    Details and pairs of frames are no such end.
    """
    found = remeasured(counts, **fields)
    changed = {*found.measurement.differences(counts.measurement)} - OWN
    if details_of(found.partition) or protocol_of(found.partition):
        changed.add("partition")
    return remeasured(found, changed=tuple(sorted(changed)))


def store(folder: Path, counts: Counts, **fields: Any) -> Path:
    """Save `differing` counts in the folder of a run, where ``rgbt evaluate`` would."""
    found = differing(counts, **({"run": folder.name} | fields))
    place = folder if found.measurement.is_own else folder / EVALUATIONS
    place.mkdir(parents=True, exist_ok=True)
    found.save(place / found.measurement.file_name)
    return place / found.measurement.file_name
