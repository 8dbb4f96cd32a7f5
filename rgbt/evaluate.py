"""Evaluate a run, or weights from a file: ``python -m rgbt.evaluate run=runs/<key>``.

Counts are written, and the tables that follow from them are shown.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from rgbt.checks import InputError
from rgbt.config.common_options import (
    Checkpoint,
    Head,
    Modality,
    RegionsFile,
    RunsDir,
    Split,
    Trained,
    Trust,
)
from rgbt.config.options import Help
from rgbt.config.plain_command import PlainCommand

if TYPE_CHECKING:
    from rgbt.evaluation.request import EvaluationRequest, NetworkRequest


@dataclass(frozen=True)
class Options:
    """What is evaluated, and on which images."""

    run: Trained = ""
    runs_dir: RunsDir = Path("runs")
    split: Split = "test"
    modality: Modality = "default"
    regions: RegionsFile = "as trained"
    head: Head = "as trained"
    corruption: Annotated[
        str,
        Help(
            "of the images: a file of conf/corruption such as noise, with a severity: "
            "corruption=noise severity=16; of one image: corruption=noise:rgb, removed:thermal; "
            "rgbt robustness measures all of them"
        ),
    ] = "none"
    severity: Annotated[str, Help("of the corruption")] = ""
    checkpoint: Checkpoint = "best"
    trust: Trust = ""
    out: Annotated[
        Path | None, Help("file of the counts; default: evaluations/ in the run folder")
    ] = None


def main(options: Options, overrides: list[str]) -> int:
    """Evaluate a run, on its own data set or another one, or a network with weights from a file.

    Overrides such as dataset=mfnet dataset.root=/data/MFNet data.eval_batch_size=1, and of the
    corruption: corruption.block=16 corruption.seed=1
    """
    from rgbt.evaluation.segmentation import evaluate
    from rgbt.evaluation.segmentation_files import counts_path, overview
    from rgbt.tracking.terminal import print_rich
    from rgbt.training.overview import announce_network

    if options.out is not None and options.out.is_dir():
        raise InputError(f"out={options.out} is a folder; name the file of the counts, x.npz.")
    network, request = _requests(options, overrides)
    opened = network.open()
    announce_network(opened)
    result = evaluate(opened.session, opened.session.model, request)
    path = options.out or counts_path(opened, network, request, result)
    path.parent.mkdir(parents=True, exist_ok=True)
    result.counts.save(path)
    print_rich(overview(opened, request, result, path))
    return 0


def _requests(options: Options, overrides: list[str]) -> tuple[NetworkRequest, EvaluationRequest]:
    from rgbt.evaluation.corruption_request import requested_corruption, split_overrides
    from rgbt.evaluation.request import EvaluationRequest, NetworkRequest

    words, others = split_overrides(overrides)
    network = NetworkRequest.from_options(options, others, options.regions)
    corruption = requested_corruption(options.corruption, options.severity, words, network.trust)
    request = EvaluationRequest.from_options(options, options.split, options.head, corruption)
    return network, request


entry = PlainCommand(Options, main)

if __name__ == "__main__":
    entry()
