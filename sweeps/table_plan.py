"""All that the command for a table does with it: its points, its judge, its external rows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from analysis.uncertainty.contrasts import FIXED
from analysis.uncertainty.verdicts import AnyTime, FixedSeeds
from rgbt.checks import InputError
from sweeps.point import Outcome
from sweeps.table.efficiency import exact_sizes
from sweeps.table.external import ExternalRow
from sweeps.table.external_runs import check_external, run_external
from sweeps.table.request import TableRequest
from sweeps.verdicts.judge import CellRunId, TableJudge
from sweeps.verdicts.until_decided import SeedsUntilDecided
from sweeps.worker.point_list import PointList
from sweeps.worker.run_store import RunStore


@dataclass(frozen=True, kw_only=True)
class TablePlan:
    """A table that is run.

    Attributes:
        points: its runs that are known in advance, and how further ones are chosen.
        until_decided: adds seeds; None where their number is fixed.
        rows: rows that are evaluated and not trained.
        external: their runs, empty before `evaluate_external`.
    """

    request: TableRequest
    judge: TableJudge
    points: PointList
    until_decided: SeedsUntilDecided | None
    rows: Sequence[ExternalRow] = ()
    external: dict[CellRunId, Outcome] = field(default_factory=dict)

    @classmethod
    def of(
        cls,
        request: TableRequest,
        rows: Sequence[ExternalRow],
        runs: RunStore,
        base: Sequence[str],
        max_seeds: int | None,
    ) -> TablePlan:
        """Plan a table.

        Args:
            request: the table.
            rows: its rows that are evaluated and not trained.
            runs: finished runs.
            base: overrides that all runs have.
            max_seeds: most seeds of a row where seeds are added until claims are decided; None:
                the seeds of the request.

        Raises:
            InputError: seeds are to be added, but the table has no claims.
        """
        if max_seeds is not None and not request.table.claims:
            raise InputError(
                f"seeds=until_decided: {request.name} has no claims with these rows (and none with "
                "form=both); give a number of seeds, or add claims to the table."
            )
        rule = AnyTime() if max_seeds else FixedSeeds()
        judge = TableJudge(request.name, request.table, rule, sizes=exact_sizes(request))
        external: dict[CellRunId, Outcome] = {}
        more = max_seeds and SeedsUntilDecided(request, judge, max_seeds, external)
        points = PointList(
            study=f"table/{request.name}",
            title=f"{request.name} scale={request.scale}",
            kind="list",
            points=tuple(request.points()),
            runs=runs,
            base=tuple(base),
            more=more or None,
        )
        return cls(
            request=request,
            judge=judge,
            points=points,
            until_decided=more or None,
            rows=rows,
            external=external,
        )

    def evaluate_external(self, runs_dir: Path) -> None:
        """Count the rows that are not trained; results of an earlier call are read.

        Raises:
            InputError: a file or folder that does not fit its row.
        """
        if not self.rows:
            return
        request = self.request
        runs = run_external(
            self.rows,
            request.table,
            scale=request.scale,
            form=request.form,
            extra=request.extra,
            base=self.points.base,
            runs_dir=runs_dir,
        )
        check_external(runs)
        self.external.update({(label, FIXED): run for label, run in runs.items()})
