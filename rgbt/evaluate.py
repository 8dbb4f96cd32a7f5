"""Evaluate a stored run: ``python -m rgbt.evaluate run=runs/<key> [modality=rgb]``.

Counts are written, and the tables that follow from them are shown.
"""

from __future__ import annotations

from pathlib import Path

from rgbt.checks import check_choice
from rgbt.command import plain_command

OWN = {
    "run": None,
    "runs_dir": "runs",
    "split": "test",
    "modality": "rgbt",
    "regions": "as trained",
    "checkpoint": "best",
    "out": "",
}


def main(arguments: dict[str, str], overrides: list[str]) -> int:
    """Evaluate a run, on its own data set or another one.

    run       run folder, config key or MLflow run id
    split     split of the data set
    modality  rgbt, or rgb / thermal to decode one branch alone
    regions   a file of conf/metric: ring5, ring9, vertical5, horizontal5
    checkpoint  best (by validation mIoU) or last
    out       file of the counts; default: evaluations/ in the run folder
    overrides such as dataset=mfnet dataset.root=/data/MFNet data.eval_batch_size=1
    """
    from rgbt.engine.evaluate import MODALITIES
    from rgbt.session import evaluate, result_tables
    from rgbt.stored import find_run, open_run
    from rgbt.tracking.terminal import result_view, show

    modality = arguments["modality"]
    check_choice("modality", modality, MODALITIES)
    if arguments["regions"] != OWN["regions"]:
        overrides = [*overrides, f"metric={arguments['regions']}"]
    folder = find_run(arguments["run"], Path(arguments["runs_dir"]))
    stored = open_run(folder, overrides, arguments["checkpoint"])
    session = stored.session
    found = evaluate(session, session.model, arguments["split"], modality=modality)
    counts = found.counts
    stem = "_".join(
        [session.dataset.name, counts.split, modality, counts.partition]
        + ([] if arguments["checkpoint"] == "best" else [arguments["checkpoint"]])
    )
    path = Path(arguments["out"] or folder / "evaluations" / f"{stem}.npz")
    path.parent.mkdir(parents=True, exist_ok=True)
    counts.save(path)
    label = f"{session.config.name} {session.dataset.name} {modality}"
    tables = result_tables(counts, session.regions, label, stored.step)
    show(result_view(tables, folder, [("counts", str(path))]))
    return 0


if __name__ == "__main__":
    plain_command(OWN, main)()
