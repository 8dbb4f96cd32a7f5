"""Options of ``rgbt reproduce``, and the table, paths and settings that they stand for."""

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
from rgbt.metrics.names import MIOU

if TYPE_CHECKING:
    from sweeps.settings import SweepSettings
    from sweeps.table.request import TableRequest
    from sweeps.worker.point_list import PointList
    from sweeps.worker.run_store import RunStore

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


@dataclass(frozen=True)
class Workspace:
    """Where a table's runs and files lie.

    Attributes:
        runs_dir: the folder of runs.
        out: folder of the table's files; None: ``tables/<table>_<scale>`` inside `runs_dir`.
        tracker: overrides of the tracker.
        fresh: see `RunStore`.
    """

    runs_dir: Path
    out: Path | None
    tracker: tuple[str, ...] = ()
    fresh: bool = False

    @property
    def base(self) -> tuple[str, ...]:
        """Overrides that every run has, whatever row it belongs to."""
        return (*readable_paths([f"runs_dir={self.runs_dir}"]), *self.tracker)

    def folder(self, wanted: TableRequest) -> Path:
        """Where the files go."""
        return self.out or self.runs_dir / "tables" / f"{wanted.name}_{wanted.variant}"


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


def workspace_of(options: Options, overrides: Sequence[str]) -> tuple[Workspace, tuple[str, ...]]:
    """Where everything lies, and the overrides of the rows.

    Raises:
        InputError: an override that belongs to the rows of the table.
    """
    for word in overrides:
        _check_override(word)
    tracker = tuple(word for word in overrides if word.lstrip("+~").startswith("tracking"))
    rest = tuple(word for word in overrides if word not in tracker)
    return Workspace(options.runs_dir, options.out, tracker, options.fresh), rest


def _check_override(word: str) -> None:
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
    from sweeps.table.request import TableRequest, seeds_of
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
    weights = dict(_weights(word) for word in extra if word.startswith(WEIGHTS))
    others = tuple(word for word in extra if not word.startswith(WEIGHTS))
    wanted = TableRequest(name, table, options.scale, seeds, others, weights)
    for model in weights:
        if model not in wanted.models():
            raise InputError(
                f"{WEIGHTS}{model}: no row of {name} names that network at "
                f"scale={wanted.scale}; {nearest(model, wanted.models())}."
            )
    return wanted


def _weights(word: str) -> tuple[str, str]:
    model, _, file = word.removeprefix(WEIGHTS).partition("=")
    return model, file


def runs_of(workspace: Workspace) -> RunStore:
    """Where finished runs are found, as the overrides of the tracker say."""
    from rgbt.config.compose import compose
    from sweeps.run_specs import open_run_store

    with composing(workspace.base):
        config = compose([*workspace.base, f"fresh={str(workspace.fresh).lower()}"])
        Component.from_node(config.tracking)
    return open_run_store(config)


def point_list(wanted: TableRequest, workspace: Workspace, runs: RunStore) -> PointList:
    """The runs of a table, as the driver takes them."""
    from sweeps.worker.point_list import PointList

    return PointList(
        study=f"table/{wanted.name}",
        title=f"{wanted.name} scale={wanted.scale}",
        kind="list",
        points=tuple(wanted.points()),
        runs=runs,
        base=workspace.base,
    )
