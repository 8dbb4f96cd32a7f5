"""Report of a search: ``rgbt study name=search/grbm``, also while it runs.

Tables in the terminal; ``runs/studies/<name>/`` gets them as Markdown and CSV. `optuna-dashboard`
draws it.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from rgbt.checks import InputError, nearest, one_line
from rgbt.config.common_options import RunsDir
from rgbt.config.options import Help
from rgbt.config.plain_command import PlainCommand
from rgbt.metrics import names as metric_names
from rgbt.tables import ABSENT, TextTable
from sweeps import attributes as names

if TYPE_CHECKING:
    import optuna
    import pandas as pd

# Optuna's states as shown.
WORDS = {"COMPLETE": "complete", "PRUNED": "pruned", "FAIL": "failed"}
WORDS |= {"RUNNING": "unfinished", "WAITING": "waiting"}

# First columns of the frame of trials.
OF_TRIAL = ("trial", "state", "label")

# Complete trials below which importances would be noise: PED-ANOVA looks at the best tenth.
MIN_TRIALS = 10

TOP = 10  # rows of the table of best trials; the CSV has all

# Scores that are shown also where they are no objective.
ALWAYS = (metric_names.MIOU, metric_names.VAR)


@dataclass(frozen=True)
class Options:
    """Options of ``rgbt study``."""

    name: Annotated[str, Help("name of the study; without a name, all studies are listed")] = ""
    storage: Annotated[str, Help("address of Optuna's storage; default: the study's folder")] = ""
    runs_dir: RunsDir = Path("runs")
    out: Annotated[Path | None, Help("folder of the report; default: studies/<name>")] = None


def main(options: Options, overrides: list[str]) -> int:
    """Show the results of a search: best trials, failures, importances."""
    del overrides  # none is heeded
    from sweeps.run.optuna_study import known_studies, storage_url, study_folder

    known = known_studies(options.storage, options.runs_dir)
    where = options.storage or options.runs_dir / "studies"
    if not known:
        raise InputError(f"there is no search in {where}.")
    if options.name not in known:
        raise InputError(f"name={options.name}: not in {where}; {nearest(options.name, known)}.")
    url = storage_url(options.storage, options.runs_dir, options.name)
    out = options.out or study_folder(options.runs_dir, options.name)
    publish_study(known[options.name], out, url)
    return 0


def objectives(study: optuna.Study) -> dict[str, bool]:
    """Return the names of the objectives, and whether more is better."""
    ways = [direction.name == "MAXIMIZE" for direction in study.directions]
    metrics = study.metric_names or [f"objective {n + 1}" for n in range(len(ways))]
    return dict(zip(metrics, ways, strict=True))


def parameters(study: optuna.Study, trials: pd.DataFrame) -> list[str]:
    """Return the names of the parameters: columns between those of every trial and the scores."""
    columns = list(trials.columns)
    return columns[len(OF_TRIAL) : columns.index(next(iter(objectives(study))))]


def trials_frame(study: optuna.Study) -> pd.DataFrame:
    """Read the trials of a study at one moment, one a row.

    Returns:
        columns: trial (its number), state, label, the parameters, the scores in percent, objectives
        first, seconds, last_step, runs, reason. NaN: the trial has none.
    """
    import pandas as pd

    from rgbt.config.compose import with_pixels

    metrics = objectives(study)
    params: dict[str, None] = {}
    scores: dict[str, Any] = dict.fromkeys(metrics)
    rows = []
    for trial in study.get_trials(deepcopy=False):
        notes = trial.user_attrs
        factor = notes.get(names.PIXELS, 1.0)
        row: dict[str, Any] = {"trial": trial.number, "state": WORDS[trial.state.name]}
        for name, value in trial.params.items():
            row[name] = with_pixels(value, factor) if isinstance(value, str) else value
        values = zip(metrics, trial.values or (), strict=False)
        found = {**notes.get(names.RESULTS, {}), **dict(values)}
        params |= dict.fromkeys(trial.params)
        scores |= found
        row |= {
            **found,
            "label": notes.get(names.LABEL, f"#{trial.number}"),
            "seconds": notes.get(names.SECONDS),
            "last_step": trial.last_step,
            "runs": " ".join(notes.get(names.RUNS, ())) or None,
            "reason": " ".join(notes.get(names.REASON, "").split()) or None,
        }
        rows.append({name: value for name, value in row.items() if value is not None})
    columns = [*OF_TRIAL, *params, *scores, "seconds", "last_step", "runs", "reason"]
    return pd.DataFrame(rows, columns=columns, dtype=object)


def tables(study: optuna.Study, trials: pd.DataFrame) -> list[TextTable]:
    """Show trials by state, the best ones and the failed ones; empty tables are left out."""
    counts = trials["state"].value_counts()
    row = (str(len(trials)), *(str(counts.get(word, 0)) for word in WORDS.values()))
    failed = trials[trials["state"] == "failed"]
    failed = failed.assign(reason=failed["reason"].map(one_line))
    found = [
        TextTable(f"Study {study.study_name}", ("trials", *WORDS.values()), (row,)),
        trials_grid(study, trials),
        _grid("Failed trials", failed, dict.fromkeys(("reason", "trial", "label", "runs"))),
    ]
    return [grid for grid in found if grid.rows]


def trials_grid(study: optuna.Study, trials: pd.DataFrame) -> TextTable:
    """Show the best `TOP` trials by the objective, or the Pareto front of several objectives."""
    from sweeps.point import short_names

    metrics = objectives(study)
    metric, is_up = next(iter(metrics.items()))
    complete = trials[trials["state"] == "complete"]
    best = complete.sort_values(metric, ascending=not is_up, kind="stable")
    if len(metrics) == 1:
        way = "highest" if is_up else "lowest"
        title, shown = f"Best trials: {way} {metric}", best.head(TOP)
    else:
        front = [trial.number for trial in study.best_trials]
        shown = best[best["trial"].isin(front)]
        title = f"Pareto front: {len(shown)} of {len(complete)} complete trials"
    columns: dict[str, str | None] = {"trial": None, **short_names(parameters(study, trials))}
    # Objectives and the scores of `ALWAYS`, validation and test side by side.
    ends = [metric.removeprefix("val/").removeprefix("test/") for metric in metrics]
    for end in (*ends, *ALWAYS):
        for name in (end, f"val/{end}", f"test/{end}"):
            if name in shown and shown[name].notna().any():
                columns[name] = None
    return _grid(title, shown, columns | {"seconds": None, "runs": None})


def importances(study: optuna.Study, trials: pd.DataFrame) -> tuple[TextTable | None, str]:
    """Compute how much parameters matter for a trial to be in the best tenth, by PED-ANOVA.

    Returns:
        shares in percent by objective, the most important parameter for the first one first; or
        None, and why.

    Source: Watanabe et al., "PED-ANOVA", IJCAI 2023, arXiv 2304.10255.
    """
    import pandas as pd
    from optuna.importance import get_param_importances

    complete = trials[trials["state"] == "complete"]
    if len(complete) < MIN_TRIALS:
        return None, f"they need {MIN_TRIALS} complete trials, and there are {len(complete)}."
    varied = [name for name in parameters(study, trials) if complete[name].nunique() > 1]
    found = {}
    for place, (metric, is_up) in enumerate(objectives(study).items()):

        def loss(trial: Any, place: int = place, is_up: bool = is_up) -> float:  # less is better
            return float(-trial.values[place] if is_up else trial.values[place])

        if varied and complete[metric].nunique() > 1:
            with warnings.catch_warnings():  # about the sign, and about few trials
                warnings.simplefilter("ignore")
                found[metric] = get_param_importances(study, params=varied, target=loss)
    if not found:
        return None, "no parameter, or no objective, took two values."
    shares = (100 * pd.DataFrame(found)).map("{:.2f}".format).reset_index()
    order = shares.sort_values(next(iter(found)), key=pd.to_numeric, ascending=False)
    columns = {"index": "parameter", **{name: f"for {name}, %" for name in found}}
    return _grid("Importance of the parameters", order, columns), ""


def _grid(title: str, frame: pd.DataFrame, columns: Mapping[str, str | None]) -> TextTable:
    import pandas as pd

    def text(name: str, value: object) -> str:
        form = {"seconds": ".0f"}.get(name, ".2f" if "/" in name else ".4g")
        shown = format(value, form) if isinstance(value, float) else str(value)
        return ABSENT if pd.isna(value) else shown

    rows = frame[list(columns)].itertuples(index=False, name=None)
    cells = tuple(tuple(map(text, columns, row)) for row in rows)
    return TextTable(title, tuple(new or old for old, new in columns.items()), cells)


def publish_study(study: optuna.Study, out: Path, url: str) -> None:
    """Print the tables of a study in the storage `url`, and write its files into `out`."""
    from rich.console import Group

    from rgbt.files.atomic import write_atomic
    from rgbt.runs.provenance import without_passwords
    from rgbt.terminal import path_lines, plain_text, print_rich, rich_table

    trials = trials_frame(study)
    grids = tables(study, trials)
    important, remark = importances(study, trials)
    grids += [important] if important else []
    out.mkdir(parents=True, exist_ok=True)
    ways = [f"{'highest' if up else 'lowest'} {name}" for name, up in objectives(study).items()]
    text = [f"# Study {study.study_name}", f"Objectives: {', '.join(ways)}."]
    if command := without_passwords(study.user_attrs.get(names.COMMAND, "")):
        text.append(f"Created by `{command}`.")
    text += [grid.to_markdown() for grid in grids]
    said = f"Importances: {remark}" if remark else ""
    text += [said] if said else []
    write_atomic(out / "study.md", "\n\n".join([*text, ""]).encode())
    write_atomic(out / "trials.csv", trials.to_csv(index=False).encode())
    print_rich(Group(*map(rich_table, grids), plain_text(said)))
    lines = [("report", str(out / "study.md"))]
    if find_spec("optuna_dashboard"):
        lines.append(("figures", f"optuna-dashboard {without_passwords(url)}"))
    print_rich(path_lines(lines))


entry = PlainCommand(Options, main, heeds=())

if __name__ == "__main__":
    entry()
