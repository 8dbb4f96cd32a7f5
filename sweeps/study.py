"""Report of a search: ``rgbt study name=search/grbm``, also while it runs.

Tables in the terminal; ``runs/studies/<name>/`` gets them as Markdown and CSV. `optuna-dashboard`
draws it.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
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

# Complete trials below which importances would be noise: PED-ANOVA looks at the best tenth.
MIN_TRIALS = 10

# Rows of the table of best trials; the CSV has all.
TOP = 10

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


@dataclass(frozen=True)
class StudyData:
    """A study at one moment.

    Attributes:
        metrics: names of the objectives, and whether more is better.
        params: names of the parameters.
        frame: trials that count, one a row: trial (its number), state, label, the parameters, the
            scores in percent, objectives first, seconds, last_step, runs, reason. NaN: it has none.
    """

    study: optuna.Study
    metrics: Mapping[str, bool]
    params: Sequence[str]
    frame: pd.DataFrame

    @classmethod
    def read(cls, study: optuna.Study) -> StudyData:
        """Read a study."""
        import pandas as pd

        from rgbt.config.compose import with_pixels

        ways = [direction.name == "MAXIMIZE" for direction in study.directions]
        metrics = study.metric_names or [f"objective {n + 1}" for n in range(len(ways))]
        params, scores, rows = dict[str, None](), dict.fromkeys(metrics), []
        for trial in study.get_trials(deepcopy=False):
            notes, values = trial.user_attrs, zip(metrics, trial.values or (), strict=False)
            found = {**notes.get(names.RESULTS, {}), **dict(values)}
            factor = notes.get(names.PIXELS, 1.0)
            chosen = {
                name: with_pixels(value, factor) if isinstance(value, str) else value
                for name, value in trial.params.items()
            }
            params, scores = params | dict.fromkeys(chosen), scores | dict.fromkeys(found)
            of_trial = {
                "trial": trial.number,
                "state": WORDS[trial.state.name],
                **chosen,
                **found,
                "label": notes.get(names.LABEL, f"#{trial.number}"),
                "seconds": notes.get(names.SECONDS),
                "last_step": trial.last_step,
                "runs": " ".join(notes.get(names.RUNS, ())) or None,
                "reason": " ".join(notes.get(names.REASON, "").split()) or None,
            }
            rows.append({name: v for name, v in of_trial.items() if v is not None})
        columns = ["trial", "state", "label", *params, *scores, "seconds", "last_step", "runs"]
        frame = pd.DataFrame(rows, columns=[*columns, "reason"], dtype=object)
        return cls(study, dict(zip(metrics, ways, strict=True)), list(params), frame)

    def of_state(self, state: str) -> pd.DataFrame:
        """The trials that are in a state."""
        return self.frame[self.frame["state"] == state]


def tables(data: StudyData) -> list[TextTable]:
    """Trials by state, the most important trials, the failed ones; empty tables are left out."""
    counts = data.frame["state"].value_counts()
    row = (str(len(data.frame)), *(str(counts.get(word, 0)) for word in WORDS.values()))
    title = f"Study {data.study.study_name}"
    failed = data.of_state("failed")
    failed = failed.assign(reason=failed["reason"].map(one_line))
    found = [
        TextTable(title, ("trials", *WORDS.values()), (row,)),
        trials_grid(data),
        _grid("Failed trials", failed, dict.fromkeys(("reason", "trial", "label", "runs"))),
    ]
    return [grid for grid in found if grid.rows]


def trials_grid(data: StudyData) -> TextTable:
    """The best `TOP` trials by the objective, or the Pareto front of several objectives."""
    from sweeps.point import short_names

    complete, (metric, is_up) = data.of_state("complete"), next(iter(data.metrics.items()))
    best = complete.sort_values(metric, ascending=not is_up, kind="stable")
    if len(data.metrics) == 1:
        way = "highest" if is_up else "lowest"
        title, shown = f"Best trials: {way} {metric}", best.head(TOP)
    else:
        front = [trial.number for trial in data.study.best_trials]
        shown = best[best["trial"].isin(front)]
        title = f"Pareto front: {len(shown)} of {len(complete)} complete trials"
    what = short_names(data.params)
    # Objectives and the scores of `ALWAYS`, validation and test side by side.
    ends = [metric.removeprefix("val/").removeprefix("test/") for metric in data.metrics]
    wanted = [f"{split}{end}" for end in (*ends, *ALWAYS) for split in ("", "val/", "test/")]
    scores = [name for name in dict.fromkeys(wanted) if name in shown and shown[name].notna().any()]
    return _grid(
        title, shown, {"trial": None, **what, **dict.fromkeys((*scores, "seconds", "runs"))}
    )


def importances(data: StudyData) -> tuple[TextTable | None, str]:
    """How much the objectives depend on each parameter, by PED-ANOVA: of reaching the best tenth.

    Returns:
        shares in percent by objective, the most important parameter for the first one first; or
        None, and why.

    Source: Watanabe et al., "PED-ANOVA", IJCAI 2023, arXiv 2304.10255.
    """
    import pandas as pd
    from optuna.importance import get_param_importances

    complete = data.of_state("complete")
    if len(complete) < MIN_TRIALS:
        return None, f"they need {MIN_TRIALS} complete trials, and there are {len(complete)}."
    varied = [name for name in data.params if complete[name].nunique() > 1]
    found = {}
    for place, (metric, is_up) in enumerate(data.metrics.items()):

        def loss(trial: Any, place: int = place, is_up: bool = is_up) -> float:  # less is better
            return float(-trial.values[place] if is_up else trial.values[place])

        if varied and complete[metric].nunique() > 1:
            with warnings.catch_warnings():  # about the sign, and about few trials
                warnings.simplefilter("ignore")
                found[metric] = get_param_importances(data.study, params=varied, target=loss)
    if not found:
        return None, "no parameter, or no objective, took two values."
    shares = (100 * pd.DataFrame(found)).map("{:.2f}".format).reset_index()
    order = shares.sort_values(next(iter(found)), key=pd.to_numeric, ascending=False)
    columns = {"index": "parameter", **{name: f"for {name}, %" for name in found}}
    return _grid("Importance of the parameters", order, columns), ""


def _grid(title: str, frame: pd.DataFrame, columns: Mapping[str, str | None]) -> TextTable:
    """Columns of a frame, some under other names, as text."""
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

    data = StudyData.read(study)
    important, remark = importances(data)
    grids = [*tables(data), *([important] if important else [])]
    out.mkdir(parents=True, exist_ok=True)
    ways = (f"{'highest' if up else 'lowest'} {metric}" for metric, up in data.metrics.items())
    command = without_passwords(study.user_attrs.get(names.COMMAND, ""))
    remarks = [f"Importances: {remark}"] if remark else []
    text = [
        f"# Study {study.study_name}",
        f"Objectives: {', '.join(ways)}.",
        *([f"Created by `{command}`."] if command else []),
        *(grid.to_markdown() for grid in grids),
        *remarks,
    ]
    write_atomic(out / "study.md", "\n\n".join([*text, ""]).encode())
    every = data.frame.to_csv(index=False)
    write_atomic(out / "trials.csv", every.encode())
    print_rich(Group(*map(rich_table, grids), plain_text("\n".join(remarks))))
    lines = [("report", str(out / "study.md"))]
    if find_spec("optuna_dashboard"):
        lines.append(("figures", f"optuna-dashboard {without_passwords(url)}"))
    print_rich(path_lines(lines))


entry = PlainCommand(Options, main, heeds=())

if __name__ == "__main__":
    entry()
