"""Run what is missing of a table, print it: ``rgbt reproduce table=spatialseg/table3``.

The same command goes on where it was stopped; any number of machines may give it at once.
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
    """Of ``rgbt reproduce``; those of execution are explained in the sweeper's file too."""

    table: Annotated[
        str,
        Help("spatialseg/table3, my/ablation (in ./tables), a file; all with dry_run=true"),
    ]
    seeds: Annotated[str, Help("how many (3 for the seeds 0, 1, 2), or which: 0,4,7")] = "1"
    scale: Annotated[str, Help("demo (minutes, embedded data) or paper (as published)")] = "demo"
    dry_run: Annotated[
        bool, Help("true: show the cells, which of them are finished, and how long the rest takes")
    ] = False
    runs_dir: RunsDir = Path("runs")
    out: Annotated[
        Path | None,
        Help(
            "folder of table.md, .csv, .tex and figure.png; default: tables/ in the folder of runs"
        ),
    ] = None
    workers: Annotated[int, Help("runs at a time")] = 1
    gpus: Annotated[tuple[int, ...] | None, Help("gpus=[0,1] gives each worker one of them")] = None
    retry: Annotated[
        Literal["none", "failed"], Help("failed: try again what failed in a previous call")
    ] = "none"
    retries: Annotated[int, Help("how often a run is tried again in this call")] = 0
    fresh: Annotated[
        bool,
        Help(
            "true: train again what other code made; the old runs are kept in <runs_dir>/replaced"
        ),
    ] = False
    wait: Annotated[
        bool,
        Help("false: leave cells to the commands that run them instead of waiting for them"),
    ] = True
    storage: Annotated[
        str | None,
        Help("where machines agree on who runs what: file.journal, postgresql://user@host/name"),
    ] = None
    timeout_minutes: Annotated[float | None, Help("of one run")] = None
    max_failures: Annotated[int | None, Help("failed runs after which no other is started")] = None
    executor: Annotated[
        Literal["local", "submitit"], Help("processes of this machine, or jobs of a cluster")
    ] = "local"
    submitit: Annotated[
        dict[str, Any] | None, Help("options of its jobs: submitit={timeout_min: 60}")
    ] = field(default_factory=dict)


OF_THE_TABLE = ("table", "seeds", "scale", "runs_dir", "out", "fresh")
"""Options that are no settings of execution."""


def main(options: Options, overrides: list[str]) -> int:
    """Run what is missing of a published table, or of your own, and print it beside the paper.

    Overrides of every row: dataset.root=/data/MFNet tracking.uri=http://host:5000; with
    weights.mask2former_swin_b=FILE: weights of the rows with that network, one for each of them.
    The options of execution are explained in conf/hydra/sweeper/study.yaml.

    A table of your own:
    rgbt reproduce new table=my/ablation experiment=grbm masker.sigma_div=1,2,4
    """
    from rgbt.config.compose import compose
    from sweeps.rendering.publish import publish_table
    from sweeps.table.load_table import table_names
    from sweeps.worker.point_list import PointList, preview_points, run_points
    from sweeps.worker.run_store import open_run_store

    settings = settings_of(options)
    for word in overrides:
        _check_override(word)
    tracker = [word for word in overrides if word.lstrip("+~").startswith("tracking")]
    extra = tuple(word for word in overrides if word not in tracker)
    if options.table == ALL and not settings.dry_run:
        raise InputError("table=all is for dry_run=true; run one table at a time.")
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
        previews = [preview_points(points, settings) for points in lists]
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
        raise InputError(f"'{word}' belongs to the rows of the table; choose {other}.")
    if key.rpartition("@")[2].partition(".")[0] == "consistency":
        raise InputError(
            f"'{word}': the columns of the table say what is counted, on the published sets of "
            "views; measure others with rgbt consistency run=..."
        )
    if key == "metric" or key.startswith("metric."):
        raise InputError(
            f"'{word}': the columns of the table say what is counted; set its `regions` in a "
            "table of your own."
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
            f"table={name}: MLflow takes names of letters, digits, spaces and _ - . : / alone; "
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
                f"{WEIGHTS}{model}: no row of {name} names that network at "
                f"scale={wanted.scale}; {nearest(model, wanted.models())}."
            )
    return wanted


entry = CommandGroup(__doc__, {"new": NEW}, default=PlainCommand(Options, main))

if __name__ == "__main__":
    entry()
