"""Run what is missing of a table, print it: ``rgbt reproduce table=spatialseg/table3``.

The same command goes on where it was stopped; any number of machines may give it at once.
"""

from __future__ import annotations

from rgbt.checks import InputError
from rgbt.config.plain_command import CommandGroup, PlainCommand
from sweeps.options import (
    Options,
    Workspace,
    point_list,
    request_of,
    runs_of,
    settings_of,
    workspace_of,
)
from sweeps.settings import SweepSettings
from sweeps.table.new_table import NewOptions, new
from sweeps.table.request import TableRequest

ALL = "all"
NEW = PlainCommand(NewOptions, new, name="rgbt reproduce new")


def main(options: Options, overrides: list[str]) -> int:
    """Run what is missing of a published table, or of your own, and print it beside the paper.

    Overrides of every row: dataset.root=/data/MFNet tracking.uri=http://host:5000; with
    weights.mask2former_swin_b=FILE: weights of the rows with that network, one for each of them.
    The options of execution are explained in conf/hydra/sweeper/study.yaml.

    A table of your own:
    rgbt reproduce new table=my/ablation experiment=grbm masker.sigma_div=1,2,4
    """
    settings = settings_of(options)
    workspace, extra = workspace_of(options, overrides)
    if options.table == ALL:
        return _preview_all(options, extra, workspace, settings)
    wanted = request_of(options.table, options, extra)
    if settings.dry_run:
        return _preview(wanted, workspace, settings)
    return _reproduce(wanted, workspace, settings)


def _preview(wanted: TableRequest, workspace: Workspace, settings: SweepSettings) -> int:
    from rich.text import Text

    from rgbt.tracking.terminal import print_rich, rich_table
    from sweeps.rendering.preview import cells_grid, summary
    from sweeps.worker.point_list import preview_points

    outcomes = preview_points(point_list(wanted, workspace, runs_of(workspace)), settings)
    if outcomes:
        print_rich(rich_table(cells_grid(wanted, outcomes)))
    print_rich(Text("\n".join(summary(wanted, outcomes, settings.workers))))
    return 0


def _preview_all(
    options: Options, extra: tuple[str, ...], workspace: Workspace, settings: SweepSettings
) -> int:
    from rgbt.tracking.terminal import print_rich, rich_table
    from sweeps.rendering.preview import tables_grid
    from sweeps.table.load_table import table_names
    from sweeps.worker.point_list import preview_points

    if not settings.dry_run:
        raise InputError("table=all is for dry_run=true; run one table at a time.")
    every = [request_of(name, options, extra) for name in table_names()]
    runs = runs_of(workspace)
    surveyed = [
        (wanted, preview_points(point_list(wanted, workspace, runs), settings)) for wanted in every
    ]
    print_rich(rich_table(tables_grid(surveyed, settings.workers)))
    return 0


def _reproduce(wanted: TableRequest, workspace: Workspace, settings: SweepSettings) -> int:
    from sweeps.rendering.publish import publish_table
    from sweeps.worker.point_list import run_points

    runs = runs_of(workspace)
    points = point_list(wanted, workspace, runs)
    outcomes = run_points(points, settings) if points.points else []
    return publish_table(wanted, outcomes, workspace.folder(wanted), runs.tracking)


entry = CommandGroup(__doc__, {"new": NEW}, default=PlainCommand(Options, main))

if __name__ == "__main__":
    entry()
