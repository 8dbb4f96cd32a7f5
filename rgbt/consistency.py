"""Temporal consistency of a run or of released weights: ``python -m rgbt.consistency run=...``.

TC says how far the predictions of two frames of a scene agree, CA how far both are also right.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from rgbt.checks import InputError
from rgbt.config.common_options import Checkpoint, Modality, RunsDir, Split, Trained, Trust
from rgbt.config.options import Help
from rgbt.config.plain_command import PlainCommand

if TYPE_CHECKING:
    from rgbt.build.session import Session
    from rgbt.evaluation.temporal_consistency import Pairs
    from rgbt.metrics.pairs import Protocol
    from rgbt.tracking.run_folder import RunFolder
    from rgbt.tracking.tables import ConsistencyTable


@dataclass(frozen=True)
class Options:
    """What is measured, and on which pairs of frames."""

    run: Trained = ""
    runs_dir: RunsDir = Path("runs")
    frames: Annotated[
        Literal["virtual", "next"],
        Help(
            "virtual: virtual views of every image, by three published sets of angles; written as "
            '"aligned" (the first prediction is brought into the second frame, as in the paper) '
            'and "released" (it is not). next: true second frames with known motion (dataset=synth '
            "dataset.ego_forward_m=0.5, or a data set with a folder next/)"
        ),
    ] = "virtual"
    split: Split = "test"
    modality: Modality = "default"
    checkpoint: Checkpoint = "best"
    trust: Trust = ""
    out: Annotated[
        Path | None,
        Help(
            "folder of the counts and of a picture; default: evaluations/ in the run folder, where "
            "counts on other images or other views than the published ones say so in their names, "
            "and those on second frames of one motion are not replaced by those of another"
        ),
    ] = None


def main(options: Options, overrides: list[str]) -> int:
    """Measure TC and CA of a run, or of a network with weights from a file.

    Overrides such as consistency.sets=[my.csv] consistency.view.camera.fx=700 dataset=mfnet; what
    they do not name is as in conf/consistency/views.yaml, whatever the run measured
    """
    from rgbt.build.load_run import open_trained
    from rgbt.build.session import panel_names, view_of
    from rgbt.config.stored_config import parse_trust
    from rgbt.evaluation.temporal_consistency import (
        PROTOCOLS,
        consistency_table,
        count_pairs,
    )
    from rgbt.tracking.run_folder import RunFolder
    from rgbt.tracking.tables import consistency_grid
    from rgbt.tracking.terminal import path_lines, print_rich, rich_table

    if not any(item.split("=")[0] == "consistency" for item in overrides):
        overrides = ["consistency=views", *overrides]
    _check_comparable(options, overrides)
    trust, checkpoint = parse_trust(options.trust), options.checkpoint
    stored = open_trained(options.run, options.runs_dir, overrides, checkpoint, trust=trust)
    session, split, frames = stored.session, options.split, options.frames
    view = view_of(session, options.modality)
    folder = options.out or stored.folder
    beside = [options.modality] if options.modality != "default" else []
    beside += [] if checkpoint == "best" else [checkpoint]
    if frames == "next":
        _keep_other_motions(session, folder / _name("next", session, split, beside))
    elif options.out is None:
        beside += _other_images(stored.folder, session)
    keep = panel_names(session.dataset, split)
    found = count_pairs(session, session.model, split, frames, view=view, keep=keep)
    table = consistency_table(found.counts, session.regions.absent)
    partition = found.counts[PROTOCOLS[frames][0]].partition
    what = partition.partition("-")[2] or "published"
    title = f"Consistency of {stored.label} ({session.dataset.name}, {split}; {frames}: {what})"
    print_rich(rich_table(consistency_grid(table, title)))
    print_rich(path_lines(_write(found, session, folder, beside)))
    if frames == "virtual" and options.run and not (options.out or beside):
        _add_to_result(RunFolder(stored.folder.parent), session, split, table)
    return 0


CHANGES = ("transform", "trainer.precision", "metric")
"""Settings by which the same run gives other counts, or other scores of them."""


def _check_comparable(options: Options, overrides: list[str]) -> None:
    """Refuse to put counts made in another way beside, or in place of, those of the run."""
    changed = [word for word in overrides if word.lstrip("+").startswith(CHANGES)]
    if options.run and changed and options.out is None:
        raise InputError(
            f"{changed[0]} changes how the run is measured; name a folder for these counts with "
            "out=..."
        )


def _write(
    found: Pairs, session: Session, folder: Path, beside: list[str]
) -> list[tuple[str, str]]:
    """Write counts and picture; (what, where) of each. `beside` ends their names."""
    from rgbt.build.session import legend_of
    from rgbt.tracking.pair_pictures import draw_pairs
    from rgbt.tracking.terminal import info

    folder.mkdir(parents=True, exist_ok=True)
    places: list[tuple[str, str]] = []
    for protocol, counts in reversed(found.counts.items()):
        path = folder / _name(protocol, session, counts.split, beside)
        counts.save(path)
        places.insert(0, (f"counts, {protocol}", str(path)))
    if not found.kept:
        info("none of the images of the picture could be read; it was not drawn.")
        return places
    # Named like the counts that it shows, those of the first protocol.
    picture = path.with_name(path.stem.replace("consistency_", "pairs_") + ".png")
    draw_pairs(found.kept, legend_of(session.dataset), picture)
    return [*places, ("picture", str(picture))]


def _add_to_result(run: RunFolder, session: Session, split: str, table: ConsistencyTable) -> None:
    """What a run would hold had it measured this itself: result, tables, MLflow."""
    from dataclasses import asdict

    from rgbt.evaluation.temporal_consistency import consistency_values
    from rgbt.tracking.mlflow_upload import read_upload_state
    from rgbt.tracking.sync import Options as SyncOptions
    from rgbt.tracking.sync import status_of, tracking_of
    from rgbt.tracking.tables import without_nan
    from rgbt.tracking.terminal import info

    result, tables = run.result(), run.tables()
    kinds = {session.trainer.selection_split: "val", "test": "test"}
    if result is None or tables is None or split not in kinds or session.consistency.mark:
        return
    kind = kinds[split]
    result[kind] = {**result[kind], **without_nan(consistency_values(table))}
    if kind == "test":
        run.write_tables({**tables, "consistency": without_nan(asdict(table))})
    run.finish(result)
    if read_upload_state(run) is None:
        return
    try:
        tracking_of(run, SyncOptions(run=run.path)).sync(run, status_of(run))
    except Exception as error:  # any store may fail in its own way; the folder has everything
        reason = (str(error).splitlines() or [""])[0]
        info(f"MLflow was not told ({reason}); rgbt sync run={run.path} does.")


def _name(protocol: Protocol, session: Session, split: str, beside: list[str]) -> str:
    """Name of a file of counts; those of true frames have one name, whatever the motion."""
    from rgbt.metrics.pairs import file_name

    views = "" if protocol == "next" else session.consistency.mark
    usual = Path(file_name(protocol, split, views))
    return usual.with_stem("_".join([usual.stem, *beside])).name


def _keep_other_motions(session: Session, path: Path) -> None:
    """Refuse to replace counts on other second frames by those on these."""
    from rgbt.evaluation.temporal_consistency import views_of
    from rgbt.metrics.counts import Counts
    from rgbt.metrics.pairs import partition_name

    asked = partition_name("next", 1, views_of(session, "next"))
    if path.is_file() and Counts.load(path).partition != asked:
        raise InputError(
            f"{path} holds counts on second frames of another motion; name a folder for these with "
            "out=..., or remove that file."
        )


def _other_images(folder: Path, session: Session) -> list[str]:
    """Part of a file's name where a run is measured on images that it was not trained with."""
    from rgbt.tracking.run_files import read_marker

    marker, found = read_marker(folder.parent), session.dataset.fingerprint()
    if marker is None or marker["files"] == found:
        return []
    return [f"{session.dataset.name}-{found[:8]}"]


entry = PlainCommand(Options, main)

if __name__ == "__main__":
    entry()
