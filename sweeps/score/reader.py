"""Reads finished runs for verdicts: their tags, their counts, and what their settings say."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping
from typing import Any, NamedTuple

from rgbt.checks import InputError
from rgbt.metrics.counts import Counts
from rgbt.runs.folder import EXPERIMENT, SEED
from rgbt.runs.result import RunResult
from rgbt.runs.run_spec import RunSpec
from sweeps.plan.measurement import Words, counts_of, stored_at

EXTERNAL = "external.json"  # what the counts of a row that is not trained here depend on
SYNTHETIC, REAL = "synthetic scenes", "real images"

# Errors that the tags of a run may raise that somebody has edited.
ODD = (InputError, KeyError, ValueError, TypeError)


class Origin(NamedTuple):
    """What a run was made of.

    Attributes:
        images: "synthetic scenes", "real images of mfnet" (the name of their data set) or "unknown
            images".
        start: equal for runs that began from the same weights.
        lists: which lists it was trained and selected on, in words, or "".
        machine: graphics card or processor, or "" where it was not recorded.
    """

    images: str
    scale: str
    start: str
    lists: str
    machine: str


class RunReader:
    """Reads every file of finished runs once.

    Attributes:
        by_seed: the runs that a row of a table may be, by seed and key.
        remarks: one sentence on each run that has no seed or no experiment.
    """

    def __init__(self, runs: Iterable[RunResult] = ()) -> None:
        self.by_seed: dict[int, dict[str, RunResult]] = {}
        self.remarks: list[str] = []
        self._counts: dict[tuple[str, Words], Counts] = {}
        self._counted: set[tuple[str, Words]] = set()
        self._origins: dict[str, Origin] = {}
        self._seeds: dict[tuple[str, str], set[int]] = {}  # by experiment and typed scale
        for run in runs:
            try:
                tags = run.tags
                seed, experiment = int(tags[SEED]), tags[EXPERIMENT]
                typed = [word for word in run.description.overrides if word.startswith("scale=")]
            except ODD as error:
                self.remarks.append(f"Run {run.key} belongs to no table: {error!r}.")
                continue
            self.by_seed.setdefault(seed, {})[run.key] = run
            scale = typed[-1].removeprefix("scale=") if typed else ""
            self._seeds.setdefault((experiment, scale), set()).add(seed)

    def __iter__(self) -> Iterator[RunResult]:
        for runs in self.by_seed.values():
            yield from runs.values()

    def seeds(self, experiment: str, scale: str) -> list[int]:
        """Return the seeds of the runs of an experiment, but of those at another scale."""
        places = ((experiment, scale), (experiment, ""))
        return sorted({seed for place in places for seed in self._seeds.get(place, ())})

    def find(self, spec: RunSpec) -> RunResult | None:
        """Return the run of a specification (`RunSpec.is_run`)."""
        for run in self.by_seed[spec.seed].values():
            if spec.is_run(run):
                return run
        return None

    def counts(self, run: RunResult, words: Words) -> Counts:
        """Return the counts of a measurement; InputError where they are missing or damaged."""
        if (run.key, words) not in self._counts:
            try:
                self._counts[run.key, words] = counts_of(run, words)
            except OSError as error:
                raise InputError(f"run {run.key}: {error}") from error
        return self._counts[run.key, words]

    def has_counts(self, run: RunResult, words: Words) -> bool:
        """Return whether a run has the counts of a measurement."""
        if (run.key, words) not in self._counted and stored_at(run, words) is not None:
            self._counted.add((run.key, words))
        return (run.key, words) in self._counted

    def origin(self, run: RunResult) -> Origin:
        """Return what a run was made of, by its settings and its record."""
        if run.key not in self._origins:
            self._origins[run.key] = _origin_of(run)
        return self._origins[run.key]


def _origin_of(run: RunResult) -> Origin:
    described = run.folder / EXTERNAL
    if described.is_file():  # a row that was evaluated and not trained here
        node = json.loads(described.read_text())
        images, start = _images_of(node["dataset"][1]), run.key
        return Origin(images, str(node["scale"]), start, run.lists, run.machine)
    if not (run.folder / "config.yaml").is_file():
        return Origin("unknown images", "unknown", run.key, run.lists, run.machine)
    settings = run.settings
    scale = str(settings["scale"]["name"])
    weights = str(settings.get("pretrained") or settings["model"].get("weights") or "")
    if weights.startswith("common:"):
        is_one = settings["seeds"]["start"] == "common"
    else:  # a file is the same for all seeds, an upstream run is one of its seed
        is_one = bool(weights) and not weights.startswith("experiment:")
    start = "0" if is_one else str(settings["seed"])
    return Origin(_images_of(settings["dataset"]), scale, start, run.lists, run.machine)


def _images_of(dataset: Mapping[str, Any]) -> str:
    if ".synth" in str(dataset["_target_"]):
        return SYNTHETIC
    return f"{REAL} of {dataset['name']}"
