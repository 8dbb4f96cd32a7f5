"""The report of a study: tables in the terminal, Markdown and CSV; `optuna-dashboard` draws it."""

from __future__ import annotations

import hashlib
import math
import re
import warnings
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from rich.console import Group
from rich.text import Text

from rgbt.config.compose import PIXELS, with_pixels
from rgbt.files.atomic import write_atomic
from rgbt.metrics import names as metric_names
from rgbt.runs.provenance import without_passwords
from rgbt.tables import ABSENT, TextTable, csv_text, number
from rgbt.terminal import path_lines, print_rich, rich_table
from sweeps import attributes
from sweeps.point import short_names
from sweeps.worker.trial_store import counted_trials

if TYPE_CHECKING:
    import optuna
    from optuna.distributions import BaseDistribution
    from optuna.trial import FrozenTrial

WORDS = {
    "COMPLETE": "complete",
    "PRUNED": "pruned",
    "FAIL": "failed",
    "RUNNING": "running",
    "WAITING": "waiting",
}
"""Optuna's states as shown."""

MIN_TRIALS, ADVISED = 10, 50
"""Complete trials below which importances would be noise, because PED-ANOVA looks at the best
tenth; and from which that tenth has the five trials that its authors ask for."""

TOP, POINTS = 10, 50
"""Rows of the tables of best trials, and of points of a grid or list; the CSV has all."""

REASON_LENGTH = 120
"""Characters of a reason in a table; the CSV has all."""

ALWAYS = (metric_names.MIOU, metric_names.VAR)
"""Scores that are shown also where they are no objective."""


@dataclass(frozen=True)
class StudyData:
    """A study at one moment.

    Attributes:
        kind: "search", "grid" or "list".
        metrics: names of the objectives.
        maximize: whether more is better, by objective.
        trials: those that count, by number.
        command: that created the study, or "".
    """

    name: str
    kind: str
    metrics: tuple[str, ...]
    maximize: tuple[bool, ...]
    trials: tuple[FrozenTrial, ...]
    command: str = ""

    @classmethod
    def read(cls, study: optuna.Study) -> StudyData:
        """Read a study."""
        notes = study.user_attrs
        names = notes.get(attributes.METRICS) or study.metric_names
        default = (f"objective {index + 1}" for index in range(len(study.directions)))
        return cls(
            name=study.study_name,
            kind=str(notes.get(attributes.KIND, "search")),
            metrics=tuple(names or default),
            maximize=tuple(direction.name == "MAXIMIZE" for direction in study.directions),
            trials=tuple(counted_trials(study)),
            command=str(notes.get(attributes.COMMAND, "")),
        )

    def of_state(self, state: str) -> list[FrozenTrial]:
        """Trials in a state (see `WORDS`), by number."""
        return [trial for trial in self.trials if trial.state.name == state]

    @cached_property
    def complete(self) -> list[FrozenTrial]:
        """Trials whose objectives are all known and finite, by number."""
        complete = self.of_state("COMPLETE")
        return [trial for trial in complete if all(map(math.isfinite, trial.values))]

    @cached_property
    def counts(self) -> dict[str, int]:
        """Number of trials by state, as in `WORDS`."""
        counter = Counter(trial.state.name for trial in self.trials)
        return {state: counter[state] for state in WORDS}

    @cached_property
    def distributions(self) -> Mapping[str, BaseDistribution]:
        """Each parameter's distribution, in the order in which the trials first have them."""
        found: dict[str, BaseDistribution] = {}
        for trial in self.trials:
            for name, distribution in trial.distributions.items():
                found.setdefault(name, distribution)
        return found

    @cached_property
    def front(self) -> list[FrozenTrial]:
        """The Pareto front, best first objective first; with one objective its best trials."""
        signs = np.where(self.maximize, 1.0, -1.0)
        points = np.array([trial.values for trial in self.complete]).reshape(-1, len(signs)) * signs
        as_good = (points[:, None] >= points).all(-1)
        beaten = np.any(as_good & (points[:, None] > points).any(-1), axis=0)
        found = [trial for trial, each in zip(self.complete, beaten, strict=True) if not each]
        return sorted(found, key=self.rank)

    @cached_property
    def latest(self) -> list[FrozenTrial]:
        """The latest trial of each point: earlier ones failed and were retried."""
        last = {t.user_attrs.get(attributes.KEY, t.number): t for t in self.trials}
        return sorted(last.values(), key=lambda trial: trial.number)

    def rank(self, trial: FrozenTrial) -> tuple[float, int]:
        """Sorts complete trials by their first objective, best first, then by number."""
        return (-1.0 if self.maximize[0] else 1.0) * trial.values[0], trial.number

    def of_objective(self, index: int) -> optuna.Study:
        """The complete trials in memory with one objective."""
        import optuna

        study = optuna.create_study(direction="maximize" if self.maximize[index] else "minimize")
        for trial in self.complete:
            made = optuna.trial.create_trial(
                value=trial.values[index], params=trial.params, distributions=trial.distributions
            )
            study.add_trial(made)
        return study

    def shown(self, value: object) -> str:
        """A parameter's value: four significant digits; ``${px:64}`` in pixels of the trials."""
        factors = {trial.user_attrs.get(attributes.PIXELS) for trial in self.trials}
        if isinstance(value, str) and PIXELS.search(value):
            factor = factors.pop() if len(factors) == 1 else None
            if isinstance(factor, float | int):
                return with_pixels(value, factor)
            return PIXELS.sub(r"\1px", value)
        return f"{value:.4g}" if isinstance(value, float) else str(value)

    def label(self, trial: FrozenTrial) -> str:
        """How a trial is shown: its label, else its parameters, else its number."""
        short = short_names(self.distributions)
        pairs = [f"{short[name]}={self.shown(value)}" for name, value in trial.params.items()]
        return str(trial.user_attrs.get(attributes.LABEL) or " ".join(pairs) or trial.number)

    def scores(self, trial: FrozenTrial) -> dict[str, float]:
        """Objectives and other scores of a trial by name, in percent (Var as it is)."""
        objectives = dict(zip(self.metrics, trial.values or (), strict=False))
        results = dict(trial.user_attrs.get(attributes.RESULTS) or {})
        known = {name: score for name, score in results.items() if score is not None}
        return {**known, **objectives}

    def score_names(self, trials: Sequence[FrozenTrial]) -> list[str]:
        """Objectives first, then every other score that some trial has."""
        names = dict.fromkeys(self.metrics)
        for trial in trials:
            names |= dict.fromkeys(self.scores(trial))
        return list(names)


