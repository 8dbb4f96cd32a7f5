"""Finished runs of a folder and of an archive, their scores as one frame, and counts by name."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from analysis.archive import archived, unpack
from rgbt.checks import InputError, nearest, split_list
from rgbt.config.corruption_node import row_name
from rgbt.metrics import names
from rgbt.metrics.counts import Counts
from rgbt.metrics.details import details_of
from rgbt.metrics.measurement import CLEAN
from rgbt.metrics.metric import Absent
from rgbt.metrics.named import parse, value
from rgbt.metrics.pairs import protocol_of
from rgbt.metrics.score_grid import score_grid
from rgbt.metrics.scores import MEANS, iou, miou, recall, tally, variance
from rgbt.runs.folder import EXPERIMENT, GROUP, SEED, counts_name, find_run, is_finished, runs_in
from rgbt.runs.result import COUNTS, RunResult
from rgbt.terminal import info, tracked, warn

if TYPE_CHECKING:
    import pandas as pd

ALL = "all"  # subset of all images of a split

# Columns of `score_frame`, columns that say which counts they are of, and columns of `results`.
SCORE_COLUMNS = ("subset", "region", "class", "metric", "value")
OF_FILES = ("run", "experiment", "group", "seed", "split", "condition", "severity", "partition")
COLUMNS = (*OF_FILES, *SCORE_COLUMNS)

# One score in a frame: the values of `SCORE_COLUMNS`.
ScoreRow = tuple[str, int, str, str, float]

# Words of messages for what a list may contain.
RUNS = "runs, files of counts or a group"

# Counts of single frames, or of pairs of frames by one protocol.
Frames = Literal["", "aligned", "released", "next", "flow", "triples"]


@dataclass(frozen=True)
class Evaluation:
    """A file of counts, of a run or of another method.

    Attributes:
        run: that was evaluated; None: the file is in no run folder.
    """

    path: Path
    counts: Counts
    run: RunResult | None = None

    @property
    def condition(self) -> str:
        """`rgbt.metrics.measurement.Measurement.condition`."""
        return self.counts.measurement.condition

    @property
    def severity(self) -> float:
        """That of the corruption; NaN without one."""
        of = self.counts.measurement
        return of.severity if of.corruption else math.nan

    @property
    def said(self) -> str:
        """Condition and severity: "noise 16"."""
        severity = "" if math.isnan(self.severity) else f" {self.severity:g}"
        return f"{self.condition}{severity}"

    @property
    def key(self) -> str:
        """Config key of the run; "" for a file."""
        return "" if self.run is None else self.run.key

    @property
    def label(self) -> str:
        """Name of the method in tables: the group of the run, or the name of file or folder."""
        if self.run is not None:
            return self.run.tags.get(GROUP) or self.run.key
        of = self.counts.measurement
        if self.path.name == of.file_name and of.run:
            return " · ".join(filter(None, (of.run, of.label)))
        # Folders of rgbt score and of rgbt robustness have files of equal names.
        is_generic = self.path.name == of.file_name or self.path.stem.startswith("counts_")
        return self.path.parent.name if is_generic else self.path.stem

    @property
    def seed(self) -> int | None:
        """The seed of the run; None for a file."""
        text = "" if self.run is None else self.run.tags.get(SEED, "")
        return int(text) if text.isdecimal() else None


def finished_runs(runs: Path | str = "runs", archive: Path | str = "results") -> list[RunResult]:
    """Return the finished runs of a folder of runs and of an archive, by key.

    A missing folder or archive is empty. A damaged run is left out with a warning. Of a key with
    other counts in both, the run of the folder is taken, and a warning names the key. Archived runs
    are unpacked once, into the cache of the user.
    """
    root, found, differing = Path(runs), dict[str, RunResult](), set[str]()
    folders = [stored.path for stored in runs_in(root)] if root.is_dir() else []
    paths = [*filter(is_finished, folders), *archived(Path(archive))]
    # It takes a minute to unpack an archive of some hundred runs.
    for path in tracked(paths, "reading runs", len(paths)):
        try:
            run = unpack(path) if path.suffix == ".zip" else RunResult(path)
            _ = run.result, run.description  # they can be read
            first = found.setdefault(run.key, run)
            if first is not run and _has_other_counts(run, first):
                differing.add(run.key)
        except InputError as error:
            warn(f"{path} is left out: {error}")
    for key in sorted(differing):
        warn(f"{key} is stored with other counts, too; those of {found[key].folder} are used.")
    return [found[key] for key in sorted(found)]


def _has_other_counts(run: RunResult, first: RunResult) -> bool:
    """Compare the files of counts that both runs have."""
    for name in counts_of(run.folder) & counts_of(first.folder):
        counts, of_first = Counts.load(run.folder / name), Counts.load(first.folder / name)
        if not np.array_equal(counts.counts, of_first.counts):
            return True
    return False


def counts_of(folder: Path) -> set[Path]:
    """List the files of counts of a run, relative to its folder."""
    paths: list[Path] = []
    for pattern in COUNTS:
        paths += folder.glob(pattern)
    return {path.relative_to(folder) for path in paths}


def evaluations_of(run: RunResult, split: str = "test") -> Iterator[Evaluation]:
    """Yield the counts of a run on one split: as it ended, then everything else it was measured on.

    That is other inputs, pairs of frames, details and corruptions.

    A damaged file is left out with a warning.
    """
    for name, measurement in run.measurements().items():
        if measurement.split != split:
            continue
        path = run.folder / name
        try:
            yield Evaluation(path, run.counts(name), run)
        except InputError as error:
            warn(f"{path} is left out: {error}")


def score_frame(counts: Counts, absent: Absent | None = None) -> pd.DataFrame:
    """Compute every score of counts of single frames, of pairs of frames, or of details.

    `absent`: how a class without pixels scores (`rgbt.metrics.scores`); None: as counted.

    Returns:
        a row for each score, with the columns `SCORE_COLUMNS`: subset ("all", "day", "night"),
        region (0: the whole image), class ("": all scored classes), metric and value in percent;
        Var in squared points, NaN: nothing to score.
    """
    import pandas as pd

    absent = absent or counts.absent
    rows: list[ScoreRow] = []
    if is_plain(counts):
        for subset, part in {ALL: counts, **counts.parts()}.items():
            rows += _part_rows(subset, part, absent, counts.scored)
    else:
        for name in dict.fromkeys(score_grid(counts).metrics):
            of = parse(name)
            score = "/".join(filter(None, (of.score, of.bin)))
            place = of.part or ALL, of.region or 0, of.class_name or "", score
            rows.append((*place, value(name, counts, absent)))
    return pd.DataFrame(rows, columns=SCORE_COLUMNS)


def _part_rows(
    subset: str, counts: Counts, absent: Absent, scored: NDArray[np.bool_]
) -> Iterator[ScoreRow]:
    """Yield the scores of single frames of one subset; region 0 is the whole image."""
    by_region = tally(counts.by_region())
    places = np.concatenate([by_region.sum(0, keepdims=True), by_region])
    for metric, mean in MEANS.items():
        for region, score in enumerate(100 * mean(places, absent, scored)):
            yield subset, region, "", metric, float(score)
    of_regions = miou(by_region, absent, scored)
    yield subset, 0, "", names.VAR, float(variance(of_regions))
    for metric, by_class in (("IoU", iou), ("acc", recall)):
        for region, scores in enumerate(100 * by_class(places, absent)):
            for name, score in zip(counts.classes, scores.tolist(), strict=True):
                yield subset, region, name, metric, score


def results(
    runs: Path | str = "runs",
    archive: Path | str = "results",
    split: str = "test",
    *,
    absent: Absent | None = None,
    evaluations: bool = True,
) -> pd.DataFrame:
    """Compute the scores of all finished runs (`finished_runs`) as one frame: one score a row.

    `absent` is that of `score_frame`. Without `evaluations`, only the counts that a run ended with
    are read, and none of other inputs, corruptions, details and pairs of frames.

    Returns:
        the columns `COLUMNS`: run (its key), experiment, group (name that its seeds share), seed,
        split, condition, severity (NaN: not corrupted), partition of the image into regions, and
        those of `score_frame`.
    """
    import pandas as pd

    frames = []
    for run in finished_runs(runs, archive):
        for found in evaluations_of(run, split):
            if not evaluations and found.path.parent != run.folder:
                continue
            frame = score_frame(found.counts, absent)
            frames.append(
                frame.assign(
                    run=run.key,
                    experiment=run.tags.get(EXPERIMENT, ""),
                    group=run.tags.get(GROUP, ""),
                    seed=found.seed,
                    split=split,
                    condition=found.condition,
                    severity=found.severity,
                    partition=found.counts.partition,
                )
            )
    if not frames:
        return pd.DataFrame(columns=COLUMNS)
    return pd.concat(frames, ignore_index=True)[[*COLUMNS]].astype({"seed": "Int64"})


def open_counts(
    text: str,
    runs_dir: Path | str = "runs",
    split: str = "",
    frames: Frames = "",
    condition: str = "",
    archive: Path | str = "results",
) -> tuple[Evaluation, ...]:
    """Open the counts that `text` names, the seeds of one method one after the other.

    Args:
        text: a run (folder, config key or MLflow run id), a file of counts (.npz), the name of a
            group ("grbm sigma_div=2": all its seeds), or several of these with commas between them.
        runs_dir: where runs lie.
        split: "": the test split of runs, and whatever a file holds.
        frames: of runs, counts of single frames, or of pairs of frames by one protocol
            (`rgbt.metrics.pairs`); "": single frames of runs, and whatever a file holds.
        condition: of runs, counts of another input or of corrupted images: "thermal", "noise 16",
            "removed:rgb"; "": as the runs ended.
        archive: where archived runs lie, which have keys and groups as those of `runs_dir`.

    Raises:
        InputError: there is no such thing, a run lacks what is requested, or a file is of others.
    """
    found: list[Evaluation] = []
    for word in split_list(text, RUNS):
        for source in _named(word, Path(runs_dir), archive):
            if isinstance(source, RunResult):
                found.append(_of_run(source, split or "test", frames, condition))
            else:
                path = source.resolve()
                found.append(Evaluation(path, Counts.load(path)))
    for evaluation in found:
        path, counts = evaluation.path, evaluation.counts
        if split and counts.split != split:
            raise InputError(f"{path} is of split '{counts.split}', not of split={split}.")
        if frames and protocol_of(counts.partition) != frames:
            raise InputError(f"{path} is by {counts.partition}, not frames={frames}.")
    _check_trainings_differ(text, found)
    labels = _labels(found)
    if len(labels) > 1:
        info(f"{' and '.join(labels)}, listed together, are treated as seeds of one method.")
    return tuple(found)


def _check_trainings_differ(text: str, found: Sequence[Evaluation]) -> None:
    """Refuse a seed twice or equal counts: they are one training and would narrow the interval."""
    for first, second in combinations(found, 2):
        is_one = first.label == second.label or not (first.run and second.run)
        if is_one and np.array_equal(first.counts.counts, second.counts.counts):
            raise InputError(
                f"'{text}' names the same counts twice ({first.path} and {second.path}); one "
                "training counts once."
            )
        is_again = (first.label, first.seed) == (second.label, second.seed)
        if is_again and first.seed is not None:
            raise InputError(
                f"'{text}' names seed {first.seed} of '{first.label}' twice ({first.key} and "
                f"{second.key}, which differ in settings other than their overrides)."
            )


def label_of(evaluations: Sequence[Evaluation]) -> str:
    """Return the name of a method: its group, or the names of all its counts."""
    return " + ".join(_labels(evaluations))


def _labels(evaluations: Sequence[Evaluation]) -> list[str]:
    return list(dict.fromkeys(evaluation.label for evaluation in evaluations))


def _named(word: str, runs_dir: Path, archive: Path | str) -> Sequence[RunResult | Path]:
    """Find the runs, or the file of counts, that a word names."""
    path = Path(word).expanduser()
    if path.suffix == ".npz":
        return [path]
    try:
        return [RunResult(find_run(word, runs_dir))]
    except (InputError, OSError):  # OSError: longer than a file's name may be
        finished = finished_runs(runs_dir, archive)
    chosen = [run for run in finished if word in (run.key, run.tags.get(GROUP))]
    if chosen:
        return chosen
    # A folder that `analysis.score` wrote has counts by rings, as the papers' tables are, and more.
    files = []
    with suppress(OSError):
        files = sorted(path.glob("counts_ring*.npz")) or sorted(path.glob("counts_*.npz"))
    if len(files) > 1:
        listed = ", ".join(file.name for file in files)
        raise InputError(f"{path} has {listed}; name one of these.")
    groups = {run.tags.get(GROUP, "") for run in finished} - {""}
    known = f" or a group of {runs_dir} ({nearest(word, groups)})" if groups else ""
    known = known if finished else f"; neither {runs_dir} nor {archive} has a finished run"
    if not files:
        raise InputError(
            f"'{word}' is not a run (folder, config key or MLflow run id in {runs_dir}), nor counts"
            f" (.npz, or a folder of rgbt score){known}."
        )
    return files


def _of_run(run: RunResult, split: str, frames: Frames, condition: str) -> Evaluation:
    if not run.is_finished:
        info(f"{run.folder} is not finished; its counts are those of its last evaluation.")
    if not (frames or condition):
        return Evaluation(run.folder / counts_name(split), run.counts(split), run)
    known = list(evaluations_of(run, split))
    if frames:
        known = [found for found in known if protocol_of(found.counts.partition) == frames]
        chosen = [found for found in known if found.condition == found.counts.partition]
        # Other views than the published ones are marked, as all next frames.
        chosen = [found for found in chosen if "-" not in found.counts.partition] or chosen
    else:
        name, *severity = condition.split(" ", 1)
        wanted = " ".join((row_name(name), *severity))
        chosen = [found for found in known if wanted in (found.condition, found.said)]
    if len(chosen) == 1:
        return chosen[0]
    what = f"condition={condition}" if condition else f"frames={frames}"
    if chosen:
        files = ", ".join(found.path.name for found in chosen)
        raise InputError(f"{what} names {files} in {run.folder}; name one of these files.")
    counted = ", ".join(found.said for found in known) or "none"
    raise InputError(
        f"{what} is not counted in {run.folder}, which has {counted} of split '{split}'; rgbt "
        "consistency, robustness and evaluate make counts."
    )


def is_plain(counts: Counts) -> bool:
    """Say whether counts are of single frames, without details."""
    return details_of(counts.partition) is None and protocol_of(counts.partition) is None


# What rgbt robustness measured of one training: see `levels_of`.
Levels = tuple[Evaluation, ...]


def trainings(
    text: str, runs_dir: Path | str = "runs", split: str = ""
) -> list[tuple[str, Levels]]:
    """Open what rgbt robustness measured of the trainings that `text` names (see `open_counts`).

    A word may also name a folder that ``rgbt robustness out=...`` wrote. Returns the name of the
    method and the levels of each training. InputError: not measured.
    """
    found: list[tuple[str, Levels]] = []
    for word in split_list(text, RUNS):
        folder = Path(word).expanduser()
        files = [] if (folder / "config.yaml").exists() else sorted(folder.glob("*.npz"))
        if files:
            measured = [Evaluation(path, Counts.load(path)) for path in files]
            found.append((folder.name, levels_of(measured, folder)))
            continue
        for opened in open_counts(word, runs_dir, split):
            measured = []
            if opened.run is not None:
                measured = list(evaluations_of(opened.run, opened.counts.split))
            found.append((opened.label, levels_of(measured, opened.path.parent)))
    return found


def row_of(level: Evaluation) -> str:
    """Return the corruption, or the single input, of a level; "clean"."""
    of = level.counts.measurement
    return of.corruption or (of.view if "view" in of.changed else CLEAN)


def levels_of(measured: Sequence[Evaluation], folder: Path) -> Levels:
    """Sort clean images first, then single inputs, then corruptions by title and severity.

    Other measurements are left out. InputError: `folder` has no clean or no corrupted images.
    """
    allowed = {"view", "severity", "corruption"}
    if (
        measured
    ):  # what was changed for all of them, such as the size of the images, is no condition
        allowed |= set.intersection(*map(_changed, measured))
    found = [level for level in measured if _changed(level) <= allowed]
    is_clean = [row_of(level) == CLEAN for level in found]
    if all(is_clean) or not any(is_clean):
        what = "corrupted" if any(is_clean) else "clean"
        raise InputError(f"{folder} has no counts of {what} images; rgbt robustness makes them.")

    def order(level: Evaluation) -> tuple[bool, bool, str, str, float]:
        of = level.counts.measurement
        row = row_of(level)
        return row != CLEAN, of.unit != "", of.title or of.label, row, of.severity

    return tuple(sorted(found, key=order))


def _changed(level: Evaluation) -> set[str]:
    """Return the fields in which a measurement differs from that of its run, without their keys."""
    return {field.partition(".")[0] for field in level.counts.measurement.changed}
