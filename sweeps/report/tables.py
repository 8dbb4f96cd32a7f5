"""The tables of a study: trials by state, the best, the failed, importances; as text and CSV."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from rgbt.metrics import names as metric_names
from rgbt.tables import ABSENT, TextTable, csv_text, number
from sweeps import attributes
from sweeps.point import short_names
from sweeps.report.study_data import Importances, StudyData, pruning_savings

if TYPE_CHECKING:
    from optuna.trial import FrozenTrial

TOP = 10
"""Rows of the table of best trials of one objective."""

POINTS = 50
"""Rows of the table of points of a grid or list; the CSV has all."""

REASON_LENGTH = 120
"""Characters of a reason in a table; the CSV has all."""

ALWAYS = (metric_names.MIOU, metric_names.VAR)
"""Scores that are shown also where they are no objective."""

WORDS = {
    "COMPLETE": "complete",
    "PRUNED": "pruned",
    "FAIL": "failed",
    "RUNNING": "running",
    "WAITING": "waiting",
}
"""Optuna's states as shown."""


def tables(data: StudyData, shares: Importances) -> list[TextTable]:
    """What the terminal and the Markdown file show, in order; empty tables are left out."""
    grids = [
        *(counts_grid(data), trials_grid(data)),
        *(failed_grid(data), importance_grid(data, shares)),
    ]
    return [grid for grid in grids if grid.rows]


def counts_grid(data: StudyData) -> TextTable:
    """Number of trials by state, and the share of training steps that pruning saved."""
    counts = data.counts()
    saved = pruning_savings(data)
    header = ["trials", *WORDS.values()]
    row = [str(sum(counts.values())), *(str(counts[state]) for state in WORDS)]
    if saved is not None and saved.trials:
        header.append("steps saved by pruning")
        row.append(f"{saved.share:.0%}")
    return TextTable(f"Study {data.name} ({data.kind})", tuple(header), (tuple(row),))


def trials_grid(data: StudyData) -> TextTable:
    """The most important trials.

    Of a search the best `TOP` by the objective, or the Pareto front of several; of a grid or list
    the points in their order.
    """
    if data.kind != "search":
        points = data.latest
        rest = len(points) - POINTS
        more = f" (the first {POINTS}; {rest} more in trials.csv)" if rest > 0 else ""
        return _grid(data, f"Points{more}", points[:POINTS], with_label=True)
    if len(data.metrics) > 1:
        title = f"Pareto front: {len(data.front)} of {len(data.complete)} complete trials"
        return _grid(data, title, data.front, with_label=not data.distributions)
    best = sorted(data.complete, key=data.rank)[:TOP]
    way = "highest" if data.maximize[0] else "lowest"
    title = f"Best trials: {way} {data.metrics[0]}"
    return _grid(data, title, best, with_label=not data.distributions)


def failed_grid(data: StudyData) -> TextTable:
    """Failed trials with their reasons; without those that were retried."""
    failed = [trial for trial in data.latest if trial.state.name == "FAIL"]
    again = data.counts()["FAIL"] - len(failed)
    title = "Failed trials" + (f" ({again} more were retried)" if again else "")
    rows = [
        (_clipped(_reason(t)), str(t.number), data.label(t), _runs(t), _seconds(t)) for t in failed
    ]
    return TextTable(title, ("reason", "trial", "point", "runs", "seconds"), tuple(rows))


def importance_grid(data: StudyData, shares: Importances) -> TextTable:
    """Share of each parameter in the importance, by objective, in percent."""
    rows = [
        (name, *(number(100.0 * share) for share in of_objectives))
        for name, of_objectives in shares.shares.items()
    ]
    header = ("parameter", *(f"for {metric}, %" for metric in data.metrics))
    return TextTable("Importance of the parameters", header, tuple(rows))


