"""Run the missing runs of a table and print it: ``rgbt reproduce table=spatialseg/table3``.

Rerun the command to resume. hydra/launcher=submitit_slurm or ray runs it on a cluster.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from annotated_types import Interval

from rgbt.checks import InputError, split_list
from rgbt.config.common_options import RunsDir, Trust
from rgbt.config.options import Help, readable_paths
from rgbt.config.plain_command import CommandGroup, PlainCommand
from rgbt.terminal import info
from sweeps.new_table import NewOptions, new
from sweeps.settings import SweepSettings

if TYPE_CHECKING:
    from sweeps.plan.planner import Planner
    from sweeps.plan.request import RowSeed, TableRequest
    from sweeps.point import Outcome
    from sweeps.run.run_store import RunStore

HYDRA = ("hydra/launcher", "hydra.launcher.")  # beginnings of words that say where runs are trained

NEW = PlainCommand(NewOptions, new, name="rgbt reproduce new")


@dataclass(frozen=True)
class Options:
    """Options of ``rgbt reproduce``; the sweeper's file explains those of execution too."""

    table: Annotated[
        str, Help("spatialseg/table3, my/ablation (in ./tables), a file, a list, or all")
    ]
    seeds: Annotated[str, Help("a number (3: 0, 1, 2), a list (0,4,7), or until_decided")] = "1"
    max_seeds: Annotated[int, Interval(ge=4, le=1000), Help("most, with until_decided")] = 20
    scale: Annotated[str, Help("demo (minutes, embedded data), bench or paper")] = "demo"
    form: Annotated[
        Literal["paper", "released", "both"],
        Help("rows as the paper's text describes them, as their release made them, or both"),
    ] = "paper"
    rows: Annotated[str, Help("some rows only, by label, number or group: rows=Ny,3")] = ""
    dry_run: Annotated[bool, Help("true: only show runs, their states and the time")] = False
    runs_dir: RunsDir = Path("runs")
    out: Annotated[Path | None, Help("folder of the files; default: tables/ of the runs")] = None
    workers: Annotated[int | None, Help("runs at the same time; default: 1 here")] = None
    gpus: Annotated[
        tuple[int | tuple[int, ...], ...] | None,
        Help("GPU of each worker: gpus=[0,1]; or several: gpus=[[0,1],[2,3]]"),
    ] = None
    retry: Annotated[Literal["none", "failed"], Help("failed: those of earlier calls")] = "none"
    minutes: Annotated[
        float | None, Interval(gt=0, le=10**6), Help("start no run after this time")
    ] = None
    archive: Annotated[Path, Help("of several tables: where finished runs are kept, and found")] = (
        Path("results")
    )
    fresh: Annotated[bool, Help("true: retrain runs of other code, and keep the old ones")] = False
    wait: Annotated[bool, Help("false (SLURM, Ray): submit what is free, and end")] = True
    stop_jobs: Annotated[bool, Help("true: Ctrl-C stops jobs of SLURM and Ray too")] = False
    commands: Annotated[Path | None, Help("write a command for each missing run, run none")] = None
    timeout_minutes: Annotated[float | None, Help("time limit of one run")] = None
    trust: Trust = ""


def main(options: Options, overrides: list[str]) -> int:
    """Run the missing runs of a table and print our values beside the published ones.

    The table is a published one or your own. It ends with a verdict on each claim of its paper. Of
    several tables (a,b, or all) the runs that decide most claims a minute come first.
    Words with other keys are overrides of every row: dataset.root=/data/MFNet
    tracking.uri=http://host:5000. pretrained.mask2former_swin_b=FILE sets the initial weights of
    all rows with that network. weights.ROW=FILE evaluates the network of a row with a file of
    weights; predictions.ROW=FOLDER counts its predicted label images. Neither is trained. A ROW is
    a label or a number: weights.Ours=FILE, predictions.3=FOLDER.
    conf/hydra/sweeper/study.yaml explains the options of execution. Of a cluster:
    hydra/launcher=submitit_slurm hydra.launcher.partition=gpu, or hydra/launcher=ray.

    To write your own table:
    rgbt reproduce new table=my/ablation experiment=grbm masker.sigma_div=1,2,4
    """
    from rgbt.config.command import composing
    from rgbt.config.component import Component
    from rgbt.config.compose import compose
    from sweeps.plan.planner import Planner
    from sweeps.plan.request import check_override
    from sweeps.run.run_store import open_run_store

    of_hydra = [word for word in overrides if word.startswith(HYDRA)]
    others = [word for word in overrides if word not in of_hydra]
    for word in others:  # of a row they would have no effect
        if word.lstrip("+~").startswith(("hydra/", "hydra.")) and "hydra.searchpath" not in word:
            raise InputError(
                f"{word}: of Hydra's words, hydra/launcher=..., hydra.launcher.KEY=... and "
                "hydra.searchpath=... are possible here; workers=2 etc. are options."
            )
    settings = settings_of(options, of_hydra)
    for word in others:
        check_override(word)
    of_tracker = [word for word in others if word.lstrip("+~").startswith("tracking")]
    words = [word for word in others if word not in of_tracker]
    base = (*readable_paths([f"runs_dir={options.runs_dir}"]), *of_tracker)
    with composing(base):
        config = compose([*base, f"fresh={str(options.fresh).lower()}"])
        Component.from_node(config.tracking)
    runs, planner = open_run_store(config), Planner(base)
    if options.table == "all" or "," in options.table:
        return reproduce_several(options, words, settings, runs, planner)
    return reproduce_one(options, words, settings, runs, planner)


