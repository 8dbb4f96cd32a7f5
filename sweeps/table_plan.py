"""From the words of a command to a table that is run: its request, points, judge, external rows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from analysis.uncertainty.contrasts import FIXED
from analysis.uncertainty.verdicts import Rule
from rgbt.checks import InputError, check_choice, split_list
from rgbt.config.command import composing
from rgbt.config.component import Component
from rgbt.config.compose import available, compose
from rgbt.config.options import readable_paths
from sweeps.point import Outcome
from sweeps.run.planner import Planner
from sweeps.run.point_list import PointList
from sweeps.run.run_store import RunStore, open_run_store
from sweeps.table.cells import is_counted, metric_of
from sweeps.table.claim import PREVIOUS
from sweeps.table.efficiency import network_sizes
from sweeps.table.external import ExternalRow, ExternalRun, external_rows, row_named
from sweeps.table.request import PRETRAINED, TableRequest, seeds_of
from sweeps.table.table import PUBLISHED, Row, Table, is_own, load_table, table_names, table_path
from sweeps.verdicts.judge import CellRunId, TableJudge
from sweeps.verdicts.until_decided import START, SeedsUntilDecided

if TYPE_CHECKING:
    from sweeps.reproduce import Options

# Nodes of the configuration that no override may change.
ROW_SETTINGS = {
    "seed": "the rows set it; choose seeds=3.",
    "experiment": "the rows set it; choose another table.",
    "metric": "the columns define what is counted; set `regions` in your own table.",
    "consistency": "the columns define what is counted; see rgbt consistency run=...",
}


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
    if key in ROW_SETTINGS:
        raise InputError(f"'{word}': {ROW_SETTINGS[key]}")


def select_rows(table: Table, text: str) -> Table:
    """The table with the rows of ``rows=A,H`` alone, and with the claims about them.

    A row is named by its label or its number (labels with commas: by the number), several by the
    name of their group (`Row.group`).
    """
    chosen: set[str] = set()
    for word in split_list(text, "rows"):
        group = {row.label for row in table.rows if row.group == word}
        chosen |= group or {row_named(word, table).label}
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

    Rows that cannot be composed or lack a checkout are left to the planning.
    """
    origin = _origins(request.table)
    seen: dict[tuple[Any, ...], str] = {}
    for row in request.trained_rows:
        try:
            key = planner.specify((*planner.base, *request.overrides(row.label, 0))).key
        except InputError:
            continue
        metrics = [metric_of(each, row) for each in request.table.columns if is_counted(each)]
        same = seen.setdefault((key, *metrics), row.label)
        if origin[same] != origin[row.label]:
            raise InputError(
                f"the rows '{same}' and '{row.label}' of {request.name} would be the same run "
                f"({key}) at scale={request.scale}, form={request.form}; remove the override "
                f"that makes them equal, or write same_as: {same} in the table."
            )


def row_digests(request: TableRequest, planner: Planner) -> dict[str, str]:
    """The digest of the settings of every trained row alone, without what was typed for all.

    By it a report knows whether a row is the one of today, without composing the words of a run.
    """
    alone = replace(request, extra=(), pretrained={})
    rows = request.trained_rows
    return {row.label: planner.row_digest(alone.overrides(row.label, 0)) for row in rows}


def _origins(table: Table) -> dict[str, str]:
    """Label of every row -> the first of the rows that may be the same run."""
    origin: dict[str, str] = {}
    for row in table.rows:
        origin[row.label] = origin.get(row.same_as or "", row.label)
    return origin


def make_request(
    request: TableRequest, rows: str = "", *, both: bool = False
) -> tuple[TableRequest, list[ExternalRow]]:
    """A request as it was typed with selected rows, `both` forms, and rows that are not trained.

    Its `extra` are all overrides, with pretrained.NETWORK=FILE, weights.ROW=FILE and
    predictions.ROW=FOLDER.
    """
    check_choice("scale", request.scale, available("scale"))
    table = select_rows(request.table, rows) if rows else request.table
    table = table.both_forms() if both else table
    external, others = external_rows(request.extra, table)
    files = [word.removeprefix(PRETRAINED) for word in others if word.startswith(PRETRAINED)]
    typed = [f"{row.kind}.{row.label}={row.path}" for row in external]
    typed += [f"rows={rows}"] if rows else []
    typed += ["form=both"] if both else []
    made = replace(
        request,
        table=table,
        extra=tuple(word for word in others if not word.startswith(PRETRAINED)),
        pretrained={word.partition("=")[0]: word.partition("=")[2] for word in files},
        evaluated=tuple(row.label for row in external),
        typed=tuple(typed),
    )
    for model in made.pretrained:
        what = f"{PRETRAINED}NETWORK of {request.name} at scale={request.scale}"
        check_choice(what, model, made.models())
    return made, external


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
    until_decided: SeedsUntilDecided | None
    rows: Sequence[ExternalRow]
    external: dict[CellRunId, Outcome]

    def evaluate_external(self, trust: str) -> None:
        """Count the rows that are not trained; InputError: a path that does not fit its row."""
        for row in self.rows:
            runs_dir = self.points.runs.runs_dir
            run = ExternalRun.of(row, self.request, self.points.planner.base, runs_dir)
            outcome = run.outcome(self.request.table, trust)
            if outcome.state == "failed":
                raise InputError(f"row '{row.label}': {outcome.reason}")
            self.external[row.label, FIXED] = outcome


def stored_and_planner(options: Options, overrides: Sequence[str]) -> tuple[RunStore, Planner]:
    """The finished runs, and the planner of runs in the same folder and tracker."""
    for word in overrides:
        check_override(word)
    base = (*readable_paths([f"runs_dir={options.runs_dir}"]), *filter(_is_tracker, overrides))
    with composing(base):
        config = compose([*base, f"fresh={str(options.fresh).lower()}"])
        Component.from_node(config.tracking)
    return open_run_store(config), Planner(base)


def _is_tracker(override: str) -> bool:
    return override.lstrip("+~").startswith("tracking")


def plan_table(
    options: Options, overrides: Sequence[str], runs: RunStore, planner: Planner
) -> TablePlan:
    """A table as a command runs it; `overrides` are of every row and of the tracker."""
    extra = [word for word in overrides if not _is_tracker(word)]
    adds = options.seeds == "until_decided"
    name, table = read_named(options.table)
    seeds = tuple(range(START)) if adds else seeds_of(options.seeds)
    both = options.form == "both"
    form = "paper" if options.form == "both" else options.form
    typed = TableRequest(
        name, table, options.scale, seeds, tuple(extra), form=form, until_decided=adds
    )
    request, rows = make_request(typed, options.rows, both=both)
    if extra or is_own(options.table):  # a test checks the others
        check_equal_runs(request, planner)
    if request.deciding_words():
        request = replace(request, digests=row_digests(request, planner))
    if adds and not request.table.claims:
        raise InputError(
            f"seeds=until_decided: {name} has no claims with these rows; give a number of seeds, "
            "or add claims to the table."
        )
    sizes = {} if options.dry_run else network_sizes(request)
    judge = TableJudge(name, request.table, Rule(any_time=adds), sizes=sizes)
    external: dict[CellRunId, Outcome] = {}
    more = SeedsUntilDecided(request, judge, options.max_seeds, external) if adds else None
    title, points = f"{name} scale={request.scale}", tuple(request.points())
    # Other rows, seeds or another scale are another study: its driver does not run these.
    study = " ".join(["table/" + name, request.variant, *map(str, [] if adds else seeds)])
    planned = PointList(study, title, points, runs, planner, more)
    return TablePlan(request, judge, planned, more, rows, external)
