"""Read a finished run from its folder; rgbt, sweeps and analysis all use this type."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from rgbt.checks import InputError
from rgbt.config.stored_config import read_settings
from rgbt.files.plain_files import check_links
from rgbt.metrics.counts import Counts, read_measurement
from rgbt.metrics.measurement import Measurement
from rgbt.metrics.metric import Regions
from rgbt.metrics.named import value
from rgbt.metrics.names import CA, CA_RELEASED, consistency, in_percent, subset
from rgbt.metrics.pairs import HEADLINES, protocol_of
from rgbt.metrics.scores import summary
from rgbt.runs.folder import (
    ADVICE,
    Description,
    counts_name,
    is_finished,
    read_description,
    read_provenance,
    read_result,
    run_key,
)
from rgbt.runs.provenance import commit_of, machine_name, other_code
from rgbt.terminal import warn

# Files of counts in a run folder: of what the run ended with, and of what was measured since.
COUNTS = ("counts_*.npz", "evaluations/*.npz")
OWN = "counts_test.npz"


@lru_cache(maxsize=10_000)
def _measurement(path: Path, _changed: int, _size: int) -> Measurement:
    """Return what a file is of; tables ask again and again."""
    return read_measurement(path)


def _check_step(step: int, best: int) -> None:
    """Refuse counts of another checkpoint than the best one of today (InputError)."""
    if step != best:
        raise InputError(f"it is of step {step}, but the best is of step {best}; measure it again.")


_warn_once = lru_cache(warn)  # what is polled would fill the log


@dataclass(frozen=True)
class RunResult:
    """The results of a finished run. Every property reads its file again.

    Attributes:
        folder: the run folder, or a folder with copies of its files.
        run_id: of the MLflow run that the copies come from, else "".

    Raises:
        InputError: the folder holds a link that leads out of it. Every property: a damaged file.
    """

    folder: Path
    run_id: str = ""

    def __post_init__(self) -> None:
        check_links(self.folder)

    @property
    def key(self) -> str:
        """Config key of the run, the name of its folder."""
        return self.folder.name

    @property
    def is_finished(self) -> bool:
        """Whether the run has its result."""
        return is_finished(self.folder)

    @property
    def result(self) -> dict[str, Any]:
        """``result.json`` (`rgbt.training.train`); InputError without its key or data set."""
        result, path = read_result(self.folder), self.folder / "result.json"
        if result is None or not {"key", "dataset"} <= result.keys():
            raise InputError(f"{path} is missing or names no run or data set; {ADVICE}.")
        return result

    @property
    def fingerprint(self) -> str:
        """Fingerprint of the data set that the run was made on."""
        return str(self.result["dataset"])

    @property
    def settings(self) -> dict[str, Any]:
        """Plain values of its configuration, from which nothing is built."""
        return read_settings(self.folder / "config.yaml")

    @property
    def description(self) -> Description:
        """Name, tags and parameters; empty where the folder has no ``run.json``."""
        return read_description(self.folder) or Description("", {}, {})

    @property
    def tags(self) -> dict[str, str]:
        """Tags by name."""
        return self.description.tags

    @property
    def lists(self) -> str:
        """Which lists it was trained and selected on, in words; "" without ``run.json``."""
        return self.tags.get("rgbt.lists", "")

    @property
    def machine(self) -> str:
        """Graphics card of the process that began it, else its processor; "" where not recorded."""
        return machine_name((self.provenance or [{}])[0])

    @property
    def provenance(self) -> list[dict[str, Any]]:
        """Entries of all processes that worked on the run, first one first."""
        return read_provenance(self.folder / "provenance.json")

    @property
    def commit(self) -> str | None:
        """Git commit of the code that made it; "+" is added for changes that were not committed."""
        return commit_of(next(iter(self.provenance), {})) or None

    @property
    def other_code(self) -> str | None:
        """The code that made it, in words, where it is not that of this process; else None."""
        return other_code(self.folder)

    def recorded_scores(self) -> dict[str, float]:
        """Return scores by "val/..." and "test/..." names, as MLflow shows them but not rounded."""
        result = self.result
        return {
            f"{split}/{name}": in_percent(name, value)
            for split in ("val", "test")
            for name, value in result.get(split, {}).items()
            if value is not None
        }

    def counts(self, split: str = "test") -> Counts:
        """Return the stored confusion counts of a split, per image and region.

        Args:
            split: "test" and the split that chose the checkpoint (usually "val") are always there;
                ``rgbt evaluate run=... split=...`` adds others. Or a file of the run folder:
                "evaluations/test_rgb.npz" (`measurements`).

        Raises:
            InputError: the run has no such counts, or the file is damaged.
        """
        path = self.folder / (split if split.endswith(".npz") else counts_name(split))
        if path.is_file() or split.endswith(".npz"):
            counts = Counts.load(path)
            _check_fits(self, counts, path)
            return self._scored(counts, path)
        how = "rerun the command of the run to finish it"
        if self.is_finished:
            how = f"write them with: rgbt evaluate run={self.folder} split={split}"
        raise InputError(f"{self.folder} has no counts of the split '{split}'; {how}.")

    def measurements(self) -> dict[str, Measurement]:
        """Return the files of counts inside the folder, and what they are of.

        A damaged one, or one of an earlier step than that of the finished run, is left out with a
        warning.
        """
        found, result = {}, read_result(self.folder) or {}
        for path in sorted(path for pattern in COUNTS for path in self.folder.glob(pattern)):
            try:
                file = path.stat()
                known = _measurement(path, file.st_mtime_ns, file.st_size)
                if (known.run, known.checkpoint) == (run_key(self.folder), "best"):
                    _check_step(known.step, result.get("best_step", known.step))
                found[path.relative_to(self.folder).as_posix()] = known
            except InputError as error:
                _warn_once(f"{path} is left out: {error}")
        return found

    def _scored(self, counts: Counts, path: Path) -> Counts:
        """Give counts the scored classes and the rule for absent ones of the run's own test."""
        own = self.folder / OWN
        if path == own or not own.is_file():
            return counts
        first = Counts.load(own)
        if first.classes != counts.classes:
            return counts
        measurement = replace(counts.measurement, absent=first.absent)
        return replace(counts, unscored=first.unscored, measurement=measurement)


