"""The objects of a run made from its configuration, and the evaluation that all commands share."""

from __future__ import annotations

import hashlib
import json
import logging
import os
from collections.abc import Collection
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
import torch
from lightning_fabric import Fabric
from rich.progress import Progress, TaskID
from torch import nn

from rgbt.checks import InputError, check_choice
from rgbt.build.contracts import check_dataset, is_own, watch_model
from rgbt.data.dataset import LabelledDataset
from rgbt.data.cache.dataset import decoded_dataset
from rgbt.data.domains import Domains, TestedHead
from rgbt.data.label_map import LabelMap
from rgbt.data.loaders import LoaderSettings, eval_batches
from rgbt.engine.allocator import keep_memory
from rgbt.engine.evaluate import HeadsOf, predictions
from rgbt.engine.progress import progress
from rgbt.engine.settings import TrainerSettings
from rgbt.engine.threads import fix_threads
from rgbt.metrics import scores
from rgbt.metrics.absent import absent_notes
from rgbt.metrics.confusion import RegionCounter
from rgbt.metrics.counts import Counts
from rgbt.metrics.metric import Regions
from rgbt.build.initial_weights import start_from_weights
from rgbt.randomness import derive
from rgbt.requirements import record_of
from rgbt.spec.run_spec import RunSpec
from rgbt.tracking.pictures import Example, Legend
from rgbt.tracking.tables import ClassTable, RegionTable, ResultTables
from rgbt.transforms.view_sets import ViewSets
from rgbt.types import View
from rgbt.checkpoints.report import Report

NUM_PANELS = 6
"""Images of the qualitative panel: as many by day as by night where the split holds both."""


@dataclass(frozen=True)
class Session:
    """What every command needs, built once.

    Attributes:
        spec: the run that they belong to.
        dataset: where samples come from.
        domains: which of them are trained on, and which head predicts an image.
        transform: makes examples of them.
        loading: batch sizes, workers, what to do about unreadable files.
        regions: partition of the image and the rule for absent classes.
        consistency: virtual views that TC and CA are measured on, if any.
        trainer: durations, precision, device.
        fabric: device and precision.
        model: the network, on the device, not wrapped.
        weights: what it took from a file, None where it is random.
    """

    spec: RunSpec
    dataset: LabelledDataset
    domains: Domains
    transform: Any
    loading: LoaderSettings
    regions: Regions
    consistency: ViewSets
    trainer: TrainerSettings
    fabric: Fabric
    model: nn.Module
    weights: Report | None


def open_session(
    spec: RunSpec, label_map: LabelMap | None = None, *, load_weights: bool = True
) -> Session:
    """Build data set, transform and network; nothing is trained or evaluated yet.

    Weights are drawn from (seed, "weights") without touching the global generator; those that
    `model.weights` names replace them.

    Args:
        spec: the run.
        label_map: from the classes of the network to those of the data set, where they differ.
        load_weights: False: `model.weights` is left out, because an upstream run is not finished.

    Raises:
        InputError: settings that do not fit each other, the machine or the file of weights.
    """
    keep_memory()
    fix_threads(spec.trainer.threads)
    fabric = _fabric(spec.trainer)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(derive(spec.seed, "weights"))
        model: nn.Module = spec.model.build()
    files: LabelledDataset = spec.dataset.build()
    if is_own(files):
        check_dataset(files)
    dataset = decoded_dataset(files, spec.data.cache, num_threads=len(os.sched_getaffinity(0)))
    num_classes = spec.model.values.get("num_classes", dataset.num_classes)
    _check_classes(num_classes, dataset, label_map)
    if is_own(model):
        watch_model(model, num_classes)
    weights = start_from_weights(model, spec) if load_weights else None
    return Session(
        spec=spec,
        dataset=dataset,
        domains=spec.domains,
        transform=spec.transform.build(),
        loading=spec.data,
        regions=spec.metric.build(),
        consistency=spec.consistency.build(),
        trainer=spec.trainer,
        fabric=fabric,
        model=model.to(fabric.device),
        weights=weights,
    )


def _check_classes(num_classes: int, dataset: LabelledDataset, label_map: LabelMap | None) -> None:
    if label_map is not None:
        label_map.check(num_classes, tuple(dataset.classes), dataset.name)
    elif num_classes != dataset.num_classes:
        raise InputError(
            f"model.num_classes is {num_classes} but {dataset.name} has {dataset.num_classes} "
            "classes; omit it, so that the data set decides, or let rgbt.predict map the classes "
            "of a network that was trained on others with label_map=..."
        )


def _fabric(trainer: TrainerSettings) -> Fabric:
    # Fabric sets itself to INFO when imported, and would say in a line what the configuration says.
    logging.getLogger("lightning_fabric").setLevel(logging.WARNING)
    try:
        return Fabric(accelerator=trainer.accelerator, devices=1, precision=trainer.precision)
    except (RuntimeError, ValueError) as error:
        raise InputError(
            f"trainer.accelerator={trainer.accelerator} with trainer.precision={trainer.precision} "
            f"cannot be used on this machine ({str(error).splitlines()[0]})."
        ) from error


def decode_ahead(session: Session, *splits: str) -> None:
    """Fill the cache of decoded images with these splits, where one is asked for.

    In the main process, before others read from it.

    Raises:
        InputError: the cache cannot be written.
    """
    fill_cache = record_of(session.dataset).fill_cache
    if fill_cache is not None:
        names = tuple(name for split in splits for name in session.dataset.names(split))
        with ExitStack() as shown:
            tasks: dict[str, TaskID] = {}
            display: list[Progress] = []

            def advance(what: str, done: int, total: int) -> None:
                if not display:  # where everything is there, nothing is shown
                    display.append(shown.enter_context(progress()))
                if what not in tasks:
                    tasks[what] = display[0].add_task(what, total=total, note="images")
                display[0].update(tasks[what], completed=done)

            fill_cache(names, advance)


