"""Report of a study: ``rgbt study name=search/grbm``, also while it runs.

Tables in the terminal; ``runs/studies/<name>/`` gets them as Markdown and CSV. `optuna-dashboard`
draws it.
"""

from __future__ import annotations

import hashlib
import re
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from rgbt.checks import InputError, nearest, one_line
from rgbt.config.common_options import RunsDir
from rgbt.config.options import Help
from rgbt.config.plain_command import PlainCommand
from rgbt.metrics import names as metric_names
from rgbt.tables import ABSENT, TextTable, csv_text
from sweeps import attributes as names

if TYPE_CHECKING:
    import optuna
    import pandas as pd

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

ALWAYS = (metric_names.MIOU, metric_names.VAR)
"""Scores that are shown also where they are no objective."""


@dataclass(frozen=True)
class Options:
    """Options of ``rgbt study``."""

    name: Annotated[str, Help("name of the study; without a name, all studies are listed")] = ""
    storage: Annotated[str, Help("sqlite:///FILE or postgresql://...; default: studies.db")] = ""
    runs_dir: RunsDir = Path("runs")
    out: Annotated[Path | None, Help("folder of the report; default: studies/<name>")] = None


def main(options: Options, overrides: list[str]) -> int:
    """Show the results of a study: best trials, failures, importances."""
    del overrides  # none is heeded
    from sweeps.worker.storage import known_studies, storage_url

    known = known_studies(options.storage, options.runs_dir)
    url = storage_url(options.storage, options.runs_dir)
    if options.name not in known:
        raise InputError(f"name={options.name}: not in {url}; {nearest(options.name, known)}.")
    out = options.out or study_folder(options.runs_dir, options.name)
    publish_study(known[options.name], out, url)
    return 0


@dataclass(frozen=True)
class StudyData:
    """A study at one moment.

    Attributes:
        kind: "search", "grid" or "list".
        metrics: names of the objectives; `maximize`: whether more is better.
        params: names of the parameters.
        frame: trials that count, one a row: trial (its number), state, label, the parameters, the
            scores in percent, objectives first, seconds, last_step, runs, reason; and the key of
            the point. NaN: it has none.
    """

    study: optuna.Study
    kind: str
    metrics: Sequence[str]
    maximize: Sequence[bool]
    params: Sequence[str]
    frame: pd.DataFrame

    @classmethod
    def read(cls, study: optuna.Study) -> StudyData:
        """Read a study."""
        import pandas as pd

        from rgbt.config.compose import with_pixels
        from sweeps.worker.storage import counted_trials

        trials, rows = counted_trials(study), []
        metrics = study.metric_names or [f"objective {n + 1}" for n in range(len(study.directions))]
        params = list(dict.fromkeys(name for trial in trials for name in trial.params))
        scores = dict.fromkeys(metrics)
        for trial in trials:
            notes, factor = trial.user_attrs, trial.user_attrs.get(names.PIXELS, 1.0)
            found = {
                **notes.get(names.RESULTS, {}),
                **dict(zip(metrics, trial.values or (), strict=False)),
            }
            scores |= dict.fromkeys(found)
            chosen = {
                name: with_pixels(value, factor) if isinstance(value, str) else value
                for name, value in trial.params.items()
            }
            of_trial = {
                **{"trial": trial.number, "state": WORDS[trial.state.name]},
                **{"label": notes.get(names.LABEL, f"#{trial.number}"), **chosen, **found},
                "seconds": notes.get(names.SECONDS),
                "last_step": trial.last_step,
                "runs": " ".join(notes.get(names.RUNS, ())) or None,
                "reason": " ".join(notes.get(names.REASON, "").split()) or None,
                "key": notes.get(names.KEY, trial.number),
            }
            rows.append({name: v for name, v in of_trial.items() if v is not None})
        columns = ["trial", "state", "label", *params, *scores, "seconds", "last_step", "runs"]
        frame = pd.DataFrame(rows, columns=[*columns, "reason", "key"], dtype=object)
        maximize = [direction.name == "MAXIMIZE" for direction in study.directions]
        kind = str(study.user_attrs.get(names.KIND, "search"))
        return cls(study, kind, metrics, maximize, params, frame)

    @property
    def complete(self) -> pd.DataFrame:
        """Trials whose objectives are known."""
        return self.frame[self.frame["state"] == "complete"]

    @property
    def latest(self) -> pd.DataFrame:
        """The latest trial of each point: earlier ones failed and were retried."""
        return self.frame.drop_duplicates("key", keep="last")


def tables(data: StudyData) -> list[TextTable]:
    """Trials by state, the most important trials, the failed ones; empty tables are left out."""
    counts = data.frame["state"].value_counts()
    row = (str(len(data.frame)), *(str(counts.get(word, 0)) for word in WORDS.values()))
    first = TextTable(
        f"Study {data.study.study_name} ({data.kind})", ("trials", *WORDS.values()), (row,)
    )
    failed = data.latest[data.latest["state"] == "failed"].copy()
    failed["reason"] = failed["reason"].map(one_line)
    again = counts.get("failed", 0) - len(failed)
    title = "Failed trials" + (f" ({again} more were retried)" if again else "")
    columns = {name: name for name in ("reason", "trial", "label", "runs", "seconds")}
    found = [first, trials_grid(data), _grid(title, failed, columns)]
    return [grid for grid in found if grid.rows]


