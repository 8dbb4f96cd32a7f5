"""What ``rgbt.evaluate`` leaves and shows of one evaluation."""

from __future__ import annotations

from pathlib import Path

from rich.console import RenderableType

from rgbt.build.load_run import TrainedNetwork
from rgbt.evaluation.request import EvaluationRequest, NetworkRequest
from rgbt.evaluation.segmentation import EvaluationResult, result_tables
from rgbt.tracking.terminal import result_view


def counts_path(
    opened: TrainedNetwork,
    network: NetworkRequest,
    request: EvaluationRequest,
    result: EvaluationResult,
) -> Path:
    """File of the counts in the folder of the network: its name says what was evaluated."""
    words = [opened.session.dataset.name, request.split, result.view, result.counts.partition]
    words += [] if request.head is None else [f"{request.head}-head"]
    words += [] if request.corruption is None else [request.corruption.file_stem]
    return opened.folder / f"{'_'.join([*words, *network.suffixes])}.npz"


def overview(
    opened: TrainedNetwork, request: EvaluationRequest, result: EvaluationResult, path: Path
) -> RenderableType:
    """The tables of an evaluation, and where its counts are."""
    session, head, corruption = opened.session, request.head, request.corruption
    label = f"{opened.label} {session.dataset.name} {result.view}{f' {head} head' if head else ''}"
    label += f", {corruption.title}" if corruption else ""
    tables = result_tables(result.counts, session.regions, label, opened.step)
    heads = session.domains.heads_in_words(head or session.domains.tested_head)
    lines = [*([("heads", heads)] if heads else []), ("counts", str(path))]
    if result.skipped:
        lines.append(("left out", f"{len(result.skipped)} images that cannot be read"))
    return result_view(tables, path.parent, lines)
