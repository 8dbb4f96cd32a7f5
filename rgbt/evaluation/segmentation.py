"""Predict a split, count by image, region, label and class, and make tables of the counts.

Details are counted beside them: boundaries, calibration, distance and size of objects.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from rich.console import Group
from torch import Tensor, nn

from rgbt.assembly.session import Session
from rgbt.checks import InputError
from rgbt.data.loaders import eval_batches
from rgbt.dataset import KnownScenes, LabelledDataset, Subset, background_indices, reader_of
from rgbt.engine.memory import naming_memory
from rgbt.engine.progress import progress
from rgbt.evaluation import prediction
from rgbt.evaluation.prediction import Predictor, counts_of
from rgbt.evaluation.request import EvaluationRequest, NetworkRequest
from rgbt.metrics import scores
from rgbt.metrics.counting import DetailCounter, RegionCounter
from rgbt.metrics.counts import Counts
from rgbt.metrics.details import SCENE_KINDS, DetailKind
from rgbt.metrics.metric import Regions
from rgbt.processes import collected, num_processes
from rgbt.tables import ClassTable, RegionTable, ResultTables, TextTable, number
from rgbt.terminal import result_view, rich_table
from rgbt.tracking.pictures import Legend, PanelExample
from rgbt.transforms.maps import nearest
from rgbt.types import View

# Images of the qualitative panel: the same number by day and by night if the split has both.
NUM_PANELS = 6


@dataclass(frozen=True)
class EvaluationResult:
    """Counts of one split per image and region, predicted from `view`, and kept examples.

    `skipped` are unreadable images, of the split and of statistics of batch normalisation.
    """

    counts: Counts
    view: View
    kept: tuple[PanelExample, ...]
    skipped: tuple[str, ...]
    details: Mapping[DetailKind, Counts] = field(default_factory=dict)

    def save(self, path: Path) -> None:
        """Write the counts to `path`, and those of details beside it."""
        path.parent.mkdir(parents=True, exist_ok=True)
        self.counts.save(path)
        for kind, counts in self.details.items():
            counts.save(details_path(path, kind))


class Counted(NamedTuple):
    """What one process has counted: of each image counts (R, K, K), and by kind (R G, M, K)."""

    counts: dict[str, NDArray[np.int64]]
    details: dict[str, dict[DetailKind, NDArray[np.int64]]]
    kept: list[PanelExample]
    skipped: tuple[str, ...]


def evaluate(session: Session, model: nn.Module, request: EvaluationRequest) -> EvaluationResult:
    """Predict a split with `model`, left in evaluation mode, and count, with a progress bar.

    Several processes of a run predict a part of the split each, and return the same result.

    Raises:
        InputError: a file cannot be read, or a request that does not fit the network or the data.
    """
    predictor = Predictor(session, model, request)
    split = request.split
    if request.corruption is not None:
        session = request.corruption.applied_to(session, split)
    counters = _detail_counters(session, request)
    parts = []
    unmeasured: list[str] = []
    images = session.loading.eval_batch_size
    advice = "Predict windows with prediction.window_hw=[...], or use trainer.accelerator=cpu."
    if images > 1:
        advice = "Set data.eval_batch_size=1, with equal results."
    with naming_memory(session.device, f"an evaluation of {images} images at once", advice):
        for names, sources in prediction.parts_of_split(session.dataset, request):
            with prediction.normalised(session, predictor, request, sources) as skipped:
                unmeasured += skipped
                parts.append(_count(session, predictor, request, names, counters))
    every = joined(
        [each for part in parts for each in collected(part)], session.dataset.names(split)
    )
    details = {}
    for each in request.details:
        by_name = {name: counts[each.kind] for name, counts in every.details.items()}
        # The sums of calibration are large.
        dtype = np.int64 if each.kind == "calibration" else np.int32
        partition = each.partition(session.regions.name)
        details[each.kind] = counts_of(session, split, by_name, partition, dtype)
    return EvaluationResult(
        counts=counts_of(session, split, every.counts, session.regions.name),
        view=predictor.view,
        kept=tuple(every.kept),
        skipped=tuple(dict.fromkeys((*every.skipped, *unmeasured))),
        details=details,
    )


def _count(
    session: Session,
    predictor: Predictor,
    request: EvaluationRequest,
    names: tuple[str, ...],
    counters: Mapping[DetailKind, DetailCounter],
) -> Counted:
    """Predict the images `names` of the split, or the part of this process, and count."""
    dataset = Subset(session.dataset, names)
    batches = eval_batches(dataset, request.split, session.transform, session.loading)
    counter = RegionCounter(len(dataset.classes), session.regions)
    found = Counted({}, {}, [], ())
    with progress() as display:
        task = display.add_task(request.split, total=len(names), note="images")
        done = 0
        for loaded in batches:
            batch = predictor.counted(loaded)
            on_device = batch.to(session.device)
            confidence: Sequence[Tensor | None] = [None] * len(batch.name)
            if "calibration" in counters:
                classes, sure = predictor.confident_classes(on_device)
                confidence = list(sure.cpu())
            else:
                classes = predictor.classes(on_device)
            images = [*zip(batch.name, batch.label, classes.cpu(), confidence, strict=True)]
            for name, label, predicted, each in images:
                found.counts[name] = counter(label, predicted)
                maps = (label, predicted, each)
                found.details[name] = _details_of(counters, session.dataset, name, maps)
            kept = (image for image in images if image[0] in request.keep)
            found.kept.extend(_example(session, name, shown.numpy()) for name, _, shown, _ in kept)
            done = min(len(names), done + num_processes() * len(batch.name))
            display.update(task, completed=done)
    return found._replace(skipped=tuple(batches.skipped))


def _detail_counters(
    session: Session, request: EvaluationRequest
) -> dict[DetailKind, DetailCounter]:
    """A counter of each requested kind; InputError for scenes that the data set does not know."""
    dataset, regions, num_classes = session.dataset, session.regions, len(session.dataset.classes)
    for each in request.details:
        if each.kind in SCENE_KINDS and not isinstance(reader_of(dataset), KnownScenes):
            raise InputError(f"details={each.kind}: {dataset.name} has no maps of its scenes.")
    return {each.kind: DetailCounter(num_classes, regions, each) for each in request.details}


def _details_of(
    counters: Mapping[DetailKind, DetailCounter],
    dataset: LabelledDataset,
    name: str,
    maps: tuple[Tensor, Tensor, Tensor | None],
) -> dict[DetailKind, NDArray[np.int64]]:
    """The details of one image from its label, classes and confidences (H, W)."""
    label, classes, confidence = maps
    further: dict[DetailKind, tuple[Any, ...]] = {"boundary": (), "calibration": (confidence,)}
    if counters.keys() & set(SCENE_KINDS):
        reader = reader_of(dataset)
        assert isinstance(reader, KnownScenes), "otherwise there is no such counter"
        scene = reader.scene_maps(name)
        further |= {"distance": (scene.depth_m,), "size": (scene.objects,)}
    return {kind: count(label, classes, *further[kind]) for kind, count in counters.items()}


def joined(parts: Sequence[Counted], names: Sequence[str]) -> Counted:
    """The parts of all processes and domains together, in the order of `names`."""
    position = {name: index for index, name in enumerate(names)}
    counts = {name: found for each in parts for name, found in each.counts.items()}
    details = {name: found for each in parts for name, found in each.details.items()}
    kept = [example for each in parts for example in each.kept]
    skipped = [name for each in parts for name in each.skipped]
    return Counted(
        {name: counts[name] for name in names if name in counts},
        {name: details[name] for name in names if name in details},
        sorted(kept, key=lambda example: position[example.name]),
        tuple(sorted(skipped, key=position.__getitem__)),
    )


def _example(session: Session, name: str, classes: NDArray[np.uint8]) -> PanelExample:
    sample = session.dataset.read(name)
    label = sample.label if sample.label is not None else np.full_like(sample.thermal, 255)
    # Classes may be counted at another size than that of the label file.
    shown = nearest(classes, (label.shape[0], label.shape[1]))
    return PanelExample(name, sample.rgb, sample.thermal, label, shown)


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
            notes=scores.absent_notes(by_region, counts.classes, scored, counts.split, absent),
        ),
    )


def counts_path(
    opened: Session,
    network: NetworkRequest,
    request: EvaluationRequest,
    result: EvaluationResult,
) -> Path:
    """File of the counts in the folder of the network: its name says what was evaluated."""
    words = [opened.dataset.name, request.split, result.view, result.counts.partition]
    words += [] if request.head is None else [f"{request.head}-head"]
    words += [] if request.corruption is None else [request.corruption.file_stem]
    words += [] if request.batch_norm is None else [request.batch_norm.file_stem]
    return opened.evaluations / f"{'_'.join([*words, *network.suffixes])}.npz"


def overview(
    opened: Session, request: EvaluationRequest, result: EvaluationResult, path: Path
) -> Group:
    """The tables of an evaluation and the path of its counts."""
    label = label_of(opened, request, result.view)
    tables = result_tables(result.counts, opened.regions, label, opened.step)
    lines: dict[str, str] = {
        "heads": opened.domains.heads_in_words(request.head or opened.domains.tested_head),
        "batch norm": request.batch_norm.title if request.batch_norm else "",
        "counts": str(path),
        **{kind: str(details_path(path, kind)) for kind in result.details},
        "unreadable": f"{len(result.skipped)} images" if result.skipped else "",
    }
    return Group(
        result_view(tables, path.parent, [line for line in lines.items() if line[1]]),
        *(rich_table(_details_table(counts, label)) for counts in result.details.values()),
    )


def label_of(opened: Session, request: EvaluationRequest, view: View) -> str:
    """The name of an evaluation in tables."""
    head = f" {request.head} head" if request.head else ""
    changes = [each.title for each in (request.corruption, request.batch_norm) if each is not None]
    return ", ".join([f"{opened.label} {opened.dataset.name} {view}{head}", *changes])


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


def details_path(path: Path, kind: DetailKind) -> Path:
    """File of a kind beside the counts in `path`: "x.npz" -> "x-boundary.npz"."""
    return path.with_name(f"{path.stem}-{kind}{path.suffix}")


def _details_table(counts: Counts, label: str) -> TextTable:
    """The scores of counts of details as a table; `label` names the network."""
    from rgbt.metrics.score_grid import score_grid

    grid = score_grid(counts)
    rows = [(title, *_numbers(counts, metrics)) for title, metrics in grid.rows]
    return TextTable(f"{label}: {grid.title}", ("", *grid.columns), tuple(rows))


def views_table(by_view: Mapping[View, Counts], label: str) -> TextTable:
    """The mIoU by region, one row for each input; counts of single frames."""
    from rgbt.metrics.score_grid import score_grid

    grid = score_grid(next(iter(by_view.values())))
    rows = [(view, *_numbers(counts, grid.metrics)) for view, counts in by_view.items()]
    return TextTable(f"{label}: {grid.title} and input", ("", *grid.columns), tuple(rows))


def _numbers(counts: Counts, metrics: Sequence[str]) -> tuple[str, ...]:
    from rgbt.metrics.named import value

    return tuple(number(value(metric, counts, counts.absent)) for metric in metrics)
