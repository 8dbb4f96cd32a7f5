"""Files of one measurement of ``rgbt consistency``: counts, flow records, picture, run values."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from textwrap import shorten

import numpy as np

from rgbt.assembly.session import Session
from rgbt.checks import InputError
from rgbt.dataset import LabelledDataset
from rgbt.evaluation.measure import check_replaceable, legend_of
from rgbt.evaluation.pair_frames import FlowRecord
from rgbt.evaluation.temporal_consistency import Pairs, consistency_values
from rgbt.files.atomic import write_atomic
from rgbt.metrics.counts import Counts
from rgbt.metrics.pairs import Protocol
from rgbt.runs.folder import RunFolder, read_result, read_tables
from rgbt.tables import ConsistencyTable, csv_text, without_nan
from rgbt.tracking.pair_pictures import draw_pairs


def write_pairs(
    pairs: Pairs, paths: Mapping[Protocol, Path], dataset: LabelledDataset
) -> list[tuple[str, str]]:
    """Write counts at `paths`, flow records and picture beside them; (what, path) of each.

    InputError: a file holds another measurement, which is not replaced.
    """
    new = {}
    for protocol, counts in pairs.counts.items():
        _check_same_predictions(paths[protocol], counts)
        if not check_replaceable(paths[protocol], counts.measurement):
            new[paths[protocol]] = counts
    for file, counts in new.items():
        file.parent.mkdir(parents=True, exist_ok=True)
        counts.save(file)
    lines = [(f"counts, {protocol}", str(paths[protocol])) for protocol in pairs.counts]
    # Named like the counts that it shows, those of the first protocol.
    first = paths[next(iter(pairs.counts))]
    if pairs.records:
        path = first.with_name(f"{paths['flow'].stem}.csv")
        # Unknown values are empty.
        rows = [["" if value != value else value for value in each] for each in pairs.records]
        write_atomic(path, csv_text([FlowRecord._fields, *rows]).encode())
        lines.append(("flow of each pair", str(path)))
    if pairs.kept:  # some of its images could be read
        picture = first.with_name(f"pairs_{first.stem}.png")
        draw_pairs(pairs.kept, legend_of(dataset), picture)
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
    """What a user should know of the flow of all pairs."""
    counted = [each for each in records if each.used >= least_used]
    used, error, hidden = (
        np.mean([value for each in counted if (value := getattr(each, key)) >= 0] or [np.nan])
        for key in ("used", "end_point_error_px", "hidden")
    )
    length = np.median([each.displacement_px for each in counted if each.used > 0] or [np.nan])
    yield (
        f"Flow of {len(counted)} pairs: {100 * used:.1f} % of the pixels are used (both directions "
        f"agree there); the median displacement is {length:.1f} pixels."
    )
    if left_out := [each.name for each in records if each.used < least_used]:
        yield (
            f"{len(left_out)} pairs are left out, with less than {100 * least_used:g} % used "
            f"pixels: {shorten(', '.join(left_out), 60)}"
        )
    if error >= 0:
        yield (
            f"Distance from the exact flow: {error:.2f} pixels on average; {100 * hidden:.1f} % of "
            "the used pixels are hidden in the first frame."
        )
