"""Write the files of ``rgbt consistency``: counts, flow records, picture, values of the run."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from textwrap import shorten

import numpy as np

from rgbt.assembly.session import Session
from rgbt.checks import InputError
from rgbt.dataset import LabelledDataset
from rgbt.evaluation.measure import check_replaceable
from rgbt.evaluation.pairs.count import CountedPairs, consistency_values
from rgbt.evaluation.pairs.scenes import FlowRecord
from rgbt.files.atomic import write_atomic
from rgbt.metrics.counts import Counts
from rgbt.runs.folder import RunFolder, read_result, read_tables
from rgbt.tables import ConsistencyTable, csv_text, without_nan
from rgbt.tracking.pair_pictures import draw_pairs


def write_pairs(
    pairs: CountedPairs, folder: Path, dataset: LabelledDataset
) -> list[tuple[str, str]]:
    """Write counts, flow records and a picture into `folder`; return (what, path) of every file.

    InputError: a file holds another measurement, which is not replaced.
    """
    new, lines = {}, []
    for protocol, counts in pairs.counts.items():
        file = folder / counts.measurement.file_name
        _check_same_predictions(file, counts)
        if not check_replaceable(file, counts.measurement):
            new[file] = counts
        lines.append((f"counts, {protocol}", str(file)))
    folder.mkdir(parents=True, exist_ok=True)
    for file, counts in new.items():
        counts.save(file)
    # Named like the counts that it shows, those of the first protocol.
    first = Path(lines[0][1])
    if pairs.records:
        path = folder / Path(pairs.counts["flow"].measurement.file_name).with_suffix(".csv")
        # Unknown values are empty.
        rows = []
        for record in pairs.records:
            rows.append(["" if value != value else value for value in record])
        write_atomic(path, csv_text([FlowRecord._fields, *rows]).encode())
        lines.append(("flow of each pair", str(path)))
    if pairs.kept:  # some of its images could be read
        picture = folder / f"pairs_{first.stem}.png"
        draw_pairs(pairs.kept, dataset, picture)
        lines.append(("picture", str(picture)))
    return lines


def _check_same_predictions(path: Path, counts: Counts) -> None:
    """InputError: the file holds counts of other predictions, of which no network is known."""
    of = counts.measurement
    if of.run or of.weights or not path.exists():
        return
    if not np.array_equal(Counts.load(path).counts, counts.counts):
        raise InputError(f"{path} holds counts of other predictions; remove it, or set out=...")


def add_to_result(run: RunFolder, session: Session, split: str, table: ConsistencyTable) -> None:
    """Add the measurement to the result and the tables of `run`, as if made by it."""
    result, tables = read_result(run.path), read_tables(run.path)
    kind = {session.trainer.selection_split: "val", "test": "test"}.get(split)
    if result is None or tables is None or kind not in result or session.consistency.mark:
        return
    result[kind] = {**result[kind], **without_nan(consistency_values(table))}
    if kind == "test":
        run.write_tables(replace(tables, consistency=table))
    run.finish(result)


def flow_sentences(records: Sequence[FlowRecord], least_used: float) -> Iterator[str]:
    """Say what a user should know of the flow of all pairs."""
    counted = [record for record in records if record.used >= least_used]
    used = _mean([record.used for record in counted])
    error = _mean([record.end_point_error_px for record in counted])
    hidden = _mean([record.hidden for record in counted])
    lengths = [record.displacement_px for record in counted if record.used > 0]
    length = np.median(lengths or [np.nan])
    yield (
        f"Flow of {len(counted)} pairs: {100 * used:.1f} % of the pixels are used (both directions "
        f"agree there); the median displacement is {length:.1f} pixels."
    )
    if left_out := [record.name for record in records if record.used < least_used]:
        yield (
            f"{len(left_out)} pairs are left out, with less than {100 * least_used:g} % used "
            f"pixels: {shorten(', '.join(left_out), 60)}"
        )
    if error >= 0:
        yield (
            f"Distance from the exact flow: {error:.2f} pixels on average; {100 * hidden:.1f} % of "
            "the used pixels are hidden in the first frame."
        )


def _mean(values: Sequence[float]) -> float:
    """The mean of the known values; NaN without any."""
    known = [value for value in values if value >= 0]
    return float(np.mean(known or [np.nan]))