def _check_fits(stored: RunResult, counts: Counts, path: Path) -> None:
    """Refuse counts of another run or of other labels than its own counts (InputError)."""
    advice = "restore the file of this run, or give its folder the name of the run"
    run, key = counts.measurement.run, run_key(stored.folder)
    if run not in ("", key) and not stored.run_id:
        raise InputError(f"{path} has counts of the run {run}, not of {key}; {advice}.")
    if protocol_of(counts.partition) and counts.counts.shape[1] % (len(counts.classes) + 1):
        raise InputError(f"{path} has other rows than {counts.partition}; {advice}.")
    result = read_result(stored.folder)
    if result is None or counts.dataset != result.get("dataset"):
        # A selection may have been made before files of the data set changed.
        if result is not None and path.parent == stored.folder and counts.split == "test":
            raise InputError(f"{path} has counts of other images than the run; {advice}.")
        return
    first = stored.folder / counts_name(counts.split)
    if path == first or not first.is_file() or protocol_of(counts.partition):
        return
    own = Counts.load(first)
    # Unreadable images may have been skipped, once or both times.
    known = set(own.names)
    names = [name for name in counts.names if name in known]
    is_part = len(names) in (len(own.names), len(counts.names))
    if not is_part or own.classes != counts.classes:
        raise InputError(f"{path} has counts of other images than {first.name}; {advice}.")
    mine, others = own.select(names).labelled(), counts.select(names).labelled()
    # Labels that are counted at another size have other numbers of pixels.
    is_alike = own.partition == counts.partition
    is_alike = is_alike and np.array_equal(mine.sum((1, 2)), others.sum((1, 2)))
    if is_alike and not np.array_equal(mine, others):
        raise InputError(f"{path} has counts of other labels than {first.name}; {advice}.")


def check_result(run: RunResult) -> None:
    """Compare the stored scores with those of the stored counts, and these with the settings.

    InputError: a score differs or is missing, or a file is damaged. A score whose counts the
    folder does not hold cannot be compared.
    """
    for pattern in COUNTS:
        for path in run.folder.glob(pattern):
            run.counts(path.relative_to(run.folder).as_posix())
    metric = dict(run.settings.get("metric", {}))
    metric.pop("_target_", None)
    own, given = run.counts(), run.result.get("test", {})
    if metric.keys() == Regions.__annotations__.keys():  # not of a user's own class
        wanted = Regions(**metric)
        if (own.partition, own.absent) != (wanted.name, wanted.absent):
            said = f"{own.partition} ({own.absent}), not of {wanted.name} ({wanted.absent})"
            raise InputError(f"{run.folder} has counts of {said}; {ADVICE}.")
    scores = {name: [score] for name, score in summary(own, own.absent).items()}
    for name, score in _further_scores(run):
        if name in given:
            scores.setdefault(name, []).append(score)
    for name, found in scores.items():
        stored = math.nan if given.get(name) is None else given[name]
        if not np.isclose(found, stored, rtol=0, atol=1e-9, equal_nan=True).any():
            raise InputError(
                f"{run.folder / 'result.json'} has {name} {stored}, but its counts give "
                f"{found[0]}; {ADVICE}."
            )


def _further_scores(run: RunResult) -> Iterator[tuple[str, float]]:
    """Yield scores of other views, heads and pairs by their names in ``result.json``."""
    for path, of in run.measurements().items():
        if of.split != "test" or len(of.changed) != 1:
            continue
        counts = run.counts(path)
        if (protocol := protocol_of(of.partition)) is not None:
            for name in HEADLINES[protocol][:2]:
                key = consistency(CA if name == CA_RELEASED else name, protocol)
                yield key, value(name, counts, counts.absent) / 100
        elif of.changed[0] in ("view", "head"):
            part = of.view if of.changed[0] == "view" else f"{of.head}_head"
            for name, score in summary(counts, counts.absent).items():
                yield subset(part, name), score
