"""Own runs at the top of the HTML page: pictures, charts, and what is not finished."""

from __future__ import annotations

import math
import shlex
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Any

from analysis.results import evaluations_of, levels_of
from analysis.uncertainty import Resampling
from rgbt.checks import InputError, one_line
from rgbt.metrics import names
from rgbt.metrics.named import value
from rgbt.metrics.scores import extremes
from rgbt.runs.folder import EXPERIMENT, GROUP, SEED, RunFolder, runs_in
from rgbt.runs.naming import short_word
from rgbt.runs.result import RunResult
from rgbt.tables import number
from sweeps.run.progress import duration
from sweeps.score.reader import RunReader
from sweeps.show.sections import ODD, number_of, public, short_names

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Runs whose images are shown, and methods or runs in a chart: the newest.
MAX_PICTURED, MAX_CHARTED = 3, 10

# Longest name of a method in a legend; "M1", ... stand for longer ones.
MAX_LETTERS = 32

# A run and what is read of it; a plain mapping, as templates take it.
Facts = dict[str, Any]


def own_section(
    runs: Sequence[RunResult],
    reader: RunReader,
    runs_dir: Path,
    resamples: int,
    remarks: list[str],
) -> dict[str, Any]:
    """Return what the page shows of the runs of `runs_dir`, those of an archive left out.

    Returns:
        "own": the runs, newest first; "range": their mIoU in words; "pictured": the first ones,
        with images; "kinds": charts of the runs on the same images; "unfinished": sentences.
    """
    home = runs_dir.resolve()
    own: list[Facts] = []
    for run in runs:
        if run.folder.parent == home:
            with suppress(*ODD):  # `runs_section` says so
                own.append(_facts(run, reader, remarks))
    own.sort(key=lambda run: run["time"], reverse=True)
    kinds: dict[Any, list[Facts]] = {}
    for facts in own:
        counts = facts["counts"]
        kinds.setdefault((counts.dataset, counts.classes, counts.partition), []).append(facts)
    for alike in kinds.values():
        _separate(alike)
        _name(alike)
    settings, numbers = Resampling(resamples=resamples), count()
    scores = [facts["miou"] for facts in own if not math.isnan(facts["miou"])]
    ends = [number(end) for end in (min(scores), max(scores))] if scores else []
    place = "" if runs_dir.is_absolute() else f"{runs_dir}/"
    return {
        "own": own,
        "range": " to ".join(dict.fromkeys(ends)),
        "pictured": [_pictured(facts, place) for facts in own[:MAX_PICTURED]],
        "kinds": [_kind(alike, settings, remarks, numbers) for alike in kinds.values()],
        "unfinished": [*_unfinished(runs_dir)],
        "place": place,
    }


def _facts(run: RunResult, reader: RunReader, remarks: list[str]) -> Facts:
    counts, lines = reader.counts(run, ()), []
    try:
        lines = RunFolder(run.folder, writes=False).lines()
    except InputError as error:
        remarks.append(f"Learning curve of {run.key}: {one_line(error)}")
    name = counts.measurement.dataset_name
    steps = number_of(int(run.result.get("steps", 0)), "step")
    seconds = duration(float(run.result["seconds_of_last_process"]))
    processes, miou = len(run.provenance), value(names.MIOU, counts, counts.absent)
    resumed = f" in the last of {processes} processes" * (processes > 1)
    return {
        "run": run,
        "key": run.key,
        "group": run.tags.get(GROUP, run.key),
        "seed": run.tags[SEED],
        "counts": counts,
        "lines": lines,
        "time": lines[-1].time if lines else 0.0,
        "miou": miou,
        "shown": [number(miou), number(value(names.VAR, counts, counts.absent))],
        "of": number_of(len(counts.names), "test image") + (f" of {name}" if name else ""),
        "trained": f"{steps}, {seconds}{resumed}",
    }


def _separate(alike: Sequence[Facts]) -> None:
    """Make methods of their own of runs with one seed, which differ in their files of settings."""
    trainings = [(run["group"], run["seed"]) for run in alike]
    for run, training in zip(alike, trainings, strict=True):
        if trainings.count(training) > 1:
            run["group"] += f" {run['key']}"


def _name(alike: Sequence[Facts]) -> None:
    """Add names to runs on the same images: of their methods and of themselves, and in charts.

    Charts have numbers instead of long names.
    """
    groups = [run["group"] for run in alike]
    whole = _as_people_read(short_names(groups)[0])
    named = {group: public(one_line(name)) for group, name in whole.items()}
    methods = [*dict.fromkeys(groups)]
    # Two methods stay two where their names are cut to the same words, and Matplotlib leaves out
    # of legends what begins with "_".
    is_apart = len({*named.values()}) == len(named)
    begin_well = all(name[:1] not in ("", "_") for name in named.values())
    is_short = is_apart and begin_well and max(map(len, whole.values())) <= MAX_LETTERS
    for run in alike:
        group, is_alone = run["group"], groups.count(run["group"]) == 1
        seed = "" if is_alone else f", seed {run['seed']}"
        run["method"] = named[group]
        code = named[group] if is_short else f"M{methods.index(group) + 1}"
        run["label"], run["series"], run["line"] = named[group] + seed, code, code + seed


