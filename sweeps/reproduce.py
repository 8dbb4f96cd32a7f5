"""Run the missing runs of a table and print it: ``rgbt reproduce table=spatialseg/table3``.

Rerun the command to resume. hydra/launcher=submitit_slurm or ray runs it on a cluster.
"""

from __future__ import annotations

import gc
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
    from sweeps.plan.request import TableRequest
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
    seeds: Annotated[
        str,
        Help(
            "a number (3: 0, 1, 2), a list (0,4,7), confirm (those that the table declares), or "
            "until_decided"
        ),
    ] = "1"
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
    from rgbt.config.component import Component
    from rgbt.config.compose import compose
    from rgbt.config.overrides import composing
    from sweeps.plan.planner import Planner
    from sweeps.plan.request import check_overrides
    from sweeps.run.run_store import open_run_store

    # Composed configurations live: to look for circles among them took a tenth of a plan.
    gc.set_threshold(100_000)
    of_hydra = [word for word in overrides if word.startswith(HYDRA)]
    others = [word for word in overrides if word not in of_hydra]
    for word in others:  # of a row they would have no effect
        if word.lstrip("+~").startswith(("hydra/", "hydra.")) and "hydra.searchpath" not in word:
            raise InputError(
                f"{word}: of Hydra's words, hydra/launcher=..., hydra.launcher.KEY=... and "
                "hydra.searchpath=... are possible here; workers=2 etc. are options."
            )
    settings = settings_of(options, of_hydra)
    check_overrides(others)
    of_tracker = [word for word in others if word.lstrip("+~").startswith("tracking")]
    words = [word for word in others if word not in of_tracker]
    base = (*readable_paths([f"runs_dir={options.runs_dir}"]), *of_tracker)
    with composing(base):
        config = compose([*base, f"fresh={str(options.fresh).lower()}"])
        Component.from_node(config.tracking)
    return run_tables(options, words, settings, open_run_store(config), Planner(base))


def run_tables(
    options: Options,
    words: Sequence[str],
    settings: SweepSettings,
    runs: RunStore,
    planner: Planner,
) -> int:
    """Run what the requested tables lack, and publish a single one; `words` are of every row.

    Returns:
        1 if a run failed, or a cell of a single table has no value; else 0.
    """
    from sweeps.judge.judged_table import JudgedTable
    from sweeps.judge.until_decided import SeedsUntilDecided
    from sweeps.queue import Queue
    from sweeps.run.point_list import commands_line, preview_points, run_points
    from sweeps.score.efficiency import network_sizes
    from sweeps.score.external import evaluate_external
    from sweeps.show.preview import print_preview
    from sweeps.show.publish import publish_table

    tables = []
    for request in requested_tables(options, words, planner):
        external = {}
        if settings.commands is None and not settings.dry_run:
            external = evaluate_external(request, planner.base, runs.runs_dir, options.trust)
        tables.append(SeedsUntilDecided(JudgedTable(request=request), options.max_seeds, external))
    if is_several(options):
        runs.archive = options.archive
    queue = Queue(tables, runs, planner, is_dry=settings.dry_run)
    workers = settings.workers or 1
    points = queue.point_list(workers, is_ranked=is_several(options))
    if settings.commands is not None:
        info(commands_line(points, settings))
        return 0
    outcomes: list[Outcome] | None = []
    if settings.dry_run:
        outcomes = preview_points(points, settings)
    elif points.points:
        outcomes = run_points(points, settings)
    if outcomes is None:
        return 0
    if is_several(options):
        return queue.report(outcomes, workers)
    (table,) = tables
    request = table.judged.request
    if settings.dry_run:
        print_preview(request, outcomes, planner, workers, runs.runs_dir)
        return 0
    judged = replace(
        table.judged,
        runs={**request.runs(outcomes), **table.external},
        sizes=network_sizes(request),
    )
    out = options.out or options.runs_dir / "tables" / f"{request.name}_{request.variant}"
    return publish_table(judged, outcomes, out)


def is_several(options: Options) -> bool:
    """Return whether several tables were requested, whose runs are ordered and archived."""
    return options.table == "all" or "," in options.table


def requested_tables(
    options: Options, words: Sequence[str], planner: Planner
) -> list[TableRequest]:
    """Return the tables; of several, one that cannot be trained is left out with a line.

    InputError: an option or a word does not fit the table, or none of several can be trained.
    """
    from sweeps.plan.table import PUBLISHED, STUDIES, table_names

    if not is_several(options):
        return [_request(options, options.table, words, planner)]
    is_all = options.table == "all"
    names = table_names(PUBLISHED, STUDIES) if is_all else split_list(options.table, "tables")
    requests = []
    for name in names:
        try:
            request = _request(options, name, words, planner)
            _check_trainable(request, planner, is_dry=options.dry_run)
        except InputError as error:
            info(f"{name} is left out: {error}")
        else:
            requests.append(request)
    if not requests:
        raise InputError(f"table={options.table}: none of them can be trained.")
    return requests


def _request(options: Options, name: str, words: Sequence[str], planner: Planner) -> TableRequest:
    from sweeps.judge.until_decided import START
    from sweeps.plan.request import make_request, row_digests, seeds_of

    request = make_request(
        name, options.scale, words, form=options.form, rows=options.rows, planner=planner
    )
    is_adding = options.seeds == "until_decided"
    if options.seeds == "confirm":
        seeds = request.table.confirm
        if not seeds:
            raise InputError(
                f"seeds=confirm: {request.name} declares none; add a line such as "
                "confirm: [10, 11, 12, 13] to the table before they are run."
            )
    else:
        seeds = tuple(range(START)) if is_adding else seeds_of(options.seeds)
    if is_adding and not request.table.claims:
        raise InputError(
            f"seeds=until_decided: {request.name} has no claims with these rows; give a number of "
            "seeds, or add claims to the table."
        )
    digests = row_digests(request, planner)
    return replace(request, seeds=seeds, until_decided=is_adding, digests=digests)


def _check_trainable(request: TableRequest, planner: Planner, *, is_dry: bool) -> None:
    """Refuse a table of which no row can be trained, with the reason of the first row.

    If it `is_dry`, a table whose rows lack something is shown with that.
    """
    reason = InputError("none of its rows is trained.")
    for point in reversed(request.points()):
        try:
            planner.plan(point)
        except InputError as error:
            reason = error
            if is_dry and planner.lacking(point):
                return
        else:
            return
    raise reason


def settings_of(options: Options, of_hydra: Sequence[str] = ()) -> SweepSettings:
    """Return the settings of execution; others are those of ``conf/hydra/sweeper/study.yaml``.

    `of_hydra` are words such as hydra/launcher=ray.
    """
    from rgbt.config.compose import compose_hydra
    from rgbt.config.overrides import composing
    from sweeps.settings import read_settings

    words = (*of_hydra, *readable_paths([f"runs_dir={options.runs_dir}"]), "hydra.job.name=rgbt")
    given = {}
    for key, value in vars(options).items():
        given[key] = str(value) if isinstance(value, Path) else value
    try:
        with composing(words):
            node = compose_hydra(["hydra/sweeper=study", *words])
            node.sweeper.hours = options.minutes and options.minutes / 60
            for key in given.keys() & node.sweeper.keys():
                node.sweeper[key] = given[key]
            return read_settings(node)
    except InputError as error:
        raise InputError(str(error).replace("hydra.sweeper.", "")) from error


entry = CommandGroup(__doc__, {"new": NEW}, default=PlainCommand(Options, main))

if __name__ == "__main__":
    entry()
