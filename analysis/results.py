"""Counts of runs and of scored predictions, opened by their names."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Literal

import numpy as np

from rgbt.checks import InputError, nearest, split_list
from rgbt.metrics.counts import Counts
from rgbt.metrics.pairs import file_name, protocol_of
from rgbt.runs.folder import GROUP, Description, counts_name, find_run, runs_in
from rgbt.runs.result import RunResult
from rgbt.terminal import info

SEED = "rgbt.seed"

RUNS = "runs, files of counts or a group"
"""What a list may contain, for messages."""

Frames = Literal["", "aligned", "released", "next", "flow", "triples"]
"""Counts of single frames, or of pairs of frames by one protocol."""


@dataclass(frozen=True)
class NamedCounts:
    """Counts of a run or of a file, under the name that tables show.

    Attributes:
        label: of the method.
        run: that they are of; None for a file.
        seed: of the run; None for a file.
    """

    label: str
    path: Path
    counts: Counts
    run: RunResult | None = None
    seed: int | None = None

    @property
    def key(self) -> str:
        """Config key of the run; "" for a file."""
        return "" if self.run is None else self.run.key


def open_counts(
    text: str, runs_dir: Path | str = "runs", split: str = "", frames: Frames = ""
) -> tuple[NamedCounts, ...]:
    """The counts that `text` names, the seeds of one method one after the other.

    Args:
        text: a run (folder, config key or MLflow run id), a file of counts (.npz), the name of a
            group ("grbm sigma_div=2": all its seeds in `runs_dir`), or several of these with commas
            between them.
        runs_dir: where runs lie.
        split: "": the test split of runs, and whatever a file holds.
        frames: of runs, counts of single frames, or of pairs of frames by one protocol
            (`rgbt.metrics.pairs`); "": single frames of runs, and whatever a file holds.

    Raises:
        InputError: there is no such thing, a run has no counts of the split or of pairs, or a file
            is of others.
    """
    root = Path(runs_dir)
    # A group's name may hold commas itself: "crm train_sizes=[240,480]".
    is_whole = Path(text).suffix != ".npz" and bool(_of_group(text, root))
    words = [text] if is_whole else split_list(text, RUNS)
    found = [each for word in words for each in _open(word, root, split, frames)]
    for named in found:
        counts = named.counts
        if split and counts.split != split:
            raise InputError(
                f"{named.path} is of split '{counts.split}', not of split={split}; omit split=, "
                "or name counts of that split."
            )
        if frames and protocol_of(counts.partition) != frames:
            raise InputError(
                f"{named.path} is by {counts.partition}, not frames={frames}; omit frames=, "
                "or name a run or what rgbt consistency run=... counted so."
            )
    _check_trainings_differ(text, found)
    labels = dict.fromkeys(each.label for each in found)
    if len(labels) > 1:
        info(
            f"{' and '.join(labels)} are treated as seeds of one method, because they "
            "were listed together."
        )
    return tuple(found)


def _check_trainings_differ(text: str, found: Sequence[NamedCounts]) -> None:
    """Refuse a seed twice or equal counts: they are one training and would narrow the interval."""
    for first, second in combinations(found, 2):
        if first.path == second.path:
            raise InputError(f"'{text}' names {first.path} twice; one training counts once.")
        is_again = (first.label, first.seed) == (second.label, second.seed)
        if is_again and first.seed is not None:
            raise InputError(
                f"'{text}' names seed {first.seed} of '{first.label}' twice ({first.key} and "
                f"{second.key}, which differ in settings other than their overrides); name the "
                "runs."
            )
        is_one = first.label == second.label or not (first.run and second.run)
        if is_one and np.array_equal(first.counts.counts, second.counts.counts):
            raise InputError(
                f"'{text}': {first.path} and {second.path} hold the same counts; one training "
                "counts once."
            )


def groups_in(runs_dir: Path | str) -> list[str]:
    """Names of all groups with finished runs in a folder."""
    runs = [run for run in _runs(Path(runs_dir)) if run.is_finished]
    return sorted({_description(run).tags.get(GROUP, "") for run in runs} - {""})


def label_of(counts: Sequence[NamedCounts]) -> str:
    """Name of a method: its group, or the names of all its counts."""
    return " + ".join(dict.fromkeys(each.label for each in counts))


def _open(word: str, runs_dir: Path, split: str, frames: Frames) -> list[NamedCounts]:
    path = Path(word).expanduser()
    if path.suffix == ".npz":
        return [_of_file(path)]
    grouped = _of_group(word, runs_dir)
    if grouped:
        return [_of_run(folder, split, frames) for folder in grouped]
    if _is_folder(path) and not (path / "config.yaml").is_file():
        return [_of_scores(path)]
    try:
        folder = find_run(word, runs_dir)
    except (InputError, OSError) as error:  # OSError: longer than a file's name may be
        groups = groups_in(runs_dir)
        known = f" or a group of {runs_dir} ({nearest(word, groups)})" if groups else ""
        raise InputError(
            f"'{word}' is not a run folder, config key or MLflow run id in {runs_dir}, nor a file "
            f"of counts (.npz){known}."
        ) from error
    return [_of_run(RunResult(folder), split, frames)]


def _is_folder(path: Path) -> bool:
    try:
        return path.is_dir()
    except OSError:  # longer than a file's name may be
        return False


def _of_scores(folder: Path) -> NamedCounts:
    """The counts in a folder that `analysis.score` wrote: by rings, as the papers' tables are."""
    files = sorted(folder.glob("counts_ring*.npz")) or sorted(folder.glob("counts_*.npz"))
    if not files:
        raise InputError(
            f"{folder} contains neither a run (config.yaml) nor counts (counts_*.npz); to count "
            "label images of a method: rgbt score predictions=... dataset=..."
        )
    if len(files) > 1:
        raise InputError(
            f"{folder} contains {', '.join(file.name for file in files)}; name one of these files."
        )
    return _of_file(files[0])