def trials_csv(data: StudyData) -> str:
    """All trials that count, one line each, numbers in full."""
    names = list(data.distributions)
    scores = _score_names(data, data.trials)
    header = ["trial", "state", "label", *names, *scores, "seconds", "last_step", "runs", "reason"]
    rows: list[list[object]] = [[*header]]
    for trial in data.trials:
        results = _scores(data, trial)
        rows.append(
            [
                *(trial.number, WORDS[trial.state.name], data.label(trial)),
                *(trial.params.get(name, "") for name in names),
                *(results.get(name, "") for name in scores),
                trial.user_attrs.get(attributes.SECONDS, ""),
                max(trial.intermediate_values, default=""),
                " ".join(trial.user_attrs.get(attributes.RUNS, ())),
                _reason(trial),
            ]
        )
    return csv_text(rows)


def markdown_table(grid: TextTable) -> str:
    """A grid in Markdown; a bar in a reason or label must not begin a column."""
    rows = tuple(tuple(cell.replace("|", "\\|") for cell in row) for row in grid.rows)
    return TextTable(grid.title, grid.header, rows).to_markdown()


def _grid(
    data: StudyData, title: str, trials: Sequence[FrozenTrial], *, with_label: bool
) -> TextTable:
    """Trials with their parameters or labels, val and test scores side by side, and their runs."""
    names = [] if with_label else list(data.distributions)
    short = short_names(data.distributions)
    scores = _shown_scores(data, trials)
    header = [
        "trial",
        *(["point", "state"] if with_label else (short[name] for name in names)),
        *scores,
        "seconds",
        "runs",
    ]
    rows = []
    for trial in trials:
        results = _scores(data, trial)
        what = [data.label(trial), WORDS[trial.state.name]] if with_label else []
        what += [
            data.shown(trial.params[name]) if name in trial.params else ABSENT for name in names
        ]
        values = [number(results[name]) if name in results else ABSENT for name in scores]
        rows.append((str(trial.number), *what, *values, _seconds(trial), _runs(trial)))
    return TextTable(title, tuple(header), tuple(rows))


def _scores(data: StudyData, trial: FrozenTrial) -> dict[str, float]:
    """Objectives and other scores of a trial by name, in percent (Var as it is)."""
    values = trial.values or ()
    objectives = dict(zip(data.metrics, values, strict=True)) if values else {}
    results = dict(trial.user_attrs.get(attributes.RESULTS) or {})
    return {**{name: score for name, score in results.items() if score is not None}, **objectives}


def _score_names(data: StudyData, trials: Sequence[FrozenTrial]) -> list[str]:
    """Objectives first, then every other score that some trial has."""
    names = dict.fromkeys(data.metrics)
    for trial in trials:
        names |= dict.fromkeys(_scores(data, trial))
    return list(names)


def _shown_scores(data: StudyData, trials: Sequence[FrozenTrial]) -> list[str]:
    """Objectives and the scores of `ALWAYS`, validation and test side by side."""
    known = _score_names(data, trials)
    ends = [metric.removeprefix("val/").removeprefix("test/") for metric in data.metrics]
    stems = dict.fromkeys([*ends, *ALWAYS])
    wanted = [name for stem in stems for name in (stem, f"val/{stem}", f"test/{stem}")]
    return [name for name in dict.fromkeys(wanted) if name in known]


def _reason(trial: FrozenTrial) -> str:
    return " ".join(str(trial.user_attrs.get(attributes.REASON, "")).split())


def _clipped(text: str) -> str:
    return text if len(text) <= REASON_LENGTH else text[: REASON_LENGTH - 1] + "…"


def _seconds(trial: FrozenTrial) -> str:
    seconds = trial.user_attrs.get(attributes.SECONDS)
    return ABSENT if seconds is None else f"{seconds:.0f}"


def _runs(trial: FrozenTrial) -> str:
    return " ".join(trial.user_attrs.get(attributes.RUNS, ())) or ABSENT
