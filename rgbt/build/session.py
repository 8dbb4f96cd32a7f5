"""The objects of a run made from its configuration."""

from __future__ import annotations

import hashlib
import json
import logging
import os
from dataclasses import dataclass
from typing import Any

import torch
from lightning_fabric import Fabric
from omegaconf import DictConfig
from torch import nn

from rgbt.build.contracts import check_dataset, is_own, watch_model
from rgbt.build.initial_weights import start
from rgbt.checkpoints.report import Report
from rgbt.checks import InputError
from rgbt.config.schema import build
from rgbt.data.cache.dataset import decoded_dataset
from rgbt.data.dataset import LabelledDataset
from rgbt.data.domains import Domains
from rgbt.data.label_map import LabelMap
from rgbt.data.loaders import LoaderSettings
from rgbt.engine.allocator import keep_memory
from rgbt.engine.settings import TrainerSettings
from rgbt.engine.threads import fix_threads
from rgbt.metrics.metric import Regions
from rgbt.randomness import derive
from rgbt.transforms.view_sets import ViewSets


@dataclass(frozen=True)
class Session:
    """What every command needs, built once.

    Attributes:
        config: the composed configuration, checked.
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

    config: DictConfig
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


def open_session(config: DictConfig, label_map: LabelMap | None = None) -> Session:
    """Build data set, transform and network; nothing is trained or evaluated yet.

    Weights are drawn from (seed, "weights") without touching the global generator; those that
    `model.weights` names replace them.

    Args:
        config: composed and checked.
        label_map: from the classes of the network to those of the data set, where they differ.

    Raises:
        InputError: settings that do not fit each other, the machine or the file of weights.
    """
    keep_memory()
    trainer: TrainerSettings = build(config.trainer)
    fix_threads(trainer.threads)
    fabric = _fabric(trainer)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(derive(config.seed, "weights"))
        model: nn.Module = build(config.model)
    loading: LoaderSettings = build(config.data)
    files: LabelledDataset = build(config.dataset)
    if is_own(files):
        check_dataset(files)
    dataset = decoded_dataset(files, loading.cache, num_threads=len(os.sched_getaffinity(0)))
    _check_classes(config, dataset, label_map)
    if is_own(model):
        watch_model(model, config.model.get("num_classes", dataset.num_classes))
    weights = start(model, config)
    return Session(
        config=config,
        dataset=dataset,
        domains=build(config.domains),
        transform=build(config.transform),
        loading=loading,
        regions=build(config.metric),
        consistency=build(config.consistency),
        trainer=trainer,
        fabric=fabric,
        model=model.to(fabric.device),
        weights=weights,
    )


def _check_classes(
    config: DictConfig, dataset: LabelledDataset, label_map: LabelMap | None
) -> None:
    num_classes = config.model.get("num_classes", dataset.num_classes)
    if label_map is not None:
        label_map.check(num_classes, tuple(dataset.classes), dataset.name)
    elif num_classes != dataset.num_classes:
        raise InputError(
            f"model.num_classes is {num_classes} but {dataset.name} has {dataset.num_classes} "
            "classes; leave it to the data set, or let rgbt.predict map the classes of a network "
            "that was trained on others with label_map=..."
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


def names_key(session: Session) -> str:
    """SHA-256 in hexadecimal over the names of the training splits and of the test split.

    Raises:
        InputError: a split is missing.
    """
    domains = (domain.split for domain in session.domains.named.values())
    lists = {split: session.dataset.names(split) for split in (*domains, "test")}
    return hashlib.sha256(json.dumps(lists).encode()).hexdigest()
