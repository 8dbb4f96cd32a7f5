"""The objects of a run made from its configuration, and the evaluation that all commands share."""

from __future__ import annotations

import logging
from collections.abc import Collection
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
import torch
from lightning_fabric import Fabric
from omegaconf import DictConfig
from torch import nn

from rgbt.checks import InputError, check_choice
from rgbt.config import build
from rgbt.data.loaders import LoaderSettings, eval_batches
from rgbt.data.mfnet import MFNet
from rgbt.engine.allocator import keep_memory
from rgbt.engine.evaluate import predictions
from rgbt.engine.progress import progress
from rgbt.engine.settings import TrainerSettings
from rgbt.metrics import scores
from rgbt.metrics.confusion import RegionCounter
from rgbt.metrics.counts import Counts
from rgbt.metrics.metric import Regions
from rgbt.pretrained import start
from rgbt.randomness import derive
from rgbt.tracking.pictures import Example, Legend
from rgbt.tracking.tables import ClassTable, RegionTable, ResultTables
from rgbt.transforms.view_sets import ViewSets
from rgbt.types import VIEWS, View
from rgbt.weights.report import Report

NUM_PANELS = 6
"""Images of the qualitative panel: as many by day as by night where the split holds both."""


@dataclass(frozen=True)
class Session:
    """What every command needs, built once.

    Attributes:
        config: the composed configuration, checked.
        dataset: where samples come from.
        transform: makes examples of them.
        loading: batch sizes, workers, what to do about unreadable files.
        regions: partition of the image and the rule for absent classes.
        consistency: virtual views that TC and CA are measured on, if any.
        trainer: durations, precision, device.
        fabric: device and precision.
        model: the network, on the device, not wrapped.
        weights: what it took from a file, None where it is random.
    """

    config: DictConfig
    dataset: MFNet
    transform: Any
    loading: LoaderSettings
    regions: Regions
    consistency: ViewSets
    trainer: TrainerSettings
    fabric: Fabric
    model: nn.Module
    weights: Report | None


def open_session(config: DictConfig) -> Session:
    """Build data set, transform and network; nothing is trained or evaluated yet.

    Weights are drawn from (seed, "weights") without touching the global generator; those that
    `model.weights` names replace them.

    Raises:
        InputError: settings that do not fit each other, the machine or the file of weights.
    """
    keep_memory()
    trainer: TrainerSettings = build(config.trainer)
    if trainer.threads is not None:
        torch.set_num_threads(trainer.threads)
    fabric = _fabric(trainer)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(derive(config.seed, "weights"))
        model: nn.Module = build(config.model)
    dataset: MFNet = build(config.dataset)
    if config.model.get("num_classes", dataset.num_classes) != dataset.num_classes:
        raise InputError(
            f"model.num_classes is {config.model.num_classes} but {dataset.name} has "
            f"{dataset.num_classes} classes; leave it to the data set."
        )
    weights = start(model, config)
    return Session(
        config=config,
        dataset=dataset,
        transform=build(config.transform),
        loading=build(config.data),
        regions=build(config.metric),
        consistency=build(config.consistency),
        trainer=trainer,
        fabric=fabric,
        model=model.to(fabric.device),
        weights=weights,
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


def view_of(model: nn.Module, modality: str) -> View:
    """What `modality` asks of a network: one of its views; the first for "default".

    Raises:
        InputError: the network does not predict from it.
    """
    known: tuple[View, ...] = getattr(model, "views", VIEWS)
    if modality == "default":
        return known[0]
    check_choice("modality", modality, known)
    return cast(View, modality)


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
    keep: Collection[str] = (),
) -> Evaluation:
    """Predict a split and count, with a progress bar.

    Args:
        session: see `open_session`.
        model: the network to evaluate; left in evaluation mode.
        split: name of the split.
        view: what is predicted from; None takes the network's first.
        keep: names of the images to return for pictures.

    Raises:
        InputError: a file cannot be read (data.on_error=raise), or none could be.
    """
    dataset = session.dataset
    batches = eval_batches(dataset, split, session.transform, session.loading)
    counter = RegionCounter(len(dataset.classes), session.regions)
    counted: dict[str, np.ndarray] = {}
    kept: list[Example] = []
    with progress() as display:
        task = display.add_task(split, total=len(dataset.names(split)), note="images")
        for found in predictions(model, batches, session.fabric, view):
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
    absent = regions.absent
    whole, by_region = counts.whole(), counts.by_region()
    region_ious = scores.miou(by_region, absent)
    parts = {part: scores.miou(sub.whole(), absent) for part, sub in counts.parts().items()}
    return ResultTables(
        split=counts.split,
        step=step,
        region_names=tuple(f"{regions.partition}_{n + 1}" for n in range(len(by_region))),
        regions=RegionTable(
            row_label=label,
            region_ious=tuple(map(float, region_ious)),
            miou=float(scores.miou(whole, absent)),
            variance=float(scores.variance(region_ious)),
        ),
        classes=ClassTable(
            names=counts.classes,
            ious=tuple(map(float, scores.iou(whole, absent))),
            accuracies=tuple(map(float, scores.recall(whole, absent))),
            region_ious=tuple(tuple(map(float, row)) for row in scores.iou(by_region, absent).T),
            subset_mious={part: float(value) for part, value in parts.items()},
        ),
    )


def legend_of(dataset: MFNet) -> Legend:
    """Classes of a data set and their colours."""
    return Legend(dataset.classes, np.array(dataset.palette, np.uint8))


def panel_names(dataset: MFNet, split: str) -> tuple[str, ...]:
    """The first images of a split, half by day and half by night where it holds both."""
    names = dataset.names(split)
    at_night = dataset.nights(names) or (False,) * len(names)
    night = [name for name, dark in zip(names, at_night, strict=True) if dark]
    day = [name for name, dark in zip(names, at_night, strict=True) if not dark]
    num_day = min(len(day), max(NUM_PANELS // 2, NUM_PANELS - len(night)))
    return tuple(day[:num_day] + night[: NUM_PANELS - num_day])
