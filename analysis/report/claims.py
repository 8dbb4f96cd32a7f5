"""The claims of tables, judged by the runs that the records of the tables name."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

from analysis.report.data import ClaimEntry, FormsEntry
from analysis.report.tables_rescored import RescoredTable
from analysis.uncertainty.verdicts import AnyTime, FixedSeeds
from sweeps.point import Outcome
from sweeps.table.table import Table
from sweeps.verdicts.contrasts import contrasts_of
from sweeps.verdicts.forms import forms_grid
from sweeps.verdicts.judge import CellRunId, JudgedClaim, TableJudge


def judge_of(draft: RescoredTable, resamples: int) -> TableJudge:
    """The judge of a table that was run.

    Intervals are valid at any number of seeds where
    seeds were added until claims were decided.

    Args:
        draft: the table with its runs.
        resamples: of the images.
    """
    rule = AnyTime() if seeds_were_added(draft) else FixedSeeds()
    return TableJudge(draft.recorded.name, draft.scored.table, rule, resamples)


def seeds_were_added(draft: RescoredTable) -> bool:
    """Whether the number of seeds of a table depends on its results, by the tags of its runs."""
    keys = {run.key for outcome in draft.outcomes.values() for run in outcome.results}
    return any(draft.runs[key].until_decided for key in keys)


def claim_entries(
    judge: TableJudge, runs: Mapping[CellRunId, Outcome] | None = None
) -> tuple[ClaimEntry, ...]:
    """The claims of a table with their verdicts; those that are not run last.

    Args:
        judge: of the table.
        runs: by label of the row and seed; None: nothing was run.
    """
    runs = runs or {}
    entries = [_entry(each, judge.table, runs) for each in judge.claims(runs)]
    return tuple(sorted(entries, key=lambda each: each.verdict == "not run"))


def _entry(judged: JudgedClaim, table: Table, runs: Mapping[CellRunId, Outcome]) -> ClaimEntry:
    claim = judged.claim
    entry = ClaimEntry(
        name=claim.name,
        says=claim.says,
        source=claim.source,
        remarks=claim.remarks,
        verdict="not run",
        contrast=judged.contrast,
        printed=judged.printed,
        as_printed=judged.as_printed,
        missing=judged.missing,
        reason=judged.reason,
    )
    found = judged.verdict
    if found is None:
        return entry
    rows = {label for contrast in contrasts_of(claim, table) for label in contrast.rows}
    behind = (run for (label, _), run in runs.items() if label in rows)
    keys = dict.fromkeys(result.key for run in behind for result in run.results)
    return replace(
        entry,
        verdict=found.kind,
        estimate=found.estimate,
        low=None if found.interval is None else found.interval.low,
        high=None if found.interval is None else found.interval.high,
        covers=found.covers,
        smallest=None if math.isnan(found.smallest) else found.smallest,
        seeds=found.seeds,
        seeds_needed=None if math.isnan(found.seeds_needed) else found.seeds_needed,
        runs=tuple(keys),
    )


def forms_entry(judge: TableJudge, runs: Mapping[CellRunId, Outcome]) -> FormsEntry | None:
    """Differences of the forms of a table; None where one form was run."""
    grid = forms_grid(judge, runs)
    return None if grid is None else FormsEntry(header=grid.header, rows=grid.rows)
