"""Run what is missing of a table, print it: ``python -m sweeps.reproduce table=spatialseg/table3``.

The same command goes on where it was stopped; any number of machines may give it at once.
"""

from __future__ import annotations

import sys

from rgbt.checks import InputError
from rgbt.config.command import plain_command
from sweeps.asked import Arguments, Place, place_of, point_list, runs_of, settings_of, wanted_of
from sweeps.settings import SweepSettings
from sweeps.table.request import TableRequest

OWN = {
    "table": None,
    "seeds": "1",
    "scale": "demo",
    "runs_dir": "runs",
    "out": "",
    "fresh": "false",
    "workers": "1",
    "retry": "none",
    "retries": "0",
    "dry_run": "false",
    "wait": "true",
    "storage": "null",
    "gpus": "null",
    "timeout_minutes": "null",
    "max_failures": "null",
    "executor": "local",
    "submitit": "{}",
}
ALL = "all"


def main(arguments: dict[str, str], overrides: list[str]) -> int:
    """Run what is missing of a published table, or of your own, and print it beside the paper.

    table     spatialseg/table3, my/ablation (in ./tables), a file; all with dry_run=true
    seeds     how many (3 for the seeds 0, 1, 2), or which: 0,4,7
    scale     demo (minutes, embedded data) or paper (as published)
    dry_run   true: show the cells, what is there already and how long the rest takes
    retry     failed: try again what failed in an earlier call; retries: how often in this one
    workers   runs at a time; gpus=[0,1] gives each worker one
    storage   where machines agree on who runs what: file.journal, postgresql://user@host/name
    fresh     true: train again what other code made; the old runs are kept in <runs_dir>/replaced
    wait      false: leave cells to the commands that run them, do not stay until they are done
    timeout_minutes, max_failures, executor, submitit as in conf/hydra/sweeper/study.yaml
    out       folder of table.md, .csv, .tex and figure.png; default: tables/ in the folder of runs
    overrides of every row: dataset.root=/data/MFNet tracking.uri=http://host:5000
    weights.mask2former_swin_b=FILE: weights of the rows with that network, one for each of them

    A table of your own:
    python -m sweeps.reproduce new table=my/ablation experiment=grbm masker.sigma_div=1,2,4
    """
    settings = settings_of(arguments)
    place, extra = place_of(arguments, overrides)
    if arguments["table"] == ALL:
        return _preview_all(arguments, extra, place, settings)
    wanted = wanted_of(arguments["table"], arguments, extra)
    if settings.dry_run:
        return _preview(wanted, place, settings)
    return _reproduce(wanted, place, settings)


def _preview(wanted: TableRequest, place: Place, settings: SweepSettings) -> int:
    from rich.text import Text

    from rgbt.tracking.terminal import rich_table, show
    from sweeps.rendering.preview import cells_grid, summary
    from sweeps.worker.point_list import preview_points

    outcomes = preview_points(point_list(wanted, place, runs_of(place)), settings)
    if outcomes:
        show(rich_table(cells_grid(wanted, outcomes)))
    show(Text("\n".join(summary(wanted, outcomes, settings.workers))))
    return 0


def _preview_all(
    arguments: Arguments, extra: tuple[str, ...], place: Place, settings: SweepSettings
) -> int:
    from rgbt.tracking.terminal import rich_table, show
    from sweeps.rendering.preview import tables_grid
    from sweeps.table.load_table import table_names
    from sweeps.worker.point_list import preview_points

    if not settings.dry_run:
        raise InputError("table=all is for dry_run=true; run one table at a time.")
    every = [wanted_of(name, arguments, extra) for name in table_names()]
    runs = runs_of(place)
    surveyed = [
        (wanted, preview_points(point_list(wanted, place, runs), settings)) for wanted in every
    ]
    show(rich_table(tables_grid(surveyed, settings.workers)))
    return 0


def _reproduce(wanted: TableRequest, place: Place, settings: SweepSettings) -> int:
    from sweeps.rendering.publish import publish_table
    from sweeps.worker.point_list import run_points

    runs = runs_of(place)
    points = point_list(wanted, place, runs)
    outcomes = run_points(points, settings) if points.points else []
    return publish_table(wanted, outcomes, place.folder(wanted), runs.tracking)


def entry() -> None:
    """The command; its first word may be ``new``."""
    if sys.argv[1:2] == ["new"]:
        from sweeps.table.new_table import OWN as OF_NEW
        from sweeps.table.new_table import new

        del sys.argv[1]
        plain_command(OF_NEW, new)()
    plain_command(OWN, main)()


if __name__ == "__main__":
    entry()
