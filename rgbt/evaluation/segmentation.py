"""Predict a split, count by image, region, label and class, and make tables of the counts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from rich.console import RenderableType
from torch import Tensor, nn

from rgbt.build.load_run import TrainedNetwork
from rgbt.build.session import Session
from rgbt.data.loaders import eval_batches
from rgbt.dataset import LabelledDataset, Subset, background_indices
from rgbt.engine.progress import progress
from rgbt.evaluation.batch_norm import normalised, parts_of_split, statistics_in_words
from rgbt.evaluation.details import DetailCounter, DetailedImages, details_counts
from rgbt.evaluation.prediction import Predictor, counts_of, decode_ahead
from rgbt.evaluation.request import EvaluationRequest, NetworkRequest
from rgbt.metrics import scores
from rgbt.metrics.absent import absent_notes
from rgbt.metrics.confusion import RegionCounter
from rgbt.metrics.counts import Counts
from rgbt.metrics.details import DetailKind
from rgbt.metrics.metric import Regions
from rgbt.processes import collected, num_processes
from rgbt.tracking.pictures import Legend, PanelExample
from rgbt.tracking.tables import ClassTable, RegionTable, ResultTables
from rgbt.tracking.terminal import result_view
from rgbt.transforms.joint import whole_view
from rgbt.types import Batch, View

NUM_PANELS = 6
"""Images of the qualitative panel: the same number by day and by night if the split has both."""


Counted = dict[str, NDArray[np.int64]]
"""Name of an image -> its counts (R, K, K)."""


@dataclass(frozen=True)
class EvaluationResult:
    """Counts of one split per image and region, predicted from `view`.

    Attributes:
        kept: examples for pictures.
        skipped: names of unreadable files that were skipped, of the split and of statistics.
        details: kind -> counts of the requested details (`rgbt.metrics.details`).
    """

    counts: Counts
    view: View
    kept: tuple[PanelExample, ...]
    skipped: tuple[str, ...]
    details: Mapping[DetailKind, Counts] = field(default_factory=dict)


def evaluate(session: Session, model: nn.Module, request: EvaluationRequest) -> EvaluationResult:
    """Predict a split with `model`, left in evaluation mode, and count, with a progress bar.

    Several processes of a run predict a part of the split each, and return the same result.

    Raises:
        InputError: a file cannot be read (data.on_error=raise), or none could be; the network
            has not the view or the head; a corruption that does not fit the images; details that
            the data set does not have; statistics that cannot be computed (`normalised`).
    """
    predictor = Predictor(session, model, request)
    if request.corruption is not None:
        session = request.corruption.applied_to(session, request.split)
    names = session.dataset.names(request.split)
    detail = DetailCounter(request.details, session.dataset, session.regions)
    wanted = request.batch_norm
    decode_ahead(session, request.split, *(wanted.splits if wanted is not None else ()))
    parts = []
    unmeasured: list[str] = []
    for part in parts_of_split(session.dataset, request):
        with normalised(session, predictor, request, part) as skipped:
            unmeasured += skipped
            parts.append(_count(session, predictor, request, part.names, detail))
    every = _joined([each for part in parts for each in collected(part)], names)
    counts = counts_of(session, request.split, every.counted, session.regions.name)
    details = details_counts(session, request.split, every.detailed, request.details)
    unread = tuple(dict.fromkeys((*every.skipped, *unmeasured)))
    return EvaluationResult(counts, predictor.view, tuple(every.kept), unread, details)


def _count(
    session: Session,
    predictor: Predictor,
    request: EvaluationRequest,
    names: tuple[str, ...],
    detail: DetailCounter,
) -> _Part:
    """Predict the images `names` of the split, or the part of this process, and count."""
    dataset = Subset(session.dataset, names)
    batches = eval_batches(dataset, request.split, session.transform, session.loading)
    counter = RegionCounter(len(dataset.classes), session.regions)
    counted: Counted = {}
    detailed: DetailedImages = {}
    kept: list[PanelExample] = []
    with progress() as display:
        task = display.add_task(request.split, total=len(names), note="images")
        done = 0
        for loaded in batches:
            batch = predictor.counted(loaded)
            predicted, confidence = _predicted(predictor, batch, session, detail)
            for index, (name, label) in enumerate(zip(batch.name, batch.label, strict=True)):
                classes = predicted[index]
                counted[name] = counter(label, classes)
                detailed[name] = detail(name, label, classes, confidence[index])
                is_kept = name in request.keep
                kept += [_example(session, name, classes.numpy())] if is_kept else []
            done = min(len(names), done + num_processes() * len(batch.name))
            display.update(task, completed=done)
    return _Part(counted, detailed, kept, tuple(batches.skipped))


def _predicted(
    predictor: Predictor, batch: Batch, session: Session, detail: DetailCounter
) -> tuple[Tensor, Sequence[Tensor | None]]:
    """Classes (B, H, W) of a batch on the CPU, with the probability of each where it is needed."""
    on_device = batch.to(session.fabric.device)
    if not detail.needs_confidence:
        return predictor.classes(on_device).cpu(), [None] * len(batch.name)
    classes, confidence = predictor.confident_classes(on_device)
    return classes.cpu(), list(confidence.cpu())


class _Part(NamedTuple):
    """What one process has counted, kept and skipped of the images of one domain, or of all."""

    counted: Counted
    detailed: DetailedImages
    kept: list[PanelExample]
    skipped: tuple[str, ...]


def _joined(parts: Sequence[_Part], names: Sequence[str]) -> _Part:
    """The parts of all processes and domains together, in the order of `names`."""
    if len(parts) == 1:
        return parts[0]
    position = {name: index for index, name in enumerate(names)}
    order = position.__getitem__
    counted = {name: counts for each in parts for name, counts in each.counted.items()}
    detailed = {name: counts for each in parts for name, counts in each.detailed.items()}
    examples = [example for each in parts for example in each.kept]
    return _Part(
        {name: counted[name] for name in sorted(counted, key=order)},
        {name: detailed[name] for name in sorted(detailed, key=order)},
        sorted(examples, key=lambda example: position[example.name]),
        tuple(sorted((name for each in parts for name in each.skipped), key=order)),
    )


def _example(session: Session, name: str, classes: NDArray[np.uint8]) -> PanelExample:
    sample = session.dataset.read(name)
    label = sample.label if sample.label is not None else np.full_like(sample.thermal, 255)
    # Classes may be counted at another size than that of the label file.
    shown = whole_view((classes.shape[0], classes.shape[1]), (label.shape[0], label.shape[1]))
    return PanelExample(name, sample.rgb, sample.thermal, label, shown.nearest(classes))


def result_tables(counts: Counts, regions: Regions, label: str, step: int) -> ResultTables:
    """The tables of one evaluation, from its counts alone; `label` names its row."""
    absent, scored = regions.absent, counts.scored
    whole, by_region = counts.whole(), counts.by_region()
    region_ious = scores.miou(by_region, absent, scored)
    parts = {part: scores.miou(sub.whole(), absent, scored) for part, sub in counts.parts().items()}
    return ResultTables(
        split=counts.split,
        step=step,
        region_names=tuple(f"{regions.partition}_{n + 1}" for n in range(len(by_region))),
        regions=RegionTable(
            row_label=label,
            region_ious=tuple(map(float, region_ious)),
            miou=float(scores.miou(whole, absent, scored)),
            variance=float(scores.variance(region_ious)),
        ),
        classes=ClassTable(
            names=counts.classes,
            ious=tuple(map(float, scores.iou(whole, absent))),
            accuracies=tuple(map(float, scores.recall(whole, absent))),
            region_ious=tuple(tuple(map(float, row)) for row in scores.iou(by_region, absent).T),
            subset_mious={part: float(value) for part, value in parts.items()},
            unscored=counts.unscored,
            notes=absent_notes(by_region, counts.classes, scored, counts.split, absent),
        ),
    )


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
    words += [] if request.batch_norm is None else [request.batch_norm.file_stem]
    return opened.folder / f"{'_'.join([*words, *network.suffixes])}.npz"


def overview(
    opened: TrainedNetwork, request: EvaluationRequest, result: EvaluationResult, path: Path
) -> RenderableType:
    """Print the tables of an evaluation and the path of its counts."""
    session, head = opened.session, request.head
    label = label_of(opened, request, result.view)
    tables = result_tables(result.counts, session.regions, label, opened.step)
    heads = session.domains.heads_in_words(head or session.domains.tested_head)
    statistics = statistics_in_words(session, request, result.skipped)
    lines = [
        *([("heads", heads)] if heads else []),
        *([("batch norm", statistics)] if statistics else []),
        ("counts", str(path)),
    ]
    if result.skipped:
        lines.append(("skipped", f"{len(result.skipped)} images that cannot be read"))
    return result_view(tables, path.parent, lines)


def label_of(opened: TrainedNetwork, request: EvaluationRequest, view: View) -> str:
    """The name of an evaluation in tables."""
    head = f" {request.head} head" if request.head else ""
    changes = [each.title for each in (request.corruption, request.batch_norm) if each is not None]
    return ", ".join([f"{opened.label} {opened.session.dataset.name} {view}{head}", *changes])


def legend_of(dataset: LabelledDataset) -> Legend:
    """Classes of a data set and their colours."""
    palette = np.array(dataset.palette, np.uint8)
    return Legend(dataset.classes, palette, background_indices(dataset))


def panel_names(dataset: LabelledDataset, split: str) -> tuple[str, ...]:
    """The first images of a split, half by day and half by night where it holds both."""
    names = dataset.names(split)
    at_night = dataset.nights(names) or (False,) * len(names)
    night = [name for name, dark in zip(names, at_night, strict=True) if dark]
    day = [name for name, dark in zip(names, at_night, strict=True) if not dark]
    num_day = min(len(day), max(NUM_PANELS // 2, NUM_PANELS - len(night)))
    return tuple(day[:num_day] + night[: NUM_PANELS - num_day])