def names_key(session: Session) -> str:
    """SHA-256 in hexadecimal over the names of the training splits and of the test split.

    Raises:
        InputError: a split is missing.
    """
    domains = (domain.split for domain in session.domains.named.values())
    lists = {split: session.dataset.names(split) for split in (*domains, "test")}
    return hashlib.sha256(json.dumps(lists).encode()).hexdigest()


def view_of(session: Session, modality: str = "default") -> View:
    """What `modality` asks of a session's network: one of its views.

    "default" is what its source domain is seen as; where that does not say, the network's first.

    Raises:
        InputError: the network does not predict from it.
    """
    known = record_of(session.model).views
    if modality == "default":
        return session.domains.source.view or known[0]
    check_choice("modality", modality, known)
    return cast(View, modality)


def heads_of(session: Session, view: View, head: TestedHead | None = None) -> HeadsOf:
    """Which head predicts an image: by its domain, or as asked.

    Args:
        session: see `open_session`.
        view: what is predicted from.
        head: None: as the run's configuration says (`domains.tested_head`).
    """
    asked = session.domains.tested_head if head is None else head

    def choose(names: tuple[str, ...]) -> tuple[str | None, ...]:
        by_night = asked == "own" and session.domains.target_is == "night"
        dark = (_nights(session, names) if by_night else None) or (None,) * len(names)
        return tuple(session.domains.head_of(view, night, asked) for night in dark)

    return choose


def _nights(session: Session, names: tuple[str, ...]) -> tuple[bool, ...] | None:
    """Which images were taken at night; None where that is not known, as of files of one's own."""
    try:
        return session.dataset.nights(names)
    except InputError:
        return None


@dataclass(frozen=True)
class Evaluation:
    """Counts of one split, and the images that were asked to be kept.

    Attributes:
        counts: per image and region.
        kept: examples for pictures.
        skipped: names of unreadable files that were left out.
    """

    counts: Counts
    kept: tuple[Example, ...]
    skipped: tuple[str, ...]


def evaluate(
    session: Session,
    model: nn.Module,
    split: str,
    *,
    view: View | None = None,
    head: TestedHead | None = None,
    keep: Collection[str] = (),
) -> Evaluation:
    """Predict a split and count, with a progress bar.

    Args:
        session: see `open_session`.
        model: the network to evaluate; left in evaluation mode.
        split: name of the split.
        view: what is predicted from; None: see `view_of`.
        head: which of two heads predicts an image; None: as the run's configuration says.
        keep: names of the images to return for pictures.

    Raises:
        InputError: a file cannot be read (data.on_error=raise), or none could be.
    """
    dataset = session.dataset
    decode_ahead(session, split)
    batches = eval_batches(dataset, split, session.transform, session.loading)
    counter = RegionCounter(len(dataset.classes), session.regions)
    counted: dict[str, np.ndarray] = {}
    kept: list[Example] = []
    view = view or view_of(session)
    heads = heads_of(session, view, head)
    with progress() as display:
        task = display.add_task(split, total=len(dataset.names(split)), note="images")
        for found in predictions(model, batches, session.fabric, view, heads):
            triples = zip(found.batch.name, found.batch.label, found.classes, strict=True)
            for name, label, classes in triples:
                counted[name] = counter(label, classes)
                kept += [_example(session, name, classes.numpy())] if name in keep else []
            display.advance(task, len(found.batch.name))
    if not counted:
        raise InputError(f"split '{split}' of {dataset.name}: no image could be read.")
    counts = Counts(
        counts=np.stack(list(counted.values())).astype(np.int32),
        names=tuple(counted),
        night=dataset.nights(tuple(counted)),
        classes=dataset.classes,
        partition=session.regions.name,
        dataset=dataset.fingerprint(),
        split=split,
        unscored=dataset.unscored,
        absent=session.regions.absent,
    )
    return Evaluation(counts, tuple(kept), tuple(batches.skipped))


def _example(session: Session, name: str, classes: np.ndarray) -> Example:
    sample = session.dataset.read(name)
    label = sample.label if sample.label is not None else np.full_like(sample.thermal, 255)
    return Example(name, sample.rgb, sample.thermal, label, classes)


def result_tables(counts: Counts, regions: Regions, label: str, step: int) -> ResultTables:
    """The tables of one evaluation, from its counts alone.

    Args:
        counts: of the split.
        regions: partition of the counts and the rule for absent classes.
        label: what the row stands for, e.g. "grbm".
        step: optimiser steps done.
    """
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


def legend_of(dataset: LabelledDataset) -> Legend:
    """Classes of a data set and their colours."""
    return Legend(dataset.classes, np.array(dataset.palette, np.uint8))


def panel_names(dataset: LabelledDataset, split: str) -> tuple[str, ...]:
    """The first images of a split, half by day and half by night where it holds both."""
    names = dataset.names(split)
    at_night = dataset.nights(names) or (False,) * len(names)
    night = [name for name, dark in zip(names, at_night, strict=True) if dark]
    day = [name for name, dark in zip(names, at_night, strict=True) if not dark]
    num_day = min(len(day), max(NUM_PANELS // 2, NUM_PANELS - len(night)))
    return tuple(day[:num_day] + night[: NUM_PANELS - num_day])
