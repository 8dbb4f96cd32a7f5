"""The result of a grid: one row per configuration, mean and spread over its seeds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from rgbt.metrics import names
from rgbt.tables import ABSENT, TextTable, number
from sweeps.point import Outcome, Point
from sweeps.score.cells import over_seeds

MOST_REGIONS = 99


def group_grid(title: str, outcomes: Sequence[Outcome]) -> TextTable:
    """Return the scores on the test split by configuration.

    Returns:
        columns: configuration, seeds that went into the row ("2 of 3" where some are missing),
        mIoU, Var and the regions as "mean ± standard deviation (n - 1)", of one seed its value
        alone, and of configurations of one run each the key of that run.
    """
    groups: dict[str, list[Outcome]] = {}
    for outcome in outcomes:
        group = groups.setdefault(_configuration(outcome.point), [])
        # A seed that was typed twice is one run.
        if not outcome.keys or outcome.keys not in [member.keys for member in group]:
            group.append(outcome)
    scores = {label: [_scores(member) for member in group] for label, group in groups.items()}
    metrics = [names.MIOU, names.VAR]
    for region in range(1, MOST_REGIONS):
        name = names.region(region)
        if any(f"test/{name}" in seed for seeds in scores.values() for seed in seeds):
            metrics.append(name)
    header = ["configuration", "seeds", *metrics]
    has_seeds = any(len(group) > 1 for group in groups.values())
    if not has_seeds:
        header.append("run")
    rows = []
    for label, group in groups.items():
        cells = []
        for metric in metrics:
            values = [seed.get(f"test/{metric}", "not run") for seed in scores[label]]
            cells.append(over_seeds(dict(enumerate(values))))
        count = cells[0].seeds
        row = [label, f"{count} of {len(group)}" if count < len(group) else str(count)]
        for cell in cells:
            spread = f" ± {number(cell.sd)}" if cell.seeds > 1 else ""
            row.append(f"{number(cell.mean)}{spread}")
        if not has_seeds:
            row.append(" ".join(group[0].keys) or ABSENT)
        rows.append(tuple(row))
    return TextTable(title, tuple(header), tuple(rows))


def _scores(outcome: Outcome) -> Mapping[str, float]:
    """The scores of a point by name; empty where it has none."""
    is_finished = outcome.state == "finished" and outcome.results
    return outcome.results[0].recorded_scores() if is_finished else {}


def unfinished_grid(outcomes: Sequence[Outcome]) -> TextTable:
    """Return the points without a result, and why; no rows where all are finished."""
    rows = []
    for outcome in outcomes:
        if outcome.state != "finished":
            key = " ".join(outcome.keys) or ABSENT
            rows.append((outcome.point.label, outcome.state, key, outcome.reason))
    header = ("point", "state", "run", "reason")
    return TextTable("Points without a result", header, tuple(rows))


def _configuration(point: Point) -> str:
    """The label of a point without its seed, else its experiment."""
    label = " ".join(word for word in point.label.split(" ") if not word.startswith("seed="))
    if label:
        return label
    for word in point.overrides:
        key, _, value = word.partition("=")
        if key == "+experiment":
            return value
    return ABSENT
