"""Finished runs of a folder and of an archive, their scores as one frame, and counts by name."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from analysis.archive.files import ArchivedRun, archived, counts_of
from rgbt.checks import InputError, nearest, split_list
from rgbt.files.plain_files import read_json
from rgbt.metrics import names
from rgbt.metrics.counts import Counts
from rgbt.metrics.details import KINDS, details_of, regions_of
from rgbt.metrics.metric import Absent
from rgbt.metrics.named import parse, value
from rgbt.metrics.pairs import file_name, protocol_of
from rgbt.metrics.score_grid import score_grid
from rgbt.metrics.scores import MEANS, iou, miou, recall, variance
from rgbt.runs.folder import (
    GROUP,
    Description,
    RunFolder,
    counts_name,
    find_run,
    is_finished,
    runs_in,
)
from rgbt.runs.result import RunResult
from rgbt.terminal import info, warn
from rgbt.types import VIEWS

if TYPE_CHECKING:
    import pandas as pd

SEED, EXPERIMENT = "rgbt.seed", "rgbt.experiment"

CLEAN, ALL = "clean", "all"
"""Condition of images as they are, as the run is made for; subset of all images of a split."""

SCORE_COLUMNS = ("subset", "region", "class", "metric", "value")
COLUMNS = (
    *("run", "experiment", "group", "seed", "split", "condition", "severity", "partition"),
    *SCORE_COLUMNS,
)
"""Columns of `score_frame` and `results`."""

RUNS = "runs, files of counts or a group"
"""What a list may contain, for messages."""

Frames = Literal["", "aligned", "released", "next", "flow", "triples"]
"""Counts of single frames, or of pairs of frames by one protocol."""


@dataclass(frozen=True)
class Evaluation:
    """A file of counts of a run.

    Attributes:
        path: of the file.
        condition: `CLEAN`, an input ("rgb"), or a corruption ("noise"), each followed by what else
            was changed: another head, checkpoint, data set or statistics of batch normalisation.
        severity: of the corruption; NaN for others.
        title: of the corruption, as shown; "" for others.
        unit: of the severity; "" where there is one alone.
    """

    path: Path
    counts: Counts
    condition: str = CLEAN
    severity: float = math.nan
    title: str = ""
    unit: str = ""


def finished_runs(runs: Path | str = "runs", archive: Path | str = "results") -> list[RunResult]:
    """All finished runs of a folder of runs and of an archive, by key.

    A missing folder or archive is empty. A damaged run is left out with a warning. Of a key with
    other counts in both, the run of the folder is taken, and a warning names the key. Archived runs
    are unpacked once, into the cache of the user.
    """
    root, found, differing = Path(runs), dict[str, RunResult](), set[str]()
    folders = runs_in(root) if root.is_dir() else []
    finished = [each for each in folders if is_finished(each.path)]
    sources: list[RunFolder | ArchivedRun] = [*finished, *archived(Path(archive))]
    for source in sources:
        try:
            run = RunResult(source.path) if isinstance(source, RunFolder) else source.unpack()
            _ = run.result, run.description  # they can be read
            if not _equal_counts(found.setdefault(run.key, run), run):
                differing.add(run.key)
        except InputError as error:
            warn(f"{source.path} is left out: {error}")
    for key in sorted(differing):
        warn(f"{key} is stored with other counts, too; those of {found[key].folder} are used.")
    return [found[key] for key in sorted(found)]


def _equal_counts(first: RunResult, other: RunResult) -> bool:
    """Whether what both runs have counted is equal."""
    if first is other:
        return True
    paths = {path.relative_to(first.folder) for path in counts_of(first.folder)}
    shared = sorted(paths & {path.relative_to(other.folder) for path in counts_of(other.folder)})
    pairs = ([Counts.load(run.folder / each) for run in (first, other)] for each in shared)
    return all(np.array_equal(one.counts, two.counts) for one, two in pairs)


def evaluations_of(run: RunResult, split: str = "test") -> Iterator[Evaluation]:
    """Counts of a run of one split: as it ended, then other inputs, pairs of frames, corruptions.

    A damaged file is left out with a warning.
    """
    for path in counts_of(run.folder):
        try:
            found = _evaluation(run, path)
        except (InputError, KeyError, TypeError, ValueError) as error:
            warn(f"{path} is left out: {error}")
            continue
        if found and found.counts.split == split:
            yield found


def _evaluation(run: RunResult, path: Path) -> Evaluation | None:
    """What a file is of; its name and the description beside it say so. None: again clean."""
    counts = run.counts(path.relative_to(run.folder).as_posix())
    if path.parent == run.folder:
        return Evaluation(path, counts)
    other = [] if counts.dataset == run.fingerprint else [f"dataset {counts.dataset[:8]}"]
    if (made_file := path.with_suffix(".json")).is_file():
        made = read_json(made_file, dict[str, Any], "rgbt robustness makes it again")
        rest = path.parent.name.removeprefix(counts.split).strip("_")
        condition = " ".join(filter(None, [str(made["row"]), rest, *other]))
        if condition == CLEAN:  # as the run ended
            return None
        severity, title, unit = float(made["severity"]), str(made["title"]), str(made["unit"])
        return Evaluation(path, counts, condition, severity, title, unit)
    if protocol_of(counts.partition):
        rest = path.stem.rpartition(f"_{counts.split}")[2].strip("_")
        return Evaluation(path, counts, " ".join(filter(None, [CLEAN, rest, *other])))
    after = f"({'|'.join(VIEWS)})_{regions_of(counts.partition)}(.*?)(-({'|'.join(KINDS)}))?"
    match = re.fullmatch(f".*_{re.escape(counts.split)}_{after}", path.stem)
    words = [match[1], match[2].strip("_")] if match else [path.stem]
    return Evaluation(path, counts, " ".join(filter(None, [*words, *other])))


def score_frame(counts: Counts, absent: Absent | None = None) -> pd.DataFrame:
    """Every score of counts, one a row.

    Args:
        counts: of single frames, of pairs of frames, or of details.
        absent: how a class without pixels scores (`rgbt.metrics.scores`); None: as the counts say.

    Returns:
        the columns `SCORE_COLUMNS`: subset ("all", "day", "night"), region (0: the whole image),
        class ("": all scored classes), metric and value in percent; Var in squared points, NaN:
        nothing to score.
    """
    import pandas as pd

    absent = absent or counts.absent
    rows: list[tuple[str, int, str, str, float]] = []
    if details_of(counts.partition) or protocol_of(counts.partition):
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

    Args:
        runs: folder of runs.
        archive: folder of archived runs.
        split: of the counts.
        absent: see `score_frame`.
        evaluations: whether to read counts of other inputs, corruptions, details and pairs of
            frames, too, and not only those that a run ended with.

    Returns:
        the columns `COLUMNS`: run (its key), experiment, group (name that its seeds share), seed,
        split, condition and severity (see `Evaluation`), partition of the image into regions, and
        those of `score_frame`.
    """
    import pandas as pd

    frames = []
    for run in finished_runs(runs, archive):
        tags = run.tags
        texts = run.key, tags.get(EXPERIMENT, ""), tags.get(GROUP, "")
        seed = int(tags[SEED]) if tags.get(SEED, "").lstrip("-").isdecimal() else pd.NA
        for each in evaluations_of(run, split):
            if not evaluations and each.path.parent != run.folder:
                continue
            found = (*texts, seed, split, each.condition, each.severity, each.counts.partition)
            of_file = dict(zip(COLUMNS, found, strict=False))
            frames.append(score_frame(each.counts, absent).assign(**of_file))
    if not frames:
        return pd.DataFrame(columns=COLUMNS)
    return pd.concat(frames, ignore_index=True)[[*COLUMNS]].astype({"seed": "Int64"})


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