class Importances(NamedTuple):
    """How much the objectives depend on each parameter.

    Attributes:
        shares: parameter -> share by objective, which sum to 1 over the parameters; NaN for an
            objective that has one value only. Most important for the first objective first.
        remark: why there are none, what was left out, or how uncertain they are; "" if nothing.
    """

    shares: Mapping[str, tuple[float, ...]]
    remark: str


def importances(data: StudyData) -> Importances:
    """Importances by PED-ANOVA, which is Optuna's default: of reaching the best tenth.

    Source: Watanabe et al., "PED-ANOVA", IJCAI 2023, arXiv 2304.10255.
    """
    import optuna

    count = len(data.complete)
    if data.kind == "list":
        return Importances({}, "")
    if count < MIN_TRIALS:
        return Importances({}, f"they need {MIN_TRIALS} complete trials, and there are {count}.")
    values = {
        name: {trial.params[name] for trial in data.complete if name in trial.params}
        for name in data.distributions
    }
    varied = [name for name in values if len(values[name]) > 1]
    if not varied:
        return Importances({}, "no parameter took two values.")
    found, flat = [], []
    for index, metric in enumerate(data.metrics):
        if len({trial.values[index] for trial in data.complete}) == 1:
            flat.append(metric)
            found.append(dict.fromkeys(varied, math.nan))
            continue
        with warnings.catch_warnings():
            # The remark says how uncertain the shares are.
            warnings.filterwarnings("ignore", "Some regimes for parameter", UserWarning)
            study = data.of_objective(index)
            found.append(optuna.importance.get_param_importances(study, params=varied))
    constant = ", ".join(name for name in data.distributions if name not in varied)
    said = [
        f"{constant}: one value only, excluded." if constant else "",
        f"{', '.join(flat)}: the same value in all trials." if flat else "",
        f"rough: {count} complete trials, {ADVISED} are recommended." if count < ADVISED else "",
    ]
    remark = " ".join(filter(None, said))
    if len(flat) == len(data.metrics):
        return Importances({}, remark)
    shares = {name: tuple(each[name] for each in found) for name in varied}
    order = sorted(varied, key=lambda name: [-np.nan_to_num(share) for share in shares[name]])
    return Importances({name: shares[name] for name in order}, remark)


def tables(data: StudyData, shares: Importances) -> list[TextTable]:
    """What the terminal and the Markdown file show, in order; empty tables are left out."""
    row = (str(sum(data.counts.values())), *map(str, data.counts.values()))
    counts = TextTable(f"Study {data.name} ({data.kind})", ("trials", *WORDS.values()), (row,))
    important = [
        (name, *(number(100.0 * share) for share in of_objectives))
        for name, of_objectives in shares.shares.items()
    ]
    header = ("parameter", *(f"for {metric}, %" for metric in data.metrics))
    importance = TextTable("Importance of the parameters", header, tuple(important))
    grids = (counts, trials_grid(data), failed_grid(data), importance)
    return [grid for grid in grids if grid.rows]