def trials_grid(data: StudyData) -> TextTable:
    """The most important trials with their parameters, scores and runs.

    Of a search the best `TOP` by the objective, or the Pareto front of several; of a grid or list
    the points in their order.
    """
    from sweeps.point import short_names

    complete, metric = data.complete, data.metrics[0]
    best = complete.sort_values(metric, ascending=not data.maximize[0], kind="stable")
    if data.kind != "search":
        title, shown = "Points", data.latest.head(POINTS)
        title += f" (the first {POINTS}; all in trials.csv)" if len(data.latest) > POINTS else ""
    elif len(data.metrics) == 1:
        way = "highest" if data.maximize[0] else "lowest"
        title, shown = f"Best trials: {way} {metric}", best.head(TOP)
    else:
        front = [trial.number for trial in data.study.best_trials]
        shown = best[best["trial"].isin(front)]
        title = f"Pareto front: {len(shown)} of {len(complete)} complete trials"
    what = {"label": "point", "state": "state"}
    if data.kind == "search":
        what = short_names(data.params)
    # Objectives and the scores of `ALWAYS`, validation and test side by side.
    ends = [metric.removeprefix("val/").removeprefix("test/") for metric in data.metrics]
    wanted = [f"{split}{end}" for end in (*ends, *ALWAYS) for split in ("", "val/", "test/")]
    scores = [name for name in dict.fromkeys(wanted) if name in shown and shown[name].notna().any()]
    columns = {name: name for name in (*scores, "seconds", "runs")}
    return _grid(title, shown, {"trial": "trial", **what, **columns})


def importances(data: StudyData) -> tuple[TextTable | None, str]:
    """How much the objectives depend on each parameter, by PED-ANOVA: of reaching the best tenth.

    Returns:
        shares in percent by objective, the most important parameter for the first one first, or
        None; and why there are none, or how uncertain they are.

    Source: Watanabe et al., "PED-ANOVA", IJCAI 2023, arXiv 2304.10255.
    """
    import pandas as pd
    from optuna.importance import get_param_importances

    complete = data.complete
    if data.kind != "search":
        return None, ""
    if len(complete) < MIN_TRIALS:
        return None, f"they need {MIN_TRIALS} complete trials, and there are {len(complete)}."
    varied = [name for name in data.params if complete[name].nunique() > 1]
    found = {}
    for place, metric in enumerate(data.metrics):

        def loss(trial: Any, place: int = place) -> float:  # PED-ANOVA takes less as better
            return -float(trial.values[place]) if data.maximize[place] else trial.values[place]

        if varied and complete[metric].nunique() > 1:
            with warnings.catch_warnings():  # of the sign, and of few trials: the remark says so
                warnings.simplefilter("ignore")
                found[f"for {metric}, %"] = get_param_importances(
                    data.study, params=varied, target=loss
                )
    if not found:
        return None, "no parameter, or no objective, took two values."
    shares = 100 * pd.DataFrame(found)
    shares = shares.sort_values(shares.columns[0], ascending=False)
    columns = {"index": "parameter", **{name: name for name in found}}
    rough = f"rough: {len(complete)} complete trials, {ADVISED} are recommended."
    grid = _grid("Importance of the parameters", shares.reset_index(), columns, ".2f")
    return grid, rough if len(complete) < ADVISED else ""


def _grid(
    title: str, frame: pd.DataFrame, columns: Mapping[str, str], digits: str = ""
) -> TextTable:
    """Columns of a frame under other names, as text."""
    import pandas as pd

    def text(name: str, value: object) -> str:
        if pd.isna(value):
            return ABSENT
        form = digits or {"seconds": ".0f"}.get(name, ".2f" if "/" in name else ".4g")
        return format(value, form) if isinstance(value, float) else str(value)

    rows = frame[list(columns)].itertuples(index=False, name=None)
    cells = tuple(tuple(map(text, columns, row)) for row in rows)
    return TextTable(title, tuple(columns.values()), cells)


def trials_csv(data: StudyData) -> str:
    """All trials that count, one line each, numbers in full."""
    frame = data.frame.drop(columns="key")
    return csv_text([list(frame), *frame.fillna("").to_numpy().tolist()])


def publish_study(study: optuna.Study, out: Path, url: str) -> None:
    """Print the tables of a study in the storage `url`, and write its files into `out`."""
    from rich.console import Group

    from rgbt.files.atomic import write_atomic
    from rgbt.runs.provenance import without_passwords
    from rgbt.terminal import path_lines, plain_text, print_rich, rich_table

    data = StudyData.read(study)
    important, remark = importances(data)
    grids = [*tables(data), *([important] if important else [])]
    out.mkdir(parents=True, exist_ok=True)
    way = ["highest" if up else "lowest" for up in data.maximize]
    objectives = ", ".join(f"{w} {metric}" for w, metric in zip(way, data.metrics, strict=True))
    command = without_passwords(study.user_attrs.get(names.COMMAND, ""))
    remarks = [f"Importances: {remark}"] if remark else []
    text = [
        *(f"# Study {study.study_name}", f"Kind: {data.kind}. Objectives: {objectives}."),
        *([f"Created by `{command}`."] if command else []),
        *(grid.to_markdown() for grid in grids),
        *remarks,
    ]
    write_atomic(out / "study.md", "\n\n".join([*text, ""]).encode())
    write_atomic(out / "trials.csv", trials_csv(data).encode())
    print_rich(Group(*map(rich_table, grids), plain_text("\n".join(remarks))))
    command = f"optuna-dashboard {without_passwords(url)}"
    print_rich(path_lines([("report", str(out / "study.md")), ("figures", command)]))


def study_folder(runs_dir: Path, name: str) -> Path:
    """Folder of the report of a study; characters such as / in its name are replaced."""
    safe = re.sub(r"[^\w+=.-]+", "_", name).lstrip(".")[:80]
    if safe != name:
        safe += "-" + hashlib.sha256(name.encode()).hexdigest()[:6]
    return runs_dir / "studies" / safe


entry = PlainCommand(Options, main, heeds=())

if __name__ == "__main__":
    entry()