def _of_file(path: Path) -> NamedCounts:
    """A file of counts, named after its folder where its file name is generic."""
    path = path.resolve()
    folder = path.parent.parent if path.parent.name == "evaluations" else path.parent
    label = folder.name if path.stem.startswith(("counts_", "consistency_")) else path.stem
    return NamedCounts(label, path, Counts.load(path))


def _of_group(word: str, runs_dir: Path) -> list[RunResult]:
    runs = _runs(runs_dir) if word else []  # "" is no group, but that of runs without one
    return [r for r in runs if word == _description(r).tags.get(GROUP) and r.is_finished]


def _runs(runs_dir: Path) -> list[RunResult]:
    return [RunResult(run.path) for run in runs_in(runs_dir)] if runs_dir.is_dir() else []


def _of_run(run: RunResult, split: str, frames: Frames) -> NamedCounts:
    split = split or "test"
    path = run.folder / file_name(frames, split) if frames else run.folder / counts_name(split)
    if frames and not path.is_file():
        views = {"next": "next", "flow": "video", "triples": "video"}.get(frames, "virtual")
        raise InputError(
            f"{run.folder} has no counts of pairs of frames {path.relative_to(run.folder)}; "
            f"rgbt consistency run={run.folder} split={split} frames={views} makes them once it is "
            "finished."
        )
    if not run.is_finished:
        info(f"{run.folder} is not finished; its counts are those of its last evaluation.")
    description = _description(run)
    seed = description.tags.get(SEED, "")
    return NamedCounts(
        label=description.tags.get(GROUP) or run.key,
        path=path,
        counts=Counts.load(path) if frames else run.counts(split),
        run=run,
        seed=int(seed) if seed else None,
    )


def _description(run: RunResult) -> Description:
    try:
        return run.description
    except (InputError, TypeError):  # a damaged run.json of some run is no reason to stop
        return Description("", {}, {})