def request_of(options: Options, name: str, words: Sequence[str], planner: Planner) -> TableRequest:
    """Return the table `name` as it was requested; `words` are overrides of every row.

    InputError: an option or a word that does not fit the table, rows that would be one run, or
    seeds=until_decided of a table without claims.
    """
    from sweeps.judge.until_decided import START
    from sweeps.plan.request import (
        TableRequest,
        make_request,
        read_named,
        row_digests,
        seeds_of,
    )

    adds, both = options.seeds == "until_decided", options.form == "both"
    typed = TableRequest(
        *read_named(name),
        options.scale,
        tuple(range(START)) if adds else seeds_of(options.seeds),
        tuple(words),
        form="released" if options.form == "released" else "paper",
        until_decided=adds,
    )
    request = make_request(typed, options.rows, both=both, planner=planner)
    if request.deciding_words():
        request = replace(request, digests=row_digests(request, planner))
    if adds and not request.table.claims:
        raise InputError(
            f"seeds=until_decided: {request.name} has no claims with these rows; give a number of "
            "seeds, or add claims to the table."
        )
    return request


def reproduce_one(
    options: Options,
    words: Sequence[str],
    settings: SweepSettings,
    runs: RunStore,
    planner: Planner,
) -> int:
    """Run what one table lacks, and publish it; 1 if a cell failed or has no value."""
    from sweeps.judge.judged_table import JudgedTable
    from sweeps.judge.until_decided import SeedsUntilDecided
    from sweeps.run.point_list import PointList, commands_line, preview_points, run_points
    from sweeps.score.efficiency import network_sizes
    from sweeps.score.external import evaluate_external
    from sweeps.show.publish import print_preview, publish_table

    request = request_of(options, options.table, words, planner)
    sizes = {} if options.dry_run else network_sizes(request)
    judged = JudgedTable(request=request, sizes=sizes)
    external: dict[RowSeed, Outcome] = {}
    seeds = SeedsUntilDecided(judged, options.max_seeds, external)
    points = PointList(
        request.study,
        f"{request.name} scale={request.scale}",
        tuple(request.points()),
        runs,
        planner,
        more=seeds if request.until_decided else None,
    )
    if settings.commands is not None:
        info(commands_line(points, settings))
        return 0
    if settings.dry_run:
        print_preview(request, preview_points(points, settings), settings.workers or 1)
        return 0
    external |= evaluate_external(request, planner.base, runs.runs_dir, options.trust)
    outcomes = run_points(points, settings) if points.points else []
    if outcomes is None:
        return 0
    judged = replace(judged, runs={**request.runs(outcomes), **external})
    out = options.out or options.runs_dir / "tables" / f"{request.name}_{request.variant}"
    return publish_table(judged, outcomes, out)


def reproduce_several(
    options: Options,
    words: Sequence[str],
    settings: SweepSettings,
    runs: RunStore,
    planner: Planner,
) -> int:
    """Run what several tables lack until the time is over; 1 if a run failed.

    A table that cannot be trained with these options is left out with a line.
    """
    from sweeps.plan.table import study_names, table_names
    from sweeps.queue import check_trainable, run_queue

    every = [*table_names(Path("none")), *study_names()]
    names = every if options.table == "all" else split_list(options.table, "tables")
    requests = []
    for name in names:
        try:
            request = request_of(options, name, words, planner)
            check_trainable(request, planner)
        except InputError as error:
            info(f"{name} is left out: {error}")
        else:
            requests.append(request)
    if not requests:
        raise InputError(f"table={options.table}: none of them can be trained.")
    runs.archive = options.archive
    return run_queue(requests, settings, runs, planner, options.max_seeds)


def settings_of(options: Options, of_hydra: Sequence[str] = ()) -> SweepSettings:
    """Return the settings of execution; others are those of ``conf/hydra/sweeper/study.yaml``.

    `of_hydra` are words such as hydra/launcher=ray.
    """
    from rgbt.config.command import composing
    from rgbt.config.compose import compose_hydra
    from sweeps.settings import read_settings

    words = (*of_hydra, *readable_paths([f"runs_dir={options.runs_dir}"]), "hydra.job.name=rgbt")
    with composing(words):
        node = compose_hydra(["hydra/sweeper=study", *words])
    node.sweeper.hours = options.minutes and options.minutes / 60
    for key, value in vars(options).items():
        if key in node.sweeper:
            node.sweeper[key] = str(value) if isinstance(value, Path) else value
    try:
        with composing(words):
            return read_settings(node)
    except InputError as error:
        raise InputError(str(error).replace("hydra.sweeper.", "")) from error


entry = CommandGroup(__doc__, {"new": NEW}, default=PlainCommand(Options, main))

if __name__ == "__main__":
    entry()