def trials_grid(data: StudyData) -> TextTable:
    """The most important trials with their parameters, scores and runs.

    Of a search the best `TOP` by the objective, or the Pareto front of several; of a grid or list
    the points in their order.
    """
    trials, with_label = data.front, not data.distributions
    title = f"Pareto front: {len(data.front)} of {len(data.complete)} complete trials"
    if data.kind != "search":
        trials, rest, with_label = data.latest[:POINTS], len(data.latest) - POINTS, True
        more = f" (the first {POINTS}; {rest} more in trials.csv)" if rest > 0 else ""
        title = f"Points{more}"
    elif len(data.metrics) == 1:
        trials = sorted(data.complete, key=data.rank)[:TOP]
        way = "highest" if data.maximize[0] else "lowest"
        title = f"Best trials: {way} {data.metrics[0]}"
    names = [] if with_label else list(data.distributions)
    short = short_names(data.distributions)
    # Objectives and the scores of `ALWAYS`, validation and test side by side.
    ends = [metric.removeprefix("val/").removeprefix("test/") for metric in data.metrics]
    wanted = [f"{split}{end}" for end in (*ends, *ALWAYS) for split in ("", "val/", "test/")]
    known = data.score_names(trials)
    scores = [name for name in dict.fromkeys(wanted) if name in known]
    first = ["point", "state"] if with_label else [short[name] for name in names]
    rows = []
    for trial in trials:
        results = data.scores(trial)
        what = [data.label(trial), WORDS[trial.state.name]] if with_label else []
        what += [data.shown(trial.params[n]) if n in trial.params else ABSENT for n in names]
        values = [number(results[name]) if name in results else ABSENT for name in scores]
        rows.append((str(trial.number), *what, *values, _seconds(trial), _runs(trial)))
    return TextTable(title, ("trial", *first, *scores, "seconds", "runs"), tuple(rows))


def failed_grid(data: StudyData) -> TextTable:
    """Failed trials with their reasons; without those that were retried."""
    failed = [trial for trial in data.latest if trial.state.name == "FAIL"]
    again = data.counts["FAIL"] - len(failed)
    title = "Failed trials" + (f" ({again} more were retried)" if again else "")
    rows = []
    for trial in failed:
        reason = _reason(trial)
        is_long = len(reason) > REASON_LENGTH
        reason = f"{reason[: REASON_LENGTH - 1]}…" if is_long else reason
        rows.append((reason, str(trial.number), data.label(trial), _runs(trial), _seconds(trial)))
    return TextTable(title, ("reason", "trial", "point", "runs", "seconds"), tuple(rows))


def trials_csv(data: StudyData) -> str:
    """All trials that count, one line each, numbers in full."""
    names, scores = list(data.distributions), data.score_names(data.trials)
    header = ["trial", "state", "label", *names, *scores, "seconds", "last_step", "runs", "reason"]
    rows: list[list[object]] = [[*header]]
    for trial in data.trials:
        results = data.scores(trial)
        row = [trial.number, WORDS[trial.state.name], data.label(trial)]
        row += [trial.params.get(name, "") for name in names]
        row += [results.get(name, "") for name in scores]
        row.append(trial.user_attrs.get(attributes.SECONDS, ""))
        last = max(trial.intermediate_values, default="")
        rows.append([*row, last, _runs(trial).removeprefix(ABSENT), _reason(trial)])
    return csv_text(rows)


def _reason(trial: FrozenTrial) -> str:
    return " ".join(str(trial.user_attrs.get(attributes.REASON, "")).split())


def _seconds(trial: FrozenTrial) -> str:
    seconds = trial.user_attrs.get(attributes.SECONDS)
    return ABSENT if seconds is None else f"{seconds:.0f}"


def _runs(trial: FrozenTrial) -> str:
    return " ".join(trial.user_attrs.get(attributes.RUNS, ())) or ABSENT


def publish_study(study: optuna.Study, out: Path, url: str) -> None:
    """Print the tables of a study in the storage `url`, and write its files into `out`."""
    data = StudyData.read(study)
    shares = importances(data)
    grids = tables(data, shares)
    out.mkdir(parents=True, exist_ok=True)
    way = ["highest" if up else "lowest" for up in data.maximize]
    objectives = ", ".join(f"{w} {metric}" for w, metric in zip(way, data.metrics, strict=True))
    remarks = [f"Importances: {shares.remark}"] if shares.remark else []
    text = [
        *(f"# Study {data.name}", f"Kind: {data.kind}. Objectives: {objectives}."),
        *([f"Created by `{without_passwords(data.command)}`."] if data.command else []),
        *(grid.to_markdown() for grid in grids),
        *remarks,
    ]
    write_atomic(out / "study.md", "\n\n".join([*text, ""]).encode())
    write_atomic(out / "trials.csv", trials_csv(data).encode())
    print_rich(Group(*map(rich_table, grids), Text("\n".join(remarks))))
    lines = [("report", str(out / "study.md"))]
    if find_spec("optuna_dashboard"):
        lines.append(("figures", f"optuna-dashboard {without_passwords(url)}"))
    print_rich(path_lines(lines))


def study_folder(runs_dir: Path, name: str) -> Path:
    """Folder of the report of a study; characters such as / in its name are replaced."""
    safe = re.sub(r"[^\w+=.-]+", "_", name).lstrip(".")[:80]
    if safe != name:
        safe += "-" + hashlib.sha256(name.encode()).hexdigest()[:6]
    return runs_dir / "studies" / safe
