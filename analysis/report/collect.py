"""The page's data, read once from the store: runs, tables, studies, masks, differences."""

from __future__ import annotations

import tempfile
from collections.abc import Collection, Sequence
from datetime import UTC, datetime
from pathlib import Path

from analysis.report.contrasts import contrast_entries
from analysis.report.data import ReportData
from analysis.report.differences import difference_entries
from analysis.report.masks import mask_pictures
from analysis.report.results_file import load_results_file
from analysis.report.runs import ReportRun, open_run
from analysis.report.store import MlflowRun, read_store
from analysis.report.studies import study_entries
from analysis.report.tables import Track, table_entries
from rgbt.runs.folder import REPLACED_TAG
from rgbt.runs.provenance import without_passwords
from rgbt.tracking.mlflow_store import MlflowTracking
from rgbt.tracking.tracker import Tracking

TITLE = "RGB-thermal segmentation: runs and tables"


def collect(
    tracking: Tracking,
    runs_dir: Path,
    resamples: int,
    command: str,
    trust: Collection[str],
    track: Track,
) -> ReportData:
    """Read the store; what cannot be read becomes a remark.

    Args:
        tracking: names the store.
        runs_dir: folder of runs; their files are read there where it has them.
        resamples: of the images, for intervals and p-values.
        command: that makes the page again, without passwords.
        trust: modules of which the report may build maskers and data sets.
        track: shows how far it is.

    Raises:
        InputError: there is no store, or no such experiment.
        RunError: the store cannot be reached.
    """
    remarks: list[str] = []
    # Files of a server's store are copied there, and gone with it: counts are read by then.
    with tempfile.TemporaryDirectory(prefix="rgbt_report_") as copies:
        stored = [
            each
            for one in track([tracking], "store")
            for each in read_store(one, runs_dir, Path(copies))
            if REPLACED_TAG not in each.tags
        ]
        runs = _open_all(stored, track, remarks)
        by_key = {run.entry.key: run for run in runs}
        records = {kind: [r for r in stored if r.kind == kind] for kind in ("table", "study")}
        tables = table_entries(records["table"], by_key, resamples, track, remarks)
        studies = study_entries(records["study"], remarks)
        masks = mask_pictures(runs, track, remarks, trust)
        differences = difference_entries(runs, resamples, track)
        contrasts = contrast_entries(load_results_file().contrasts, runs, resamples, track)
    assert isinstance(tracking, MlflowTracking), "read_store refuses others"
    if not runs:
        remarks.insert(0, "The store holds no runs yet; tables show what the papers printed.")
    return ReportData(
        title=TITLE,
        made=datetime.now(UTC).isoformat(timespec="seconds"),
        store=without_passwords(tracking.uri),
        command=command,
        runs=tuple(run.entry for run in runs),
        tables=tables,
        studies=studies,
        masks=masks,
        differences=differences,
        remarks=tuple(remarks),
        contrasts=contrasts,
    )


def _open_all(stored: Sequence[MlflowRun], track: Track, remarks: list[str]) -> list[ReportRun]:
    """The runs, newest first; one that the store has twice is taken once."""
    runs: dict[str, ReportRun] = {}
    for each in track([one for one in stored if one.kind == "run"], "runs"):
        key = each.tags.get("rgbt.key", each.run_id)
        known = runs.get(key)
        # Of two the newer one is opened first; a finished one is worth more.
        if known is not None:
            remarks.append(
                f"Run {key} is in the store twice ({known.entry.run_id[:8]}, {each.run_id[:8]}); "
                "one of them is shown, finished before unfinished, newer before older."
            )
        if known is None or (each.status == "FINISHED" and known.entry.status != "FINISHED"):
            runs[key] = open_run(each, remarks)
    return list(runs.values())
