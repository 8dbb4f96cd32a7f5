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
from rich.console import Console
from rich.progress import track

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
from rgbt.metrics.scores import MEANS, iou, miou, recall, variance
from rgbt.runs.folder import GROUP, counts_name, find_run, is_finished, runs_in
from rgbt.runs.result import COUNTS, RunResult
from rgbt.terminal import info, warn

if TYPE_CHECKING:
    import pandas as pd

SEED, EXPERIMENT = "rgbt.seed", "rgbt.experiment"  # tags of runs
ALL = "all"  # subset of all images of a split

SCORE_COLUMNS = ("subset", "region", "class", "metric", "value")
OF_FILES = ("run", "experiment", "group", "seed", "split", "condition", "severity", "partition")
COLUMNS = (*OF_FILES, *SCORE_COLUMNS)
# Columns of `score_frame`, of what they are, and of `results`.

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
    """All finished runs of a folder of runs and of an archive, by key.

    A missing folder or archive is empty. A damaged run is left out with a warning. Of a key with
    other counts in both, the run of the folder is taken, and a warning names the key. Archived runs
    are unpacked once, into the cache of the user.
    """
    root, found, differing = Path(runs), dict[str, RunResult](), set[str]()
    folders = [each.path for each in runs_in(root)] if root.is_dir() else []
    paths = [*filter(is_finished, folders), *archived(Path(archive))]
    what, console = f"reading runs of {root} and {archive}", Console(stderr=True)
    is_hidden = not console.is_terminal
    # It takes a minute to unpack an archive of some hundred runs.
    for path in track(paths, what, console=console, transient=True, disable=is_hidden):
        try:
            run = unpack(path) if path.suffix == ".zip" else RunResult(path)
            _ = run.result, run.description  # they can be read
            first = found.setdefault(run.key, run)
            if first is run:
                continue
            for name in counts_of(run.folder) & counts_of(first.folder):
                one, two = (Counts.load(each.folder / name) for each in (first, run))
                differing |= set() if np.array_equal(one.counts, two.counts) else {run.key}
        except InputError as error:
            warn(f"{path} is left out: {error}")
    for key in sorted(differing):
        warn(f"{key} is stored with other counts, too; those of {found[key].folder} are used.")
    return [found[key] for key in sorted(found)]


def counts_of(folder: Path) -> set[Path]:
    """The files of counts of a run, inside its folder."""
    return {path.relative_to(folder) for each in COUNTS for path in folder.glob(each)}


