"""Run what is missing of a table, print it: ``python -m sweeps.reproduce table=spatialseg/table3``.

The same command goes on where it was stopped; any number of machines may give it at once.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rgbt.checks import InputError, check_choice, nearest
from rgbt.command import composing, plain_command, readable_paths
from rgbt.config import check_node

if TYPE_CHECKING:
    from sweeps.cell_points import Wanted
    from sweeps.found import Runs
    from sweeps.lists import PointList
    from sweeps.settings import Settings

OWN = {
    "table": None,
    "seeds": "1",
    "scale": "demo",
    "runs_dir": "runs",
    "out": "",
    "workers": "1",
    "retry": "none",
    "retries": "0",
    "dry_run": "false",
    "wait": "false",
    "storage": "null",
    "gpus": "null",
    "threads": "null",
    "timeout_minutes": "null",
    "max_failures": "null",
    "executor": "local",
    "submitit": "{}",
}
OF_THE_TABLE = ("table", "seeds", "scale", "runs_dir", "out")
WORDS = ("storage", "retry", "executor")
"""Settings that are text."""

ALL = "all"


@dataclass(frozen=True)
class Place:
    """Where a table's runs and files lie.

    Attributes:
        runs_dir: the folder of runs.
        out: folder of the table's files; None: ``tables/<table>_<scale>`` inside `runs_dir`.
        tracker: overrides of the tracker.
    """

    runs_dir: Path
    out: Path | None
    tracker: tuple[str, ...] = ()

    @property
    def base(self) -> tuple[str, ...]:
        """Overrides that every run has, whatever row it belongs to."""
        return (*readable_paths([f"runs_dir={self.runs_dir}"]), *self.tracker)

    def folder(self, wanted: Wanted) -> Path:
        """Where the files go."""
        name = wanted.name.removesuffix(".yaml")
        shown = Path(name).stem if Path(name).is_absolute() else name
        return self.out or self.runs_dir / "tables" / f"{shown}_{wanted.scale}"


def main(arguments: dict[str, str], overrides: list[str]) -> int:
    """Run what is missing of a published table, or of your own, and print it beside the paper.

    table     spatialseg/table3, my/ablation (in ./tables), a file; all with dry_run=true
    seeds     how many (3 for the seeds 0, 1, 2), or which: 0,4,7
    scale     demo (minutes, embedded data) or paper (as published)
    dry_run   true: show the cells, what is there already and how long the rest takes
    retry     failed: try again what failed in an earlier call; retries: how often in this one
    workers   runs at a time; gpus=[0,1] gives each worker one, threads shares the cores out
    storage   where machines agree on who runs what: file.journal, postgresql://user@host/name
    wait      true: stay until the cells that other commands run are done too
    timeout_minutes, max_failures, executor, submitit as in conf/hydra/sweeper/study.yaml
    out       folder of table.md, .csv, .tex and figure.png; default: tables/ in the folder of runs
    overrides of every row: dataset.root=/data/MFNet tracking.uri=http://host:5000

    A table of your own:
    python -m sweeps.reproduce new table=my/ablation experiment=grbm masker.sigma_div=1,2,4
    """
    settings = settings_of(arguments)
    place, extra = _place(arguments, overrides)
    if arguments["table"] == ALL:
        return _preview_all(arguments, extra, place, settings)
    wanted = _wanted(arguments["table"], arguments, extra)
    if settings.dry_run:
        return _preview(wanted, place, settings)
    return _reproduce(wanted, place, settings)


def settings_of(arguments: Mapping[str, str]) -> Settings:
    """The settings of execution; the others of a sweep as in ``conf/hydra/sweeper/study.yaml``.

    Raises:
        InputError: a value of a wrong type.
    """
    from omegaconf import DictConfig, OmegaConf

    from rgbt.config import conf_dir
    from sweeps.settings import read_settings

    node = OmegaConf.load(conf_dir() / "hydra" / "sweeper" / "study.yaml")
    assert isinstance(node, DictConfig), "the file is a mapping"
    for key, text in arguments.items():
        if key not in OF_THE_TABLE:
            node[key] = _parsed(key, text)
    try:
        return read_settings(node)
    except InputError as error:
        raise InputError(str(error).replace("hydra.sweeper.", "")) from error


def _parsed(key: str, text: str) -> Any:
    """A value as Hydra reads it."""
    from hydra.core.override_parser.overrides_parser import OverridesParser
    from hydra.errors import HydraException

    if key in WORDS:
        return None if text in ("null", "") else text
    try:
        return OverridesParser.create().parse_override(f"{key}={text}").value()
    except HydraException as error:
        raise InputError(f"{key}={text}: cannot be read as a value.") from error


def _place(arguments: Mapping[str, str], overrides: Sequence[str]) -> tuple[Place, tuple[str, ...]]:
    """Where everything lies, and the overrides of the rows."""
    for word in overrides:
        key = word.lstrip("+~").partition("=")[0]
        if key in ("seed", "experiment"):
            other = "seeds=3" if key == "seed" else "another table"
            raise InputError(f"'{word}' belongs to the rows of the table; choose {other}.")
        if word.startswith("-"):
            raise InputError(f"'{word}' is no key=value; {nearest(word, OWN)}.")
    tracker = tuple(word for word in overrides if word.lstrip("+~").startswith("tracking"))
    rest = tuple(word for word in overrides if word not in tracker)
    out = Path(arguments["out"]) if arguments["out"] else None
    return Place(Path(arguments["runs_dir"]), out, tracker), rest


def _wanted(name: str, arguments: Mapping[str, str], extra: tuple[str, ...]) -> Wanted:
    from rgbt.config import conf_dir
    from sweeps.cell_points import Wanted, seeds_of
    from sweeps.scoring import check_metrics
    from sweeps.table import load_table

    scales = [path.stem for path in (conf_dir() / "scale").glob("*.yaml")]
    check_choice("scale", arguments["scale"], scales)
    table = load_table(name)
    check_metrics(table, (row for row in table.rows if table.runnable(row)))
    return Wanted(name, table, arguments["scale"], seeds_of(arguments["seeds"]), extra)


def _runs(place: Place) -> Runs:
    """Where finished runs are found, as the overrides of the tracker say."""
    from rgbt.config import build, compose
    from sweeps.found import Runs

    with composing(place.base):
        config = compose(place.base)
        check_node(config.tracking, "tracking")
    return Runs(place.runs_dir.expanduser().resolve(), build(config.tracking))


def _point_list(wanted: Wanted, place: Place, runs: Runs) -> PointList:
    from sweeps.lists import PointList

    return PointList(
        study=f"table/{wanted.name}",
        title=f"{wanted.name} scale={wanted.scale}",
        kind="list",
        points=tuple(wanted.points()),
        runs=runs,
        base=place.base,
    )


def _preview(wanted: Wanted, place: Place, settings: Settings) -> int:
    from rich.text import Text

    from rgbt.tracking.terminal import rich_table, show
    from sweeps.lists import survey
    from sweeps.preview import cells_grid, summary

    outcomes = survey(_point_list(wanted, place, _runs(place)), settings)
    if outcomes:
        show(rich_table(cells_grid(wanted, outcomes)))
    show(Text("\n".join(summary(wanted, outcomes, settings.workers))))
    return 0


def _preview_all(
    arguments: Mapping[str, str], extra: tuple[str, ...], place: Place, settings: Settings
) -> int:
    from rgbt.tracking.terminal import rich_table, show
    from sweeps.lists import survey
    from sweeps.preview import tables_grid
    from sweeps.table import table_names

    if not settings.dry_run:
        raise InputError(
            "table=all is for dry_run=true; run one table at a time."
        )
    every = [_wanted(name, arguments, extra) for name in table_names()]
    runs = _runs(place)
    surveyed = [(wanted, survey(_point_list(wanted, place, runs), settings)) for wanted in every]
    show(rich_table(tables_grid(surveyed, settings.workers)))
    return 0


def _reproduce(wanted: Wanted, place: Place, settings: Settings) -> int:
    from sweeps.lists import work_off
    from sweeps.table_results import finish

    runs = _runs(place)
    points = _point_list(wanted, place, runs)
    outcomes = work_off(points, settings) if points.points else []
    return finish(wanted, outcomes, place.folder(wanted), runs.tracking)


def entry() -> None:
    """The command; its first word may be ``new``."""
    if sys.argv[1:2] == ["new"]:
        from sweeps.new import OWN as OF_NEW
        from sweeps.new import new

        del sys.argv[1]
        plain_command(OF_NEW, new)()
    plain_command(OWN, main)()


if __name__ == "__main__":
    entry()
