"""All that the command for a table does with it: its points, its judge, its external rows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from analysis.uncertainty.contrasts import FIXED
from analysis.uncertainty.verdicts import AnyTime, FixedSeeds
from rgbt.checks import InputError
from sweeps.point import Outcome
from sweeps.table import make_request as requests
from sweeps.table.efficiency import exact_sizes
from sweeps.table.external import ExternalRow, ExternalRun
from sweeps.table.load_table import is_own
from sweeps.table.request import TableRequest, seeds_of
from sweeps.verdicts.forms import both_forms
from sweeps.verdicts.judge import CellRunId, TableJudge
from sweeps.verdicts.until_decided import START, SeedsUntilDecided
from sweeps.worker.planner import Planner
from sweeps.worker.point_list import PointList
from sweeps.worker.run_store import RunStore

if TYPE_CHECKING:
    from sweeps.reproduce import Options

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


def plan_table(
    table_name: str, options: Options, extra: Sequence[str], runs: RunStore, planner: Planner
) -> TablePlan:
    """The table as it is run, with `extra` as overrides of every row."""
    adds, is_both = options.seeds == UNTIL_DECIDED, options.form == "both"
    name, table = requests.read_named(table_name)
    if is_both:
        table = both_forms(requests.select_rows(table, options.rows) if options.rows else table)
    words = requests.TableWords(
        seeds=range(START) if adds else seeds_of(options.seeds),
        scale=options.scale,
        form="paper" if options.form == "both" else options.form,
        rows="" if is_both else options.rows,
        overrides=extra,
        others=("form=both", f"rows={options.rows}") if is_both else (),
        until_decided=adds,
    )
    request, rows = requests.make_request(name, table, words)
    if extra or is_own(table_name):  # a test checks the others
        requests.check_equal_runs(request, planner)
    if adds and not request.table.claims:
        raise InputError(
            f"seeds=until_decided: {name} has no claims with these rows (and none with "
            "form=both); give a number of seeds, or add claims to the table."
        )
    sizes = {} if options.dry_run else exact_sizes(request)
    judge = TableJudge(name, request.table, AnyTime() if adds else FixedSeeds(), sizes=sizes)
    external: dict[CellRunId, Outcome] = {}
    more = SeedsUntilDecided(request, judge, options.max_seeds, external) if adds else None
    points = PointList(
        study=f"table/{name}",
        title=f"{name} scale={request.scale}",
        kind="list",
        points=tuple(request.points()),
        runs=runs,
        base=planner.base,
        more=more,
    )
    return TablePlan(request, judge, points, more, rows, external)
