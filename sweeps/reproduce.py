"""Run the missing runs of a table and print it: ``rgbt reproduce table=spatialseg/table3``.

Rerun the command to resume. Any number of machines may run it at the same time.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from rgbt.checks import InputError, check_choice, nearest
from rgbt.config.command import composing
from rgbt.config.common_options import RunsDir
from rgbt.config.component import Component
from rgbt.config.options import Help, readable_paths
from rgbt.config.plain_command import CommandGroup, PlainCommand
from rgbt.metrics.names import MIOU
from sweeps.settings import SweepSettings
from sweeps.table.new_table import NewOptions, new
from sweeps.table.request import TableRequest, seeds_of

if TYPE_CHECKING:
    from sweeps.worker.trial_sources import Outcome

ALL = "all"
NEW = PlainCommand(NewOptions, new, name="rgbt reproduce new")
WEIGHTS = "weights."
"""weights.mask2former_swin_b=FILE: for the rows that name this network."""


@dataclass(frozen=True)
class Options:
    """Options of ``rgbt reproduce``; the sweeper's file explains those of execution too."""

    table: Annotated[
        str,
        Help(
            "table to run: spatialseg/table3, my/ablation (in ./tables) or a file; all: every "
            "table, with dry_run=true"
        ),
    ]
    seeds: Annotated[str, Help("number of seeds (3: seeds 0, 1, 2), or a list: 0,4,7")] = "1"
    scale: Annotated[str, Help("demo (minutes, embedded data) or paper (published sizes)")] = "demo"
    dry_run: Annotated[
        bool, Help("true: show the runs of the cells, their states and the time left; run nothing")
    ] = False
    runs_dir: RunsDir = Path("runs")
    out: Annotated[
        Path | None,
        Help(
            "output folder of table.md, .csv, .tex and figure.png; default: tables/ in the folder "
            "of runs"
        ),
    ] = None
    workers: Annotated[int, Help("number of runs at the same time")] = 1
    gpus: Annotated[
        tuple[int, ...] | None, Help("GPUs to use: gpus=[0,1] assigns one GPU to each worker")
    ] = None
    retry: Annotated[
        Literal["none", "failed"],
        Help("failed: retry runs that failed in a previous call; none: do not"),
    ] = "none"
    retries: Annotated[int, Help("how often a failed run is retried in this call")] = 0
    fresh: Annotated[
        bool,
        Help(
            "true: retrain runs that another version of the code made; the old runs move to "
            "<runs_dir>/replaced"
        ),
    ] = False
    wait: Annotated[
        bool,
        Help("true: wait for cells that other commands run; false: do not wait"),
    ] = True
    storage: Annotated[
        str | None,
        Help("Optuna storage that all machines share: file.journal or postgresql://user@host/name"),
    ] = None
    timeout_minutes: Annotated[float | None, Help("time limit of one run")] = None
    max_failures: Annotated[
        int | None, Help("start no more runs after this number of failures")
    ] = None
    executor: Annotated[
        Literal["local", "submitit"],
        Help("local: processes on this machine; submitit: jobs of a cluster"),
    ] = "local"
    submitit: Annotated[
        dict[str, Any] | None, Help("options of the cluster jobs: submitit={timeout_min: 60}")
    ] = field(default_factory=dict)


OF_THE_TABLE = ("table", "seeds", "scale", "runs_dir", "out", "fresh")
"""Options that are no settings of execution."""


def main(options: Options, overrides: list[str]) -> int:
    """Run the missing runs of a table and print our values beside the published ones.

    The table is a published one or your own. Words with other keys are overrides of every row:
    dataset.root=/data/MFNet tracking.uri=http://host:5000. weights.mask2former_swin_b=FILE sets the
    initial weights of all rows with that network. conf/hydra/sweeper/study.yaml explains the
    options of execution.

    To write your own table:
    rgbt reproduce new table=my/ablation experiment=grbm masker.sigma_div=1,2,4
    """
    from rgbt.config.compose import compose
    from sweeps.rendering.publish import publish_table
    from sweeps.table.load_table import table_names
    from sweeps.worker.planner import Planner
    from sweeps.worker.point_list import PointList, preview_points, run_points
    from sweeps.worker.run_store import open_run_store

    settings = settings_of(options)
    for word in overrides:
        _check_override(word)
    tracker = [word for word in overrides if word.lstrip("+~").startswith("tracking")]
    extra = tuple(word for word in overrides if word not in tracker)
    if options.table == ALL and not settings.dry_run:
        raise InputError("table=all requires dry_run=true; run one table at a time.")
    tables = table_names() if options.table == ALL else [options.table]
    requests = [request_of(name, options, extra) for name in tables]
    base = (*readable_paths([f"runs_dir={options.runs_dir}"]), *tracker)
    with composing(base):
        config = compose([*base, f"fresh={str(options.fresh).lower()}"])
        Component.from_node(config.tracking)
    runs = open_run_store(config)
    lists = [
        PointList(
            study=f"table/{wanted.name}",
            title=f"{wanted.name} scale={wanted.scale}",
            kind="list",
            points=tuple(wanted.points()),
            runs=runs,
            base=base,
        )
        for wanted in requests
    ]
    if settings.dry_run:
        planner = Planner(base)
        previews = [preview_points(points, settings, planner) for points in lists]
        _show(options.table, list(zip(requests, previews, strict=True)), settings.workers)
        return 0
    (wanted,), (points,) = requests, lists
    outcomes = run_points(points, settings) if points.points else []
    out = options.out or options.runs_dir / "tables" / f"{wanted.name}_{wanted.variant}"
    return publish_table(wanted, outcomes, out, runs.tracking)