def evaluations_of(run: RunResult, split: str = "test") -> Iterator[Evaluation]:
    """Counts of a run of one split: as it ended, then other inputs, pairs of frames, corruptions.

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
    """Every score of counts of single frames, of pairs of frames, or of details, one a row.

    `absent`: how a class without pixels scores (`rgbt.metrics.scores`); None: as counted.

    Returns:
        the columns `SCORE_COLUMNS`: subset ("all", "day", "night"), region (0: the whole image),
        class ("": all scored classes), metric and value in percent; Var in squared points, NaN:
        nothing to score.
    """
    import pandas as pd

    absent = absent or counts.absent
    rows: list[tuple[str, int, str, str, float]] = []
    if not _is_plain(counts):
        for name in dict.fromkeys(score_grid(counts).metrics):
            of = parse(name)
            score = "/".join(filter(None, (of.score, of.bin)))
            place = of.part or ALL, of.region or 0, of.class_name or "", score
            rows.append((*place, value(name, counts, absent)))
        return pd.DataFrame(rows, columns=SCORE_COLUMNS)
    for subset, part in {ALL: counts, **counts.parts()}.items():
        by_region = part.by_region()
        matrices = np.concatenate([by_region.sum(0, keepdims=True), by_region])
        for metric, mean in MEANS.items():
            values = 100 * mean(matrices, absent, counts.scored)
            rows += [(subset, region, "", metric, float(v)) for region, v in enumerate(values)]
        of_regions = miou(by_region, absent, counts.scored)
        rows.append((subset, 0, "", names.VAR, float(variance(of_regions))))
        for metric, by_class in (("IoU", iou), ("acc", recall)):
            for region, values in enumerate(100 * by_class(matrices, absent)):
                pairs = zip(counts.classes, values.tolist(), strict=True)
                rows += [(subset, region, name, metric, each) for name, each in pairs]
    return pd.DataFrame(rows, columns=SCORE_COLUMNS)


def results(
    runs: Path | str = "runs",
    archive: Path | str = "results",
    split: str = "test",
    *,
    absent: Absent | None = None,
    evaluations: bool = True,
) -> pd.DataFrame:
    """Scores of all finished runs (`finished_runs`) as one frame: one score a row.

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
        texts = run.key, run.tags.get(EXPERIMENT, ""), run.tags.get(GROUP, "")
        for each in evaluations_of(run, split):
            if not evaluations and each.path.parent != run.folder:
                continue
            found = (*texts, each.seed, split, each.condition, each.severity, each.counts.partition)
            of_file = dict(zip(OF_FILES, found, strict=True))
            frames.append(score_frame(each.counts, absent).assign(**of_file))
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
    """The counts that `text` names, the seeds of one method one after the other.

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
    for path, counts in ((each.path, each.counts) for each in found):
        if split and counts.split != split:
            raise InputError(f"{path} is of split '{counts.split}', not of split={split}.")
        if frames and protocol_of(counts.partition) != frames:
            raise InputError(f"{path} is by {counts.partition}, not frames={frames}.")
    _check_trainings_differ(text, found)
    if len(labels := dict.fromkeys(each.label for each in found)) > 1:
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


def label_of(counts: Sequence[Evaluation]) -> str:
    """Name of a method: its group, or the names of all its counts."""
    return " + ".join(dict.fromkeys(each.label for each in counts))


def _named(word: str, runs_dir: Path, archive: Path | str) -> Sequence[RunResult | Path]:
    """The runs, or the file of counts, that a word names."""
    path = Path(word).expanduser()
    if path.suffix == ".npz":
        return [path]
    try:
        return [RunResult(find_run(word, runs_dir))]
    except (InputError, OSError):  # OSError: longer than a file's name may be
        finished = finished_runs(runs_dir, archive)
    if chosen := [run for run in finished if word in (run.key, run.tags.get(GROUP))]:
        return chosen
    # A folder that `analysis.score` wrote has counts by rings, as the papers' tables are, and more.
    files = []
    with suppress(OSError):
        files = sorted(path.glob("counts_ring*.npz")) or sorted(path.glob("counts_*.npz"))
    if len(files) > 1:
        raise InputError(f"{path} has {', '.join(f.name for f in files)}; name one of these.")
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
    name, *severity = condition.split(" ", 1)
    wanted = " ".join((row_name(name), *severity))
    chosen = [each for each in known if condition and wanted in (each.condition, each.said)]
    if frames:
        known = [each for each in known if protocol_of(each.counts.partition) == frames]
        chosen = [each for each in known if each.condition == each.counts.partition]
        # Other views than the published ones are marked, as all next frames.
        chosen = [each for each in chosen if "-" not in each.counts.partition] or chosen
    if len(chosen) != 1:
        said = ", ".join(each.said for each in known) or "none"
        what = f"condition={condition}" if condition else f"frames={frames}"
        if chosen:
            files = ", ".join(each.path.name for each in chosen)
            raise InputError(f"{what} names {files} in {run.folder}; name one of these files.")
        raise InputError(
            f"{what} is not counted in {run.folder}, which has {said} of split '{split}'; rgbt "
            "consistency, robustness and evaluate make counts."
        )
    return chosen[0]


def _is_plain(counts: Counts) -> bool:
    """Whether they are of single frames, without details."""
    return details_of(counts.partition) is None and protocol_of(counts.partition) is None


@dataclass(frozen=True)
class Training:
    """One training on corrupted images; its levels: clean, then by title and rising severity."""

    label: str
    levels: tuple[Evaluation, ...]


def trainings(text: str, runs_dir: Path | str = "runs", split: str = "") -> list[Training]:
    """The trainings that `text` names (see `open_counts`), with what rgbt robustness measured.

    A word may also name a folder that ``rgbt robustness out=...`` wrote. InputError: not measured.
    """
    found: list[Training] = []
    for word in split_list(text, RUNS):
        folder = Path(word).expanduser()
        files = [] if (folder / "config.yaml").exists() else sorted(folder.glob("*.npz"))
        if files:
            every = [Evaluation(path, Counts.load(path)) for path in files]
            found.append(Training(folder.name, levels_of(every, folder)))
            continue
        for named in open_counts(word, runs_dir, split):
            stored = [] if named.run is None else evaluations_of(named.run, named.counts.split)
            found.append(Training(named.label, levels_of([*stored], named.path.parent)))
    return found


def row_of(level: Evaluation) -> str:
    """The corruption, or the single input, of a level; "clean"."""
    of = level.counts.measurement
    return of.corruption or (of.view if "view" in of.changed else CLEAN)


def levels_of(every: Sequence[Evaluation], folder: Path) -> tuple[Evaluation, ...]:
    """Clean images first, then single inputs, then corruptions by title and severity.

    InputError: `folder` has none of these, or not both.
    """
    changed = [{k.partition(".")[0] for k in e.counts.measurement.changed} for e in every]
    # What was changed for all of them, such as the size of the images, is no condition.
    allowed = {"view", "severity", "corruption"}.union(
        set.intersection(*changed) if changed else ()
    )
    found = [each for each, keys in zip(every, changed, strict=True) if keys <= allowed]
    is_clean = [row_of(each) == CLEAN for each in found]
    if all(is_clean) or not any(is_clean):
        what = "corrupted" if any(is_clean) else "clean"
        raise InputError(f"{folder} has no counts of {what} images; rgbt robustness makes them.")

    def order(each: Evaluation) -> tuple[bool, bool, str, str, float]:
        of = each.counts.measurement
        row = row_of(each)
        return row != CLEAN, of.unit != "", of.title or of.label, row, of.severity

    return tuple(sorted(found, key=order))
