"""Measure temporal consistency of a run or of released weights: ``rgbt consistency run=...``.

TC is the agreement of the predictions of two frames of a scene; CA counts agreement on the correct
class.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

from rgbt.config.common_options import Modality, NetworkOptions, Split
from rgbt.config.options import Help
from rgbt.config.plain_command import PlainCommand


@dataclass(frozen=True)
class Options(NetworkOptions):
    """Options of the command."""

    frames: Annotated[
        Literal["virtual", "next"],
        Help(
            "virtual: virtual views of every image, with three published sets of angles; reported "
            'as "aligned" (the first prediction is warped to the second frame, as in the paper) '
            'and "released" (it is not warped). next: real second frames with known motion '
            "(dataset=synth dataset.ego_forward_m=0.5, or a data set with a folder next/)"
        ),
    ] = "virtual"
    split: Split = "test"
    modality: Modality = "default"
    out: Annotated[
        Path | None,
        Help(
            "folder for the counts and a picture; default: evaluations/ in the run folder. Counts "
            "of other images, other views or another motion have names of their own there"
        ),
    ] = None


def main(options: Options, overrides: list[str]) -> int:
    """Measure TC and CA of a run, or of a network with weights from a file.

    Overrides such as consistency.sets=[my.csv] consistency.view.camera.fx=700 dataset=mfnet; all
    other settings are those of conf/consistency/views.yaml, not those of the run
    """
    from rgbt.evaluation.consistency_files import PairFiles, add_to_result
    from rgbt.evaluation.request import EvaluationRequest, NetworkRequest
    from rgbt.evaluation.segmentation import panel_names
    from rgbt.evaluation.temporal_consistency import consistency_table, count_pairs
    from rgbt.tracking.run_folder import RunFolder
    from rgbt.tracking.tables import consistency_grid
    from rgbt.tracking.terminal import path_lines, print_rich, rich_table

    split, frames, out = options.split, options.frames, options.out
    if not any(item.split("=")[0] == "consistency" for item in overrides):
        overrides = ["consistency=views", *overrides]
    network = NetworkRequest(options, overrides)
    network.check_comparable(out)
    request = EvaluationRequest.from_options(split, options.modality)
    opened = network.open()
    session = opened.session
    files = PairFiles(opened, network, request, frames, out)
    request = replace(request, keep=panel_names(session.dataset, split))
    pairs = count_pairs(session, session.model, request, frames)
    table = consistency_table(pairs.counts, session.regions.absent)
    views = next(iter(pairs.counts.values())).partition.partition("-")[2] or "published"
    on = f"{session.dataset.name}, {split}; {frames}: {views}"
    print_rich(rich_table(consistency_grid(table, f"Consistency of {opened.label} ({on})")))
    print_rich(path_lines(files.write(pairs)))
    if frames == "virtual" and options.run and not (out or files.suffixes):
        add_to_result(RunFolder(opened.folder.parent), session, split, table)
    return 0


entry = PlainCommand(Options, main)

if __name__ == "__main__":
    entry()
