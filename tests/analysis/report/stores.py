"""A small folder of runs with its MLflow store: methods whose scores can be recomputed by hand."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import optuna
import yaml
from optuna.distributions import FloatDistribution
from optuna.trial import create_trial

from analysis.report.store import RunFiles
from rgbt.metrics.counts import Counts
from rgbt.metrics.scores import summary
from rgbt.randomness import numpy_generator
from rgbt.runs.folder import Description, RunFolder, counts_name
from rgbt.tracking.mlflow_store import MlflowTracking
from sweeps import attributes
from sweeps.evaluation import ExtraEvaluation
from sweeps.rendering.claims import claims_markdown
from sweeps.rendering.file_formats import tidy_csv
from sweeps.report.publish import markdown
from sweeps.report.records import record
from sweeps.report.study_data import read
from sweeps.report.tables import trials_csv
from sweeps.table.cells import score
from sweeps.table.load_table import load_table
from sweeps.verdicts.judge import TableJudge
from tests.sweeps.tabled import outcome

IMAGES, REGIONS, CLASSES = 12, 2, ("road", "car")
RGB = ExtraEvaluation("rgb", "as trained")
RGB_FILE = "evaluations/table_rgb_as-trained.npz"
TABLE = """
paper: own
number: TABLE I
caption: Two masks
data: somewhere
columns:
  - {name: mIoU, metric: mIoU}
  - {name: Var, metric: Var, best: lowest}
  - {name: rgb, metric: mIoU, modality: rgb}
  - {name: drop, minus: [rgb, mIoU], best: none}
  - {name: size, efficiency: parameters}
remarks: [A remark of the table.]
forms: {paper: As the text describes it.}
claims:
  - {name: b_is_better, says: B is better than A., source: "Sec. 1", rows: [B], against: [A],
     columns: [mIoU], expected: higher}
  - {name: a_is_better, says: A is better than B., source: "Sec. 2", rows: [A], against: [B],
     columns: [mIoU], expected: higher, remarks: [A reading of ours.]}
  - {name: both_are_alike, says: Without RGB they are alike., source: "Sec. 3", rows: [B],
     against: [A], columns: [Var], expected: lower, at_least: 1.0}
  - {name: c_is_worse, says: C is worse than A., source: "Sec. 4", rows: [C], against: [A],
     columns: [mIoU], expected: lower}
rows:
  - {label: A, experiment: grbm, values: {mIoU: 61.0, Var: 9.0}}
  - {label: B, experiment: crm, proposed: true, values: {mIoU: 60.0, Var: 12.0}, remarks: [Odd.]}
  - {label: C, values: {mIoU: 50.0}}
