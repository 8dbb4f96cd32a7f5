"""The result of a grid: one row per configuration, mean and spread over its seeds."""

from __future__ import annotations

from collections.abc import Sequence

from rgbt.metrics import names
from rgbt.tables import ABSENT, TextTable, number
from sweeps.point import Outcome, Point
from sweeps.score.cells import over_seeds

MOST_REGIONS = 99


def group_grid(title: str, outcomes: Sequence[Outcome]) -> TextTable:
    """Scores on the test split by configuration.

    Returns:
        columns: configuration, seeds that went into the row ("2 of 3" where some are missing),
        mIoU, Var and the regions as "mean ± standard deviation (n - 1)", of one seed its value
        alone, and of configurations of one run each the key of that run.
    """
    groups: dict[str, list[Outcome]] = {}
    scores = {}
    for outcome in outcomes:
        members = groups.setdefault(_configuration(outcome.point), [])
        # A seed that was typed twice is one run.
        if not outcome.keys or all(each.keys != outcome.keys for each in members):
            members.append(outcome)
        is_finished = outcome.state == "finished" and outcome.results
        scores[id(outcome)] = outcome.results[0].recorded_scores() if is_finished else {}
    known = {name for each in scores.values() for name in each}
    regions = map(names.region, range(1, MOST_REGIONS))
    metrics = [names.MIOU, names.VAR, *(name for name in regions if f"test/{name}" in known)]
    has_seeds = any(len(members) > 1 for members in groups.values())
    rows = []
    for label, members in groups.items():
        tested = [scores[id(each)] for each in members]
        cells = [
            over_seeds({n: each.get(f"test/{metric}", "not run") for n, each in enumerate(tested)})
            for metric in metrics
        ]
        count = cells[0].seeds
        seeds = f"{count} of {len(members)}" if count < len(members) else str(count)
        spreads = (f" ± {number(cell.sd)}" if cell.seeds > 1 else "" for cell in cells)
        shown = (f"{number(cell.mean)}{s}" for cell, s in zip(cells, spreads, strict=True))
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


def _configuration(point: Point) -> str:
    """The label of a point without its seed, else its experiment."""
    label = " ".join(word for word in point.label.split(" ") if not word.startswith("seed="))
    named = (word.partition("=") for word in point.overrides)
    return label or next((value for key, _, value in named if key == "+experiment"), ABSENT)
