"""The result of a grid: one row per configuration, mean and spread over its seeds."""

from __future__ import annotations

from collections.abc import Sequence

from rgbt.metrics import names
from rgbt.tables import ABSENT, TextTable, number
from sweeps.point import Outcome, Point
from sweeps.rendering.rendered_table import TextCell
from sweeps.table.cells import TableCell, Value, over_seeds

MOST_REGIONS = 99


def group_grid(title: str, outcomes: Sequence[Outcome]) -> TextTable:
    """Scores on the test split by configuration.

    Returns:
        columns: configuration, seeds that went into the row ("2 of 3" where some are missing),
        mIoU, Var and the regions as "mean ± standard deviation (n - 1)", of one seed its value
        alone, and of configurations of one run each the key of that run.
    """
    groups: dict[str, list[Outcome]] = {}
    for outcome in outcomes:
        groups.setdefault(configuration(outcome.point), []).append(outcome)
    known = {
        name for outcome in outcomes for run in outcome.results for name in run.recorded_scores()
    }
    regions = map(names.region, range(1, MOST_REGIONS))
    measured = [name for name in regions if f"test/{name}" in known]
    metrics = [names.MIOU, names.VAR, *measured]
    has_seeds = any(len(members) > 1 for members in groups.values())
    rows = []
    for label, members in groups.items():
        cells = [_cell(metric, members) for metric in metrics]
        count = cells[0].seeds
        seeds = f"{count} of {len(members)}" if count < len(members) else str(count)
        spreads = [number(cell.sd) if cell.seeds > 1 else "" for cell in cells]
        pairs = zip(cells, spreads, strict=True)
        shown = [TextCell(number(cell.mean), spread).whole for cell, spread in pairs]
        beside = [] if has_seeds else [" ".join(members[0].keys) or ABSENT]
        rows.append((label, seeds, *shown, *beside))
    header = ("configuration", "seeds", *metrics, *([] if has_seeds else ["run"]))
    return TextTable(title, header, tuple(rows))


def unfinished_grid(outcomes: Sequence[Outcome]) -> TextTable:
    """Points without a result and why; no rows where all are finished."""
    rows = tuple(
        (each.point.label, each.state, " ".join(each.keys) or ABSENT, each.reason)
        for each in outcomes
        if each.state != "finished"
    )
    return TextTable("Points without a result", ("point", "state", "run", "reason"), rows)


def configuration(point: Point) -> str:
    """The label of a point without its seed, else its experiment."""
    label = " ".join(word for word in point.label.split(" ") if not word.startswith("seed="))
    named = (word.partition("=") for word in point.overrides)
    return label or next((value for key, _, value in named if key == "+experiment"), ABSENT)


def _cell(metric: str, members: Sequence[Outcome]) -> TableCell:
    values: dict[int, Value] = {}
    for index, outcome in enumerate(members):
        scores = (
            outcome.results[0].recorded_scores()
            if outcome.state == "finished" and outcome.results
            else {}
        )
        values[index] = scores.get(f"test/{metric}", outcome.reason or outcome.state)
    return over_seeds(values)
