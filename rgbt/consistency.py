"""Temporal consistency of a run or of released weights: ``python -m rgbt.consistency run=...``.

TC says how far the predictions of two frames of a scene agree, CA how far both are also right.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, cast

from rgbt.checks import check_choice
from rgbt.command import plain_command

if TYPE_CHECKING:
    from rgbt.session import Session
    from rgbt.two_frames import Pairs

OWN = {
    "run": "",
    "runs_dir": "runs",
    "frames": "virtual",
    "split": "test",
    "modality": "default",
    "checkpoint": "best",
    "out": "",
}


def main(arguments: dict[str, str], overrides: list[str]) -> int:
    """Measure TC and CA of a run, or of a network with weights from a file.

    run       run folder, config key or MLflow run id; without one, name a network and its weights:
              model=cmx_b2 model.weights=model_H.pth dataset.root=/data/MFNet (scale=paper)
    frames    virtual: virtual views of every image, by three published sets of angles; written as
              "aligned" (the first prediction is brought into the second frame, as in the paper)
              and "released" (it is not). next: true second frames with known motion
              (dataset=synth dataset.ego_forward_m=0.5, or a data set with a folder next/)
    split     split of the data set
    modality  rgbt, rgb or thermal: what is predicted from; default: what the network is made for
    checkpoint  best (by validation mIoU) or last
    out       folder of the counts and of a picture; default: evaluations/ in the run folder, where
              counts of other images or other views than the published ones say so in their names
    overrides such as consistency.sets=[my.csv] consistency.view.camera.fx=700 dataset=mfnet; what
              they do not name is as in conf/consistency/views.yaml, whatever the run measured
    """
    from rgbt.session import panel_names, view_of
    from rgbt.stored import open_trained
    from rgbt.tracking.tables import consistency_grid
    from rgbt.tracking.terminal import place_lines, rich_table, show
    from rgbt.two_frames import PROTOCOLS, Frames, consistency_table, count_pairs

    check_choice("frames", arguments["frames"], PROTOCOLS)
    if not any(item.split("=")[0] == "consistency" for item in overrides):
        overrides = ["consistency=views", *overrides]
    runs_dir = Path(arguments["runs_dir"])
    stored = open_trained(arguments["run"], runs_dir, overrides, arguments["checkpoint"])
    session, split = stored.session, arguments["split"]
    view = view_of(session.model, arguments["modality"])
    frames = cast(Frames, arguments["frames"])
    keep = panel_names(session.dataset, split)
    found = count_pairs(session, session.model, split, frames, view=view, keep=keep)
    folder = Path(arguments["out"] or stored.folder)
    folder.mkdir(parents=True, exist_ok=True)
    beside = [arguments["modality"]] if arguments["modality"] != "default" else []
    beside += [] if arguments["checkpoint"] == "best" else [arguments["checkpoint"]]
    if frames == "virtual" and not arguments["out"]:
        beside += _other_images(stored.folder, session)
    table = consistency_table(found.counts, session.regions.absent)
    title = f"Consistency of {stored.label} ({session.dataset.name}, {split})"
    show(rich_table(consistency_grid(table, title)))
    show(place_lines(_write(found, session, folder, beside)))
    return 0


def _write(
    found: Pairs, session: Session, folder: Path, beside: list[str]
) -> list[tuple[str, str]]:
    """Write counts and picture; (what, where) of each. `beside` ends their names."""
    from rgbt.metrics.pairs import file_name
    from rgbt.session import legend_of
    from rgbt.tracking.pair_pictures import draw_pairs
    from rgbt.tracking.terminal import tell
    from rgbt.two_frames import views_of

    places: list[tuple[str, str]] = []
    for protocol, counts in reversed(found.counts.items()):
        usual = Path(file_name(protocol, counts.split, views_of(session, protocol)))
        path = folder / usual.with_stem("_".join([usual.stem, *beside])).name
        counts.save(path)
        places.insert(0, (f"counts, {protocol}", str(path)))
    if not found.kept:
        tell("none of the images of the picture could be read; it was not drawn.")
        return places
    # Named like the counts that it shows, those of the first protocol.
    picture = path.with_name(path.stem.replace("consistency_", "pairs_") + ".png")
    draw_pairs(found.kept, legend_of(session.dataset), picture)
    return [*places, ("picture", str(picture))]


def _other_images(folder: Path, session: Session) -> list[str]:
    """Part of a file's name where a run is measured on images that it was not trained with."""
    marker = folder.parent / "dataset.json"
    found = session.dataset.fingerprint()
    if not marker.is_file() or json.loads(marker.read_text())["files"] == found:
        return []
    return [f"{session.dataset.name}-{found[:8]}"]


if __name__ == "__main__":
    plain_command(OWN, main)()