"""
MASKER = {
    "_target_": "rgbt.maskers.masker.Masker",
    "sampler": "gaussian_bernoulli",
    "patch_size": 32,
    "ratio": None,
    "sigma_div": 4.0,
    "sigma_height": None,
    "anchor": "grid",
    "cell_position": "index",
    "pairing": "rand_comp",
    "pattern_probabilities": None,
}
DATASET = {
    "_target_": "rgbt.synth.datasets.synth",
    **{"num_train": 1, "num_val": 1, "num_test": 1, "height": 64, "width": 96},
}


def counts_of(seed: int, right: float = 0.7) -> Counts:
    """Twelve images of two regions and two classes with `right` of the pixels right, about."""
    labelled = numpy_generator(0, "labels").integers(150, 250, (IMAGES, REGIONS, 2))
    found = numpy_generator(seed, "report", round(100 * right)).binomial(labelled, right)
    counts = np.stack([found, labelled - found], -1)
    counts[..., 1, :] = counts[..., 1, ::-1]
    return Counts(
        counts=counts.astype(np.int64),
        names=tuple(f"{7 * index:05d}D" for index in range(IMAGES)),
        night=None,
        classes=CLASSES,
        partition="ring2",
        dataset="fingerprint",
        split="test",
    )


def config_of(seed: int, **changed: Any) -> dict[str, Any]:
    """A configuration as far as the report reads it."""
    return {
        "seed": seed,
        "name": "grbm",
        "runs_dir": "/elsewhere",
        "masker": {**MASKER, **changed.pop("masker", {})},
        "dataset": DATASET,
        "schedule": {"per": "iteration", **changed.pop("schedule", {})},
        "metric": {"absent": "released"},
        "tracking": {"uri": "postgresql://me:secret@host/db"},
        **changed,
    }


def write_run(
    runs_dir: Path, key: str, group: str, seed: int, right: float = 0.7, **changed: Any
) -> RunFolder:
    """What a finished run leaves in its folder."""
    run = RunFolder(runs_dir / key)
    experiment, _, words = group.partition(" ")
    tags = {
        "rgbt.key": key,
        "rgbt.experiment": experiment,
        "rgbt.group": group,
        "rgbt.seed": str(seed),
        "rgbt.table/own/t": "A" if experiment == "grbm" else "B",
        "rgbt.study/search/two": str(seed),
    }
    run.describe(Description(f"{group} seed={seed}", tags, {"masker.sigma_div": "4.0"}))
    run.write_config(yaml.safe_dump(config_of(seed, **changed)))
    command = f"/opt/venv/bin/python -m rgbt.run +experiment={experiment} {words} seed={seed}"
    run.add_provenance(
        {
            "started": f"2026-01-0{seed + 1}T00:00:00+00:00",
            "command": f"{command} runs_dir={runs_dir} tracking.uri=postgresql://me:***@host/db",
            "git_commit": "0123456789abcdef",
            "git_dirty": seed == 1,
            **{"host": "desk", "cpu": "EPYC", "cpu_usable": 2, "gpus": []},
        }
    )
    counts = counts_of(seed, right)
    counts.save(run.path / counts_name("test"))
    (run.path / "evaluations").mkdir(exist_ok=True)
    counts_of(seed, right - 0.2).save(run.path / RGB_FILE)
    scores = summary(counts, "released")
    run.append(10, "test", scores)
    run.finish({"name": group, "key": key, "dataset": "fingerprint", "test": scores})
    return run


METHODS = {"grbm scale=paper": ("aa", 0.7), "crm scale=paper": ("bb", 0.8)}


def keys_of(group: str) -> list[str]:
    return [f"{METHODS[group][0]}{seed}" for seed in range(3)]


def fill_store(runs_dir: Path, tracking: MlflowTracking) -> None:
    """Two methods of three seeds, a pair of a released schedule, a table and a search."""
    for group, (_, right) in METHODS.items():
        for seed, key in enumerate(keys_of(group)):
            loss = {"alpha": right}  # methods differ by more than their name
            run = write_run(runs_dir, key, group, seed, right, loss=loss)
            tracking.sync(run, "FINISHED")
    for seed in range(2):
        run = write_run(
            *(runs_dir, f"cc{seed}", "grbm schedule=x", seed, 0.9),
            loss={"alpha": 0.7},
            schedule={"per": "epoch"},
        )
        tracking.sync(run, "FINISHED")
    record_table(runs_dir, tracking)
    record_search(runs_dir, tracking)


def record_table(runs_dir: Path, tracking: MlflowTracking) -> None:
    """The table own/t of the current folder, as `sweeps.reproduce` records it."""
    runs = {
        (label, seed): outcome(
            key, {None: counts_of(seed, right), RGB: counts_of(seed, right - 0.2)}
        )
        for label, group in (("A", "grbm scale=paper"), ("B", "crm scale=paper"))
        for right in [METHODS[group][1]]
        for seed, key in enumerate(keys_of(group))
    }
    scored = score("own/t", load_table("own/t"), runs, scale="paper")
    (runs_dir / "table.csv").write_text(tidy_csv(scored))
    judge = TableJudge("own/t", scored.table)
    said = [
        "**own, TABLE I: Two masks**\n\n| | mIoU |\n| --- | ---: |\n",
        "- Every row of ours was run with trainer.max_steps=9.\n- Bold: best.\n",
        claims_markdown(judge.claims(runs)),
    ]
    (runs_dir / "table.md").write_text("\n".join(said))
    record(
        tracking,
        name="own/t paper",
        kind="table",
        files=[runs_dir / "table.csv", runs_dir / "table.md"],
        metrics={"claims/holds": 1.0},
        tags={"rgbt.table": "own/t", "rgbt.scale": "paper", "rgbt.seeds": "0, 1, 2"},
        note="",
    )


def two_objectives() -> optuna.Study:
    """Four trials: (50, 9) and (52, 12) are the front, (49, 10) is beaten, one failed."""
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    study = optuna.create_study(study_name="search/two", directions=["maximize", "minimize"])
    study.set_user_attr(attributes.KIND, "search")
    study.set_user_attr(attributes.METRICS, ["val/mIoU", "val/Var"])
    study.set_user_attr(attributes.COMMAND, "python -m rgbt.run -m storage=postgresql://u:pw@h/db")
    for number, values in enumerate([(50.0, 9.0), (49.0, 10.0), (52.0, 12.0), None]):
        study.add_trial(
            create_trial(
                state=optuna.trial.TrialState.COMPLETE if values else optuna.trial.TrialState.FAIL,
                values=values,
                params={"masker.alpha": number / 4},
                distributions={"masker.alpha": FloatDistribution(0, 1)},
                user_attrs={
                    attributes.RUNS: [f"aa{number}"],
                    **({} if values else {attributes.REASON: "disk full"}),
                },
            )
        )
    return study


def record_search(runs_dir: Path, tracking: MlflowTracking) -> None:
    data = read(two_objectives())
    (runs_dir / "trials.csv").write_text(trials_csv(data))
    figures = "\n## Objectives by trial\n\n![Objectives by trial](history.png)\n"
    (runs_dir / "study.md").write_text(markdown(data, [], ["A remark."]) + figures)
    record(
        tracking,
        name="study search/two",
        kind="study",
        files=[runs_dir / "trials.csv", runs_dir / "study.md"],
        metrics={},
        tags={"rgbt.study": "search/two", "rgbt.study.kind": "search"},
        note="",
    )


def files_of(folder: Path, **texts: str) -> RunFiles:
    """RunFiles in a folder: dots of the names are written as two underscores."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in texts.items():
        (folder / name.replace("__", ".")).write_text(text)
    return RunFiles((folder,))
