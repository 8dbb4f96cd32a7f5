"""What the arguments of ``python -m sweeps.reproduce`` ask for."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rgbt.checks import InputError, check_choice, nearest
from rgbt.config.command import composing, readable_paths
from rgbt.config.component import Component
from rgbt.config.keys import top_level
from rgbt.metrics.names import MIOU

if TYPE_CHECKING:
    from sweeps.settings import Settings
    from sweeps.table.cell_points import Wanted
    from sweeps.worker.found import Runs
    from sweeps.worker.lists import PointList

Arguments = Mapping[str, str]
"""Values by key, as typed."""

OF_THE_TABLE = ("table", "seeds", "scale", "runs_dir", "out", "fresh")
"""Arguments that are no settings of execution."""

WEIGHTS = "weights."
"""weights.mask2former_swin_b=FILE: for the rows that name this network."""

KEYS = (*top_level()[0], *top_level()[1], "debug")

WORDS = ("storage", "retry", "executor")
"""Settings that are text."""


@dataclass(frozen=True)
class Place:
    """Where a table's runs and files lie.

    Attributes:
        runs_dir: the folder of runs.
        out: folder of the table's files; None: ``tables/<table>_<scale>`` inside `runs_dir`.
        tracker: overrides of the tracker.
        fresh: see `Runs`.
    """

    runs_dir: Path
    out: Path | None
    tracker: tuple[str, ...] = ()
    fresh: bool = False

    @property
    def base(self) -> tuple[str, ...]:
        """Overrides that every run has, whatever row it belongs to."""
        return (*readable_paths([f"runs_dir={self.runs_dir}"]), *self.tracker)

    def folder(self, wanted: Wanted) -> Path:
        """Where the files go."""
        return self.out or self.runs_dir / "tables" / f"{wanted.name}_{wanted.variant}"


def settings_of(arguments: Arguments) -> Settings:
    """The settings of execution; the others of a sweep as in ``conf/hydra/sweeper/study.yaml``.

    Raises:
        InputError: a value of a wrong type.
    """
    from omegaconf import DictConfig, OmegaConf

    from rgbt.config.compose import conf_dir
    from sweeps.settings import read_settings

    node = OmegaConf.load(conf_dir() / "hydra" / "sweeper" / "study.yaml")
    assert isinstance(node, DictConfig), "the file is a mapping"
    # What Optuna's own pages show of a table; nothing is chosen by it.
    node.objectives = [{"metric": f"test/{MIOU}", "direction": "maximize"}]
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


def place_of(arguments: Arguments, overrides: Sequence[str]) -> tuple[Place, tuple[str, ...]]:
    """Where everything lies, and the overrides of the rows.

    Raises:
        InputError: an override that belongs to the rows of the table.
    """
    for word in overrides:
        key = word.lstrip("+~").partition("=")[0]
        if key in ("seed", "experiment"):
            other = "seeds=3" if key == "seed" else "another table"
            raise InputError(f"'{word}' belongs to the rows of the table; choose {other}.")
        if key.rpartition("@")[2].partition(".")[0] == "consistency":
            raise InputError(
                f"'{word}': the columns of the table say what is counted, on the published sets of "
                "views; measure others with python -m rgbt.consistency run=..."
            )
        if key == "metric" or key.startswith("metric."):
            raise InputError(
                f"'{word}': the columns of the table say what is counted; set its `regions` in a "
                "table of your own."
            )
        if _is_misspelt(word, arguments):
            raise InputError(f"'{word}': {key} is no key; {nearest(key, [*arguments, *KEYS])}.")
        if word.startswith("-"):
            raise InputError(f"'{word}' is no key=value; {nearest(word, arguments)}.")
    tracker = tuple(word for word in overrides if word.lstrip("+~").startswith("tracking"))
    rest = tuple(word for word in overrides if word not in tracker)
    out = Path(arguments["out"]) if arguments["out"] else None
    check_choice("fresh", arguments["fresh"], ("true", "false"))
    return Place(Path(arguments["runs_dir"]), out, tracker, arguments["fresh"] == "true"), rest


def _is_misspelt(word: str, arguments: Arguments) -> bool:
    """Whether a word without a dot is neither a node nor a plain key of a configuration."""
    key = word.lstrip("+~").partition("=")[0]
    return not set(key) & set("./@") and key not in KEYS and key not in arguments


def wanted_of(name: str, arguments: Arguments, extra: tuple[str, ...]) -> Wanted:
    """The table called `name` at the scale and with the seeds that were given.

    Raises:
        InputError: no such table, scale or metric; no seeds.
    """
    from rgbt.config.compose import conf_dir
    from sweeps.table.cell_points import Wanted, seeds_of
    from sweeps.table.scoring import check_metrics
    from sweeps.table.table import load_table
    from sweeps.worker.storage import NAME

    scales = [path.stem for path in (conf_dir() / "scale").glob("*.yaml")]
    check_choice("scale", arguments["scale"], scales)
    table = load_table(name)
    if name.endswith((".yaml", ".yml")):
        name = f"{table.paper}/{Path(name).stem}"
    check_metrics(table, (row for row in table.rows if table.runnable(row)))
    if not re.fullmatch(NAME, name):
        raise InputError(
            f"table={name}: MLflow takes names of letters, digits, spaces and _ - . : / alone; "
            "rename the file."
        )
    seeds = seeds_of(arguments["seeds"])
    weights = dict(_weights(word) for word in extra if word.startswith(WEIGHTS))
    others = tuple(word for word in extra if not word.startswith(WEIGHTS))
    wanted = Wanted(name, table, arguments["scale"], seeds, others, weights)
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


def runs_of(place: Place) -> Runs:
    """Where finished runs are found, as the overrides of the tracker say."""
    from rgbt.config.compose import compose
    from sweeps.worker.found import open_runs

    with composing(place.base):
        config = compose([*place.base, f"fresh={str(place.fresh).lower()}"])
        Component.from_node(config.tracking)
    return open_runs(config)


def point_list(wanted: Wanted, place: Place, runs: Runs) -> PointList:
    """The runs of a table, as the driver takes them."""
    from sweeps.worker.lists import PointList

    return PointList(
        study=f"table/{wanted.name}",
        title=f"{wanted.name} scale={wanted.scale}",
        kind="list",
        points=tuple(wanted.points()),
        runs=runs,
        base=place.base,
    )
