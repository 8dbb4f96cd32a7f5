"""Write the results of one measurement of ``rgbt.consistency``: counts, picture, run values."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from rgbt.build.load_run import TrainedNetwork
from rgbt.build.session import Session
from rgbt.checks import InputError
from rgbt.dataset import LabelledDataset
from rgbt.evaluation.flow_record import write_records
from rgbt.evaluation.pairing import Pairing
from rgbt.evaluation.request import EvaluationRequest, NetworkRequest, other_images
from rgbt.evaluation.segmentation import legend_of
from rgbt.evaluation.temporal_consistency import Pairs, consistency_values
from rgbt.metrics.counts import Counts
from rgbt.metrics.pairs import Protocol, file_name
from rgbt.tracking.mlflow_upload import read_upload_state
from rgbt.tracking.pair_pictures import draw_pairs
from rgbt.tracking.run_files import read_marker, read_result, read_tables
from rgbt.tracking.run_folder import RunFolder
from rgbt.tracking.sync import Options as SyncOptions
from rgbt.tracking.sync import status_of, tracking_of
from rgbt.tracking.tables import ConsistencyTable, without_nan
from rgbt.tracking.terminal import info


class PairFiles:
    """The files of counts of pairs of one split, in the folder `out` or that of the network.

    Attributes:
        suffixes: suffixes of their names; (): they are the run's own measurement.

    Raises:
        InputError: counts on second frames of another motion would be replaced.
    """

    def __init__(
        self,
        opened: TrainedNetwork,
        network: NetworkRequest,
        request: EvaluationRequest,
        pairing: Pairing,
        out: Path | None,
    ) -> None:
        self.suffixes = (*([request.view] if request.view else []), *network.suffixes)
        self._session, self._split, self._pairing = opened.session, request.split, pairing
        self._folder = out or opened.folder
        if pairing.frames != "next":
            marker = None if out else read_marker(opened.folder.parent)
            self.suffixes += other_images(opened.session.dataset, marker)
            return
        path = self.path("next")
        partition = pairing.partition(opened.session, "next")(1)
        if path.is_file() and Counts.load(path).partition != partition:
            raise InputError(
                f"{path} holds counts for second frames of another motion. Choose another folder "
                "with out=..., or remove that file."
            )

    def path(self, protocol: Protocol) -> Path:
        """File of counts; those along an exact flow have one name, whatever the motion."""
        views = self._pairing.file_mark(self._session, protocol)
        usual = Path(file_name(protocol, self._split, views))
        return self._folder / usual.with_stem("_".join([usual.stem, *self.suffixes])).name

    def write(self, pairs: Pairs) -> list[tuple[str, str]]:
        """Write counts and picture; (what, path) of each."""
        paths = {protocol: self.path(protocol) for protocol in pairs.counts}
        return write_pairs(pairs, paths, self._session.dataset)


def write_pairs(
    pairs: Pairs, paths: Mapping[Protocol, Path], dataset: LabelledDataset
) -> list[tuple[str, str]]:
    """Write counts and picture; (what, path) of each.

    Args:
        pairs: counts and scenes for the picture.
        paths: files of the counts, all in one folder, which is made if needed.
        dataset: its classes and colours.
    """
    # Named like the counts that it shows, those of the first protocol.
    first = next(iter(paths.values()))
    first.parent.mkdir(parents=True, exist_ok=True)
    for protocol, counts in reversed(pairs.counts.items()):
        counts.save(paths[protocol])
    lines = [(f"counts, {protocol}", str(path)) for protocol, path in paths.items()]
    if pairs.records:
        stem = paths["flow"].stem.removeprefix("consistency_")
        write_records(pairs.records, first.with_name(f"{stem}.csv"))
        lines.append(("flow of each pair", str(first.with_name(f"{stem}.csv"))))
    if not pairs.kept:
        info("no image of the picture could be read, so it was not drawn.")
        return lines
    picture = first.with_name(first.stem.replace("consistency_", "pairs_") + ".png")
    draw_pairs(pairs.kept, legend_of(dataset), picture)
    return [*lines, ("picture", str(picture))]


def add_to_result(run: RunFolder, session: Session, split: str, table: ConsistencyTable) -> None:
    """Add the measurement to the result, tables and MLflow run of `run`, as if made by it."""
    result, tables = read_result(run.path), read_tables(run.path)
    kinds = {session.trainer.selection_split: "val", "test": "test"}
    kind = kinds.get(split)
    if result is None or tables is None or kind not in result or session.consistency.mark:
        return
    result[kind] = {**result[kind], **without_nan(consistency_values(table))}
    if kind == "test":
        run.write_tables(replace(tables, consistency=table))
    run.finish(result)
    if read_upload_state(run) is None:
        return
    try:
        tracking_of(run, SyncOptions(run=run.path)).sync(run, status_of(run))
    except Exception as error:  # the store may raise anything; the run folder has all results
        reason = (str(error).splitlines() or [""])[0]
        info(f"MLflow was not updated ({reason}). Update it with: rgbt sync run={run.path}")
