"""Evaluate a run, or weights from a file: ``rgbt evaluate run=runs/<key>``.

The command writes the counts and prints the tables derived from them.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from rgbt.checks import InputError
from rgbt.config.common_options import Head, Modality, NetworkOptions, RegionsFile, Split
from rgbt.config.options import Help
from rgbt.config.plain_command import PlainCommand


@dataclass(frozen=True)
class Options(NetworkOptions):
    """Options of the command."""

    split: Split = "test"
    modality: Modality = "default"
    regions: RegionsFile = "as trained"
    head: Head = "as trained"
    corruption: Annotated[
        str,
        Help(
            "corruption of the images, a file of conf/corruption with a severity: "
            "corruption=noise severity=16. Of one image only: corruption=noise:rgb or "
            "removed:thermal. `rgbt robustness` measures all corruptions"
        ),
    ] = "none"
    severity: Annotated[str, Help("severity of the corruption")] = ""
    out: Annotated[
        Path | None, Help("file for the counts; default: evaluations/ in the run folder")
    ] = None


def main(options: Options, overrides: list[str]) -> int:
    """Evaluate a run, on its own data set or another one, or a network with weights from a file.

    Overrides such as dataset=mfnet dataset.root=/data/MFNet data.eval_batch_size=1, and settings
    of the corruption: corruption.block=16 corruption.seed=1
    """
    from rgbt.evaluation.corruption_request import requested_corruption, split_overrides
    from rgbt.evaluation.request import EvaluationRequest, NetworkRequest
    from rgbt.evaluation.segmentation import counts_path, evaluate, overview
    from rgbt.tracking.terminal import print_rich
    from rgbt.training.overview import announce_network

    if options.out is not None and options.out.is_dir():
        raise InputError(
            f"out={options.out} is a folder; give a file name for the counts, such as "
            "out=counts.npz."
        )
    words, overrides = split_overrides(overrides)
    network = NetworkRequest(options, overrides, options.regions)
    corruption = requested_corruption(options.corruption, options.severity, words, network.trust)
    request = EvaluationRequest.from_options(
        options.split, options.modality, options.head, corruption
    )
    opened = network.open()
    announce_network(opened)
    result = evaluate(opened.session, opened.session.model, request)
    path = options.out or counts_path(opened, network, request, result)
    path.parent.mkdir(parents=True, exist_ok=True)
    result.counts.save(path)
    print_rich(overview(opened, request, result, path))
    return 0


entry = PlainCommand(Options, main)

if __name__ == "__main__":
    entry()
