"""Measurements that tables request of finished runs, as words of the commands that make them."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any, Literal, TypeAlias

from rgbt.checks import InputError
from rgbt.config.component import build
from rgbt.config.compose import compose
from rgbt.config.corruption_node import choose_corruption
from rgbt.config.overrides import composing
from rgbt.metrics.counts import Counts
from rgbt.metrics.details import DEFAULTS, SCENE_KINDS, Details
from rgbt.metrics.measurement import Measurement, dataset_words, settings_of
from rgbt.metrics.pairs import protocol_of
from rgbt.runs.result import OWN, RunResult

# The head that predicts: that of the domain of an image, or that of one domain for all images.
Head = Literal["as trained", "own", "source", "target"]

BATCH = "data.eval_batch_size"

# Options of rgbt evaluate and overrides of the data set, such as ("modality=rgb",
# "details=boundary"); of pairs of frames their protocol ("frames=aligned",). (): the test that a
# run ends with.
Words: TypeAlias = tuple[str, ...]


def command_of(words: Words) -> Words:
    """Return the module that makes a measurement, and its arguments except the run.

    One call makes both protocols of virtual views, or several details.
    """
    options = _options(words)
    if protocol := options.get("frames"):
        return ("rgbt.consistency", f"frames={'next' if protocol == 'next' else 'virtual'}")
    arguments = []
    for word in words:
        kind = word.removeprefix("details=")
        together = "all" if kind in SCENE_KINDS else "boundary,calibration"
        arguments.append(word if kind == word else f"details={together}")
    return ("rgbt.evaluate", *arguments)


def stored_at(result: RunResult, words: Words) -> str | None:
    """Find the file, inside the folder of a finished run, with the counts of a measurement."""
    if not words:
        return OWN
    known = result.measurements()
    base = known.get(OWN)
    if base is None and words[0].startswith("frames="):
        # Pairs of frames may be all that there is of weights or predictions.
        of_files = [found for found in known.values() if not found.run]
        base = of_files[0] if of_files else None
    if base is None:
        return None
    wanted = measurement_of(words, base)
    return next((path for path, found in known.items() if _is_same(found, wanted)), None)


def counts_of(result: RunResult, words: Words) -> Counts:
    """Read the counts of a measurement of a run; InputError: there are none, or damaged ones."""
    path = stored_at(result, words)
    if path is None:
        shown = "this world" if dataset_words(words) else " ".join(words)
        raise InputError(f"there are no counts of {shown}; evaluate the run to write them.")
    return result.counts(path)


def _is_same(found: Measurement, wanted: Measurement) -> bool:
    if wanted.dataset_words:  # they say which images these are
        return set(wanted.differences(found)) <= {"dataset"}
    protocol = protocol_of(wanted.partition)
    if protocol is None or protocol != protocol_of(found.partition):
        # Statistics are of the usual batches, of which the test of the run says nothing.
        is_usual = wanted.statistics != "as trained" and BATCH not in found.changed
        return set(wanted.differences(found)) <= ({BATCH} if is_usual else set())
    # The next frames are those of the data set, whose motion marks the partition.
    is_usual = protocol == "next" or "-" not in found.partition
    return is_usual and set(wanted.differences(found)) <= {"partition"}


def measurement_of(words: Words, base: Measurement) -> Measurement:
    """Return what `words` request of a run; `base` is the test that it ended with."""
    options = _options(words)
    found: dict[str, Any] = {"partition": base.partition}
    if (view := options.get("modality", "default")) != "default":
        found["view"] = view
    if head := options.get("head"):
        found["head"] = head
    if statistics := options.get("batch_norm"):
        splits = dict.fromkeys(filter(None, options.get("batch_norm_splits", "").split(",")))
        found |= {"statistics": statistics, "statistics_of": tuple(splits)}
    if name := options.get("corruption"):
        chosen = choose_corruption(name)
        severity = float(options.get("severity", chosen.node["severities"][0]))
        settings = {**dict(base.settings), **dict(settings_of(chosen.settings))}
        if severity:  # else the images are clean
            found |= {"severity": severity, "settings": tuple(sorted(settings.items()))}
    if regions := options.get("regions"):
        found["partition"] = _partition_of(regions)
    if kind := options.get("details"):
        details: Any = kind
        found["partition"] = Details(details, DEFAULTS[details]).partition(found["partition"])
    if protocol := options.get("frames"):
        found["partition"] = f"{protocol}0"
    if overrides := dataset_words(words):
        found |= {"dataset_words": overrides, "dataset": ""}
    return replace(base, **found)


def _options(words: Words) -> dict[str, str]:
    return dict(word.split("=", 1) for word in words)


@cache
def _partition_of(regions: str) -> str:
    words = [f"metric={regions}"]
    with composing(words):
        name: str = build(compose(words).metric).name
    return name
