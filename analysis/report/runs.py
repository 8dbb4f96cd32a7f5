"""Runs of the store with their scores, recomputed from counts, and their provenance."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, cast, get_args

import numpy as np

from analysis.report.data import RunEntry
from analysis.report.runs_provenance import (
    COMMIT_TAG,
    as_text,
    hardware_of,
    host_of,
    read_provenance,
    repeat_command,
    versions_of,
)
from analysis.report.store import MlflowRun, RunFiles
from rgbt.checks import InputError, check_choice
from rgbt.config.compose import flatten
from rgbt.config.stored_config import settings_of
from rgbt.files.yaml_files import parse_yaml
from rgbt.metrics.counts import Counts
from rgbt.metrics.metric import Absent
from rgbt.metrics.names import in_percent
from rgbt.metrics.scores import absent_notes, iou, miou, summary
from rgbt.runs.provenance import COMMIT_LENGTH, commit_of, without_passwords
from sweeps.table.cells import OWN_COUNTS
from sweeps.table.request import DEFAULT_SCALE, TAG, UNTIL_DECIDED

STUDY_TAG = "rgbt.study/"
ABSENT = get_args(Absent)

SCALE = re.compile(r"(?:^|\s)scale=(\w+)")
ROUNDING = 0.0051
"""MLflow has two decimals: a larger difference is another number."""


@dataclass(frozen=True, kw_only=True)
class ReportRun:
    """A training of the store with its scores and settings, as the report uses it.

    Attributes:
        test_counts: that the run ended with; None where there are none.
        absent: how the run scores a class without pixels.
        config: dotted key -> value; empty where the store has no configuration.
        until_decided: tables for whose claims runs were added until they were decided.
    """

    entry: RunEntry
    test_counts: Counts | None
    absent: Absent
    config: Mapping[str, Any]
    files: RunFiles
    until_decided: tuple[str, ...] = ()
    _evaluations: dict[str, Counts] = field(default_factory=dict)

    @property
    def key(self) -> str:
        """Its config key."""
        return self.entry.key

    @property
    def commit(self) -> str | None:
        """Git commit of the code that made it."""
        return self.entry.commit or None

    def counts(self, path: str = OWN_COUNTS) -> Counts:
        """Counts of an evaluation, by the path of their file in the run.

        Raises:
            InputError: there is no such file, or it is damaged.
        """
        if path == OWN_COUNTS:
            if self.test_counts is None:
                raise InputError(f"run {self.key} has no counts.")
            return self.test_counts
        if path not in self._evaluations:
            found = self.files.find(path)
            if found is None:
                raise InputError(f"run {self.key} has no {path}.")
            self._evaluations[path] = _load(found, self.key)
        return self._evaluations[path]


def open_run(run: MlflowRun, remarks: list[str]) -> ReportRun:
    """Read one run.

    Args:
        run: of the kind "run".
        remarks: gets a sentence for everything that is missing or does not agree.
    """
    key = run.tags.get("rgbt.key", run.run_id)
    config = _config(run, remarks)
    counts = _counts(run, key, remarks)
    counted = "released" if counts is None else counts.absent
    absent = cast("Absent", config.get("metric.absent", counted))
    scores = {} if counts is None else percent_scores(counts, absent)
    remarks += _disagreements(key, run.metrics, scores)
    processes = read_provenance(run.files, key, remarks)
    first = processes[0] if processes else {}
    command = without_passwords(str(first.get("command") or run.tags.get("rgbt.command", "")))
    group = run.tags.get("rgbt.group", "")
    counted_fields: dict[str, Any] = {}
    if counts is not None:
        matrices, classes, scored = counts.by_region(), counts.classes, counts.scored
        counted_fields = {
            "split": counts.split,
            "partition": counts.partition,
            "classes": classes,
            "unscored": counts.unscored,
            "notes": absent_notes(matrices, classes, scored, counts.split, absent),
            "region_ious": _percents(miou(matrices, absent, scored)),
            "class_region_ious": tuple(_percents(row) for row in iou(matrices, absent).T),
            "images": len(counts.names),
        }
    entry = RunEntry(
        key=key,
        name=run.name,
        run_id=run.run_id,
        status=run.status,
        experiment=run.tags.get("rgbt.experiment", ""),
        scale=_scale_of(config, group),
        seed=int(seed) if (seed := run.tags.get("rgbt.seed", "")).isdecimal() else None,
        group=group,
        studies=tuple(_after(run.tags, STUDY_TAG)),
        table_rows=_after(run.tags, TAG),
        scores=scores,
        **counted_fields,
        commit=commit_of(first) or run.tags.get(COMMIT_TAG, "")[:COMMIT_LENGTH],
        started=run.started,
        seconds=run.seconds,
        resumed=len(processes) > 1,
        command=command,
        repeat=repeat_command(command, config, run.tags),
        host=host_of(first),
        hardware=hardware_of(first),
        versions=versions_of(first),
        dataset=run.tags.get("rgbt.dataset") or ("" if counts is None else counts.dataset),
        config={name: as_text(value) for name, value in config.items()} or dict(run.params),
    )
    return ReportRun(
        entry=entry,
        test_counts=counts,
        absent=absent,
        config=config,
        files=run.files,
        until_decided=tuple(_after(run.tags, UNTIL_DECIDED)),
    )


def _scale_of(config: Mapping[str, Any], group: str) -> str:
    """Name of the scale: of the configuration, else of the words of the group."""
    return str(config.get("scale.name") or (SCALE.findall(group) or [DEFAULT_SCALE])[-1])


def percent_scores(counts: Counts, absent: Absent) -> dict[str, float]:
    """`rgbt.metrics.scores.summary` in percent; variances stay in squared percent points."""
    return {name: in_percent(name, score) for name, score in summary(counts, absent).items()}


def _config(run: MlflowRun, remarks: list[str]) -> dict[str, Any]:
    try:
        text = run.files.text("config.yaml")
        if text is None:
            raise InputError("there is none")
        settings = flatten(settings_of(parse_yaml(text, "it"), "it"))
        check_choice("metric.absent", settings.setdefault("metric.absent", ABSENT[0]), ABSENT)
        return settings
    except InputError as error:
        said = " ".join(str(error).split()).rstrip(".")
        remarks.append(
            f"Run '{run.name}': config.yaml cannot be read ({said}); its parameters are shown."
        )
        return {}


def _counts(run: MlflowRun, key: str, remarks: list[str]) -> Counts | None:
    try:
        found = run.files.find(OWN_COUNTS)
        if found is not None:
            return _load(found, key)
    except InputError as error:
        remarks.append(f"Run '{run.name}' has no scores: {error}")
        return None
    if run.status == "FINISHED":
        remarks.append(f"Run '{run.name}' has no scores: its {OWN_COUNTS} is not in the store.")
    return None


def _load(path: Any, key: str) -> Counts:
    try:
        return Counts.load(path)
    except (ValueError, KeyError) as error:
        said = str(error).rstrip(".")
        raise InputError(f"the counts of run {key} cannot be used: {said}.") from error


def _disagreements(
    key: str, logged: Mapping[str, float], scores: Mapping[str, float]
) -> Iterator[str]:
    """A sentence where MLflow shows other scores than the counts give."""
    apart = {
        name: abs(logged[name] - score)
        for name, score in scores.items()
        if name in logged and not math.isnan(score) and abs(logged[name] - score) > ROUNDING
    }
    if apart:
        worst = max(apart, key=lambda name: apart[name])
        yield (
            f"Run {key}: {len(apart)} scores of its counts differ from those in MLflow, such "
            f"as {worst}: {scores[worst]:.2f} instead of {logged[worst]:.2f}; the page shows the "
            "scores of the counts."
        )


def _after(tags: Mapping[str, str], beginning: str) -> dict[str, str]:
    """Tags that begin so, by what follows."""
    found = {n.removeprefix(beginning): v for n, v in tags.items() if n.startswith(beginning)}
    return dict(sorted(found.items()))


def _percents(fractions: Any) -> tuple[float, ...]:
    return tuple(float(value) for value in 100.0 * np.asarray(fractions))