def _as_people_read(named: Mapping[str, str]) -> Mapping[str, str]:
    """Write "grbm masker.sigma_div=2" as "grbm · σ 2", unless two methods were named alike."""
    read = {}
    for method, name in named.items():
        read[method] = " · ".join(map(short_word, name.split()))
    return read if len({*read.values()}) == len(read) else named


def _pictured(run: Facts, place: str) -> Facts:
    """A run with the pictures of its images, and what is missing in words."""
    from analysis.figures.page import stored_pictures

    images, missing = [], []
    legend: Sequence[Any] = ()
    for word, (name, score) in extremes(run["counts"]).items():
        path = run["run"].folder / "figures" / f"{word}.png"
        if not path.exists():
            missing.append(f"{path.name} is missing")
            continue
        try:
            of_image, legend, pictures = stored_pictures(path)
        except InputError as error:
            missing.append(f"{public(one_line(error))}: remove it")
            continue
        if of_image == name:
            images.append(
                {"word": word, "name": name, "score": number(score), "pictures": pictures}
            )
        else:
            missing.append(f"{path.name} is of '{of_image}' and not of '{name}': remove it")
    command = shlex.join(["rgbt", "evaluate", f"run={place}{run['key']}"])
    return {**run, "images": images, "legend": legend, "missing": missing, "command": command}


def _kind(
    runs: Sequence[Facts], settings: Resampling, remarks: list[str], numbers: Iterator[int]
) -> Facts:
    """The charts of runs on the same images, by the same classes and regions."""
    methods = [*dict.fromkeys(run["series"] for run in runs)]
    shown = [run for run in runs if run["series"] in methods[:MAX_CHARTED]]
    charts = []
    for title, make in _makers(shown, settings, remarks).items():
        try:
            charts.append((title, _drawn(make(), title, next(numbers))))
        except (*ODD, ArithmeticError) as error:  # numbers of a log that no axis holds
            remarks.append(f"{title}: {one_line(error)}")
    note = ""
    if len(methods) > MAX_CHARTED:
        note = f"The charts show the newest {MAX_CHARTED} of {len(methods)} methods."
    codes = {run["series"]: run["method"] for run in shown if run["series"] != run["method"]}
    return {"title": runs[0]["of"], "charts": charts, "note": note, "codes": codes}


def _drawn(figure: Figure, title: str, place: int) -> str:
    from analysis.figures.page import inline
    from analysis.figures.plots import content_of

    return inline(content_of(figure, "svg"), title, place)


def _makers(
    runs: Sequence[Facts], settings: Resampling, remarks: list[str]
) -> Mapping[str, Callable[[], Figure]]:
    """What draws each chart, by its title."""
    from analysis.figures import scores

    methods: dict[str, list[Any]] = {}
    levels: dict[str, list[Any]] = {}
    for run in runs:
        methods.setdefault(run["series"], []).append(run["counts"])
        found = run["run"]
        if any(of.corruption for of in found.measurements().values()):
            try:
                measured = levels_of([*evaluations_of(found)], found.folder)
            except InputError as error:
                remarks.append(one_line(error))
            else:
                levels.setdefault(run["series"], []).append(measured)
    lines = {run["line"]: run["lines"] for run in runs[:MAX_CHARTED] if run["lines"]}
    means = scores.region_means
    makers: dict[str, Callable[[], Figure]] = {
        "mIoU by region": lambda: scores.draw_profiles(
            means(methods, None, settings), settings.level
        ),
        "IoU by class": lambda: scores.draw_bars(scores.class_means(methods, None), "IoU (%)"),
    }
    if lines:
        makers["Learning curves"] = lambda: scores.draw_curves(scores.curve_points(lines))
    if levels:
        makers["mIoU under corruptions"] = lambda: scores.draw_bars(
            scores.corruption_means(scores.corrupted(levels, None)),
            "mIoU (%), mean over severities",
            [*methods],
        )
    return makers


def _unfinished(runs_dir: Path) -> Iterator[str]:
    """Say of each run that is not finished how far it is."""
    for folder in runs_in(runs_dir) if runs_dir.is_dir() else ():
        if RunResult(folder.path).is_finished:
            continue
        try:
            reached = max((line.step for line in folder.lines()), default=0)
            steps = RunResult(folder.path).settings["trainer"]["max_steps"]
            name = one_line(RunResult(folder.path).tags.get(EXPERIMENT, "a run"))
            state = f"{name}, step {reached} of {steps}"
            now = "is being trained" if folder.is_locked() else "is not finished"
        except ODD as error:
            state, now = one_line(error), "is not finished"
        yield public(f"{folder.path.name} {now}: {state}.")
