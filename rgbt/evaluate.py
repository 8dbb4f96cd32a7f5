"""Evaluate a run, or weights from a file: ``python -m rgbt.evaluate run=runs/<key>``.

Counts are written, and the tables that follow from them are shown.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from rgbt.checks import InputError
from rgbt.config.command import plain_command

if TYPE_CHECKING:
    from rgbt.evaluation.request import EvaluationRequest, NetworkRequest

OWN = {
    "run": "",
    "runs_dir": "runs",
    "split": "test",
    "modality": "default",
    "regions": "as trained",
    "head": "as trained",
    "corruption": "none",
    "severity": "",
    "checkpoint": "best",
    "trust": "",
    "out": "",
}


def main(arguments: dict[str, str], overrides: list[str]) -> int:
    """Evaluate a run, on its own data set or another one, or a network with weights from a file.

    run       run folder, config key or MLflow run id; without one, name a network and its weights:
              model=mfnet model.weights=final.pth dataset.root=/data/MFNet (scale=paper)
    split     split of the data set
    modality  rgbt, rgb or thermal: what is predicted from; default: what the network is made for
    regions   a file of conf/metric: ring5, ring9, vertical5, horizontal5
    head      of a network with a head per domain: own, source or target
    corruption  of the images: a file of conf/corruption such as noise, with a severity:
              corruption=noise severity=16; of one image: corruption=noise:rgb, removed:thermal;
              python -m rgbt.robustness measures all of them
    checkpoint  best (by validation mIoU) or last
    trust     modules of yours that the run was made with: trust=my_lab; their code is run
    out       file of the counts; default: evaluations/ in the run folder
    overrides such as dataset=mfnet dataset.root=/data/MFNet data.eval_batch_size=1, and of the
              corruption: corruption.block=16 corruption.seed=1
    """
    from rgbt.evaluation.segmentation import evaluate
    from rgbt.evaluation.segmentation_files import counts_path, overview
    from rgbt.tracking.terminal import show
    from rgbt.training.overview import announce_network

    if Path(arguments["out"] or "x").is_dir():
        raise InputError(f"out={arguments['out']} is a folder; name the file of the counts, x.npz.")
    network, request = _requests(arguments, overrides)
    opened = network.open()
    announce_network(opened)
    result = evaluate(opened.session, opened.session.model, request)
    path = Path(arguments["out"] or counts_path(opened, network, request, result))
    path.parent.mkdir(parents=True, exist_ok=True)
    result.counts.save(path)
    show(overview(opened, request, result, path))
    return 0


def _requests(
    arguments: dict[str, str], overrides: list[str]
) -> tuple[NetworkRequest, EvaluationRequest]:
    from rgbt.evaluation.corruption_request import requested_corruption, split_overrides
    from rgbt.evaluation.request import EvaluationRequest, NetworkRequest

    words, others = split_overrides(overrides)
    network = NetworkRequest.from_options(arguments, others)
    corruption = requested_corruption(
        arguments["corruption"], arguments["severity"], words, network.trust
    )
    return network, EvaluationRequest.from_options(arguments, arguments["split"], corruption)


if __name__ == "__main__":
    plain_command(OWN, main)()
