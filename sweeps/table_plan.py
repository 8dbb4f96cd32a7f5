"""From the words of a command to a table that is run: its request, points, judge, external rows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from analysis.uncertainty.contrasts import FIXED
from analysis.uncertainty.verdicts import AnyTime, FixedSeeds
from rgbt.checks import InputError, check_choice, nearest, split_list
from rgbt.config.command import composing
from rgbt.config.component import Component
from rgbt.config.compose import available, compose
from rgbt.config.options import readable_paths
from sweeps.point import Outcome
from sweeps.table.cells import is_counted, metric_of
from sweeps.table.claim import PREVIOUS
from sweeps.table.efficiency import network_sizes
from sweeps.table.external import ExternalRow, ExternalRun, external_rows, row_named
from sweeps.table.load_table import PUBLISHED, is_own, load_table, table_names, table_path
from sweeps.table.request import PRETRAINED, TableRequest, seeds_of
from sweeps.table.table import Row, Table
from sweeps.verdicts.judge import CellRunId, TableJudge
from sweeps.verdicts.until_decided import START, SeedsUntilDecided
from sweeps.worker.planner import Planner
from sweeps.worker.point_list import PointList
from sweeps.worker.run_store import open_run_store

if TYPE_CHECKING:
    from sweeps.reproduce import Options

OF_THE_ROWS = {
    "seed": "the rows set it; choose seeds=3.",
    "experiment": "the rows set it; choose another table.",
    "metric": "the columns define what is counted; set `regions` in your own table.",
    "consistency": "the columns define what is counted; see rgbt consistency run=...",
}
"""Nodes of the configuration that no override may change."""


def read_named(name: str) -> tuple[str, Table]:
    """A table with the name that its records get; InputError: as of `load_table`, or its name."""
    table, path = load_table(name), table_path(name).resolve()
    if name.endswith((".yaml", ".yml")):
        name = f"{table.paper}/{path.stem}"
        if name in table_names(Path("none")) and not path.is_relative_to(PUBLISHED):
            raise InputError(f"table={path}: '{name}' is a published table; change `paper`.")
    return name, table


def check_override(word: str) -> None:
    """Refuse an override that belongs to the rows or columns of a table."""
    key = word.lstrip("+~").partition("=")[0].rpartition("@")[2].partition(".")[0]
    if key in OF_THE_ROWS:
        raise InputError(f"'{word}': {OF_THE_ROWS[key]}")


def select_rows(table: Table, text: str) -> Table:
    """The table with the rows of ``rows=A,H`` alone, and with the claims about them.

    A row is named by its label or its number, several by the name of their group (`Row.group`).
    """
    labels, words = [row.label for row in table.rows], split_list(text, "rows")
    chosen: set[str] = set()
    while words:  # a label may contain commas
        ends = range(len(words), 1, -1)
        end = next((each for each in ends if ", ".join(words[:each]) in labels), 1)
        word = ", ".join(words[:end])
        group = {row.label for row in table.rows if row.group == word}
        chosen |= group or {row_named(word, table).label}
        del words[:end]
    first, origin, rows = dict[str, str](), _origins(table), list[Row]()
    for row in table.rows:
        if row.label in chosen:
            same = first.setdefault(origin[row.label], row.label)
            rows.append(replace(row, same_as=None if same == row.label else same))

    # "Better than all others" is another statement where some of the others are missing.
    claims = table.claims
    if len(rows) < len(table.rows):
        known = {*chosen, PREVIOUS}
        known |= {str(row.settings.get("method")) for row in rows if row.group}
        claims = tuple(each for each in claims if {*each.rows, *each.against} <= known)
    return replace(table, rows=tuple(rows), claims=claims)


def check_equal_runs(request: TableRequest, planner: Planner) -> None:
    """Refuse rows that are one run with the same scores, unless the table says so (`same_as`).

    Rows that cannot be composed are left to the planning.
    """
    origin = _origins(request.table)
    seen: dict[tuple[Any, ...], str] = {}
    for row in request.trained_rows:
        try:
            spec = planner.specify((*planner.base, *request.overrides(row.label, 0)))
        except InputError:
            continue
        metrics = [metric_of(each, row) for each in request.table.columns if is_counted(each)]
        same = seen.setdefault((spec.key, *metrics), row.label)
        if origin[same] != origin[row.label]:
            raise InputError(
                f"the rows '{same}' and '{row.label}' of {request.name} would be the same run "
                f"({spec.key}) at scale={request.scale}, form={request.form}; remove the override "
                f"that makes them equal, or write same_as: {same} in the table."
            )


def _origins(table: Table) -> dict[str, str]:
    """Label of every row -> the first of the rows that may be the same run."""
    origin: dict[str, str] = {}
    for row in table.rows:
        origin[row.label] = origin.get(row.same_as or "", row.label)
    return origin


@dataclass(frozen=True, kw_only=True)
class TableWords:
    """What a command says about a table, see `sweeps.table.request.TableRequest`.

    `overrides` are those of every row, with pretrained.NETWORK=FILE, weights.ROW=FILE and
    predictions.ROW=FOLDER.
    """

    seeds: Sequence[int]
    scale: str
    form: Literal["paper", "released", "both"] = "paper"
    rows: str = ""
    overrides: Sequence[str] = ()
    until_decided: bool = False


def make_request(
    name: str, table: Table, words: TableWords
) -> tuple[TableRequest, list[ExternalRow]]:
    """The request of a table, and its rows that are evaluated and not trained."""
    check_choice("scale", words.scale, available("scale"))
    table = select_rows(table, words.rows) if words.rows else table
    table = table.both_forms() if words.form == "both" else table
    external, others = external_rows(words.overrides, table)
    files = [word.removeprefix(PRETRAINED) for word in others if word.startswith(PRETRAINED)]
    typed = [f"{row.kind}.{row.label}={row.path}" for row in external]
    typed += [f"rows={words.rows}"] if words.rows else []
    typed += ["form=both"] if words.form == "both" else []
    request = TableRequest(
        name,
        table,
        words.scale,
        tuple(words.seeds),
        tuple(word for word in others if not word.startswith(PRETRAINED)),
        pretrained={word.partition("=")[0]: word.partition("=")[2] for word in files},
        form="paper" if words.form == "both" else words.form,
        until_decided=words.until_decided,
        evaluated=tuple(row.label for row in external),
        typed=tuple(typed),
    )
    for model in request.pretrained:
        if model not in request.models():
            raise InputError(
                f"{PRETRAINED}{model}: no row of {name} uses that network at "
                f"scale={words.scale}; {nearest(model, request.models())}."
            )
    return request, external


UNTIL_DECIDED = "until_decided"


@dataclass(frozen=True)
class TablePlan:
    """A table that is run.

    Attributes:
        points: its runs that are known in advance, and how further ones are chosen.
        until_decided: adds seeds; None where their number is fixed.
        rows: rows that are evaluated and not trained; `external` are their runs.
    """

    request: TableRequest
    judge: TableJudge
    points: PointList
    planner: Planner
    until_decided: SeedsUntilDecided | None
    rows: Sequence[ExternalRow]
    external: dict[CellRunId, Outcome]

    def evaluate_external(self, runs_dir: Path, trust: str) -> None:
        """Count the rows that are not trained; InputError: a path that does not fit its row."""
        for row in self.rows:
            run = ExternalRun.of(row, self.request, self.points.base, runs_dir)
            outcome = run.outcome(self.request.table, trust)
            if outcome.state == "failed":
                raise InputError(f"row '{row.label}': {outcome.reason}")
            self.external[row.label, FIXED] = outcome


def plan_table(options: Options, overrides: Sequence[str]) -> TablePlan:
    """A table as a command runs it; `overrides` are of every row and of the tracker."""
    for word in overrides:
        check_override(word)
    tracker = [word for word in overrides if word.lstrip("+~").startswith("tracking")]
    base = (*readable_paths([f"runs_dir={options.runs_dir}"]), *tracker)
    with composing(base):
        config = compose([*base, f"fresh={str(options.fresh).lower()}"])
        Component.from_node(config.tracking)
    runs, planner = open_run_store(config), Planner(base)
    extra = [word for word in overrides if word not in tracker]
    adds = options.seeds == UNTIL_DECIDED
    name, table = read_named(options.table)
    words = TableWords(
        seeds=range(START) if adds else seeds_of(options.seeds),
        scale=options.scale,
        form=options.form,
        rows=options.rows,
        overrides=extra,
        until_decided=adds,
    )
    request, rows = make_request(name, table, words)
    if extra or is_own(options.table):  # a test checks the others
        check_equal_runs(request, planner)
    if adds and not request.table.claims:
        raise InputError(
            f"seeds=until_decided: {name} has no claims with these rows; give a number of seeds, "
            "or add claims to the table."
        )
    sizes = {} if options.dry_run else network_sizes(request)
    judge = TableJudge(name, request.table, AnyTime() if adds else FixedSeeds(), sizes=sizes)
    external: dict[CellRunId, Outcome] = {}
    more = SeedsUntilDecided(request, judge, options.max_seeds, external) if adds else None
    points = PointList(
        study=f"table/{name}",
        title=f"{name} scale={request.scale}",
        kind="list",
        points=tuple(request.points()),
        runs=runs,
        base=base,
        more=more,
    )
    return TablePlan(request, judge, points, planner, more, rows, external)
