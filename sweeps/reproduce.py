"""Run the missing runs of a table and print it: ``rgbt reproduce table=spatialseg/table3``.

Rerun the command to resume. hydra/launcher=submitit_slurm or ray runs it on a cluster.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from annotated_types import Interval

from rgbt.checks import InputError
from rgbt.config.common_options import RunsDir, Trust
from rgbt.config.options import Help, readable_paths
from rgbt.config.plain_command import CommandGroup, PlainCommand
from rgbt.terminal import info
from sweeps.new_table import NewOptions, new
from sweeps.settings import SweepSettings

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
    from sweeps.queue import run_queue
    from sweeps.rendering.publish import print_preview, publish_table
    from sweeps.run.point_list import commands_line, preview_points, run_points
    from sweeps.table_plan import plan_table, stored_and_planner
    from sweeps.verdicts.judge import rule_of

    of_hydra = [word for word in overrides if word.startswith(HYDRA)]
    overrides = [word for word in overrides if word not in of_hydra]
    for word in overrides:  # of a row they would have no effect
        if word.lstrip("+~").startswith(("hydra/", "hydra.")) and "hydra.searchpath" not in word:
            raise InputError(
                f"{word}: of Hydra's words, hydra/launcher=..., hydra.launcher.KEY=... and "
                "hydra.searchpath=... are possible here; workers=2 etc. are options."
            )
    settings = settings_of(options, of_hydra)
    runs, planner = stored_and_planner(options, overrides)
    if options.table == "all" or "," in options.table:
        return run_queue(options, overrides, settings, runs, planner)
    plan = plan_table(options, overrides, runs, planner)
    if settings.commands is not None:
        info(commands_line(plan.points, settings))
        return 0
    if settings.dry_run:
        outcomes = preview_points(plan.points, settings)
        print_preview(plan, outcomes, settings.workers or 1)
        return 0
    plan.evaluate_external(options.trust)
    found = run_points(plan.points, settings) if plan.points.points else []
    if found is None:
        return 0
    if plan.until_decided is None:  # an earlier command may have added seeds
        plan.judge.rule = rule_of(result for each in found for result in each.results)
    name = f"{plan.request.name}_{plan.request.variant}"
    out = options.out or options.runs_dir / "tables" / name
    return publish_table(plan, found, out)


def settings_of(options: Options, of_hydra: Sequence[str] = ()) -> SweepSettings:
    """The settings of execution; the others of a sweep as in ``conf/hydra/sweeper/study.yaml``.

    `of_hydra` are words such as hydra/launcher=ray.
    """
    from rgbt.config.compose import compose_hydra
    from rgbt.config.overrides import composing
    from sweeps.run.executors import check_launcher
    from sweeps.settings import read_launcher, read_settings

    words = (*of_hydra, *readable_paths([f"runs_dir={options.runs_dir}"]), "hydra.job.name=rgbt")
    with composing(words):
        node = compose_hydra(["hydra/sweeper=study", *words])
        launcher = read_launcher(node)
    check_launcher(launcher)
    node.sweeper.hours = options.minutes and options.minutes / 60
    for key, value in vars(options).items():
        if key in node.sweeper:
            node.sweeper[key] = str(value) if isinstance(value, Path) else value
    try:
        return read_settings(node.sweeper, launcher)
    except InputError as error:
        raise InputError(str(error).replace("hydra.sweeper.", "")) from error


entry = CommandGroup(__doc__, {"new": NEW}, default=PlainCommand(Options, main))

if __name__ == "__main__":
    entry()