def _show(
    table: str, previews: Sequence[tuple[TableRequest, Sequence[Outcome]]], workers: int
) -> None:
    """Print the preview of one table, or one line for each of all."""
    from rich.text import Text

    from rgbt.tracking.terminal import print_rich, rich_table
    from sweeps.rendering.preview import cells_grid, summary, tables_grid

    if table == ALL:
        print_rich(rich_table(tables_grid(previews, workers)))
        return
    ((wanted, outcomes),) = previews
    if outcomes:
        print_rich(rich_table(cells_grid(wanted, outcomes)))
    print_rich(Text("\n".join(summary(wanted, outcomes, workers))))


def settings_of(options: Options) -> SweepSettings:
    """The settings of execution; the others of a sweep as in ``conf/hydra/sweeper/study.yaml``.

    Raises:
        InputError: a value out of its range.
    """
    from omegaconf import DictConfig, OmegaConf

    from rgbt.config.compose import conf_dir
    from sweeps.settings import read_settings

    node = OmegaConf.load(conf_dir() / "hydra" / "sweeper" / "study.yaml")
    assert isinstance(node, DictConfig), "the file is a mapping"
    # What Optuna's own pages show of a table; nothing is chosen by it.
    node.objectives = [{"metric": f"test/{MIOU}", "direction": "maximize"}]
    for key, value in vars(options).items():
        if key not in OF_THE_TABLE:
            node[key] = value
    try:
        return read_settings(node)
    except InputError as error:
        raise InputError(str(error).replace("hydra.sweeper.", "")) from error


def _check_override(word: str) -> None:
    """Refuse an override that belongs to the rows of the table."""
    key = word.lstrip("+~").partition("=")[0]
    if key in ("seed", "experiment"):
        other = "seeds=3" if key == "seed" else "another table"
        raise InputError(f"'{word}' is set by the rows of the table; choose {other}.")
    if key.rpartition("@")[2].partition(".")[0] == "consistency":
        raise InputError(
            f"'{word}': the columns of the table define what is counted, on the published sets "
            "of views; measure others with rgbt consistency run=..."
        )
    if key == "metric" or key.startswith("metric."):
        raise InputError(
            f"'{word}': the columns of the table define what is counted; set `regions` in your "
            "own table."
        )


def request_of(name: str, options: Options, extra: tuple[str, ...]) -> TableRequest:
    """The table called `name` at the scale and with the seeds that were given.

    Raises:
        InputError: no such table, scale or metric; no seeds.
    """
    from rgbt.config.compose import available
    from sweeps.table.load_table import load_table
    from sweeps.table.scoring import check_metrics
    from sweeps.worker.storage import NAME

    check_choice("scale", options.scale, available("scale"))
    table = load_table(name)
    if name.endswith((".yaml", ".yml")):
        name = f"{table.paper}/{Path(name).stem}"
    check_metrics(table)
    if not re.fullmatch(NAME, name):
        raise InputError(
            f"table={name}: MLflow allows only letters, digits, spaces and _ - . : / alone; "
            "rename the file."
        )
    seeds = seeds_of(options.seeds)
    files = [word.removeprefix(WEIGHTS) for word in extra if word.startswith(WEIGHTS)]
    weights = {word.partition("=")[0]: word.partition("=")[2] for word in files}
    others = tuple(word for word in extra if not word.startswith(WEIGHTS))
    wanted = TableRequest(name, table, options.scale, seeds, others, weights)
    for model in weights:
        if model not in wanted.models():
            raise InputError(
                f"{WEIGHTS}{model}: no row of {name} uses that network at "
                f"scale={wanted.scale}; {nearest(model, wanted.models())}."
            )
    return wanted


entry = CommandGroup(__doc__, {"new": NEW}, default=PlainCommand(Options, main))

if __name__ == "__main__":
    entry()
