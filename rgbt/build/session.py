"""Build the objects that every command needs from the specification of a run."""

from __future__ import annotations

import hashlib
import json
import logging
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import torch
from lightning_fabric import Fabric
from lightning_fabric.plugins.environments.lightning import LightningEnvironment
from torch import nn

from rgbt.build.contracts import check_dataset, is_own, watch_model
from rgbt.build.initial_weights import start_from_weights
from rgbt.build.requirements import check_requirements
from rgbt.checkpoints.report import Report
from rgbt.checks import InputError
from rgbt.data.cache.dataset import cached_dataset
from rgbt.data.domains import Domains
from rgbt.data.label_map import LabelMap
from rgbt.data.loader_settings import LoaderSettings
from rgbt.dataset import LabelledDataset
from rgbt.engine.allocator import keep_memory
from rgbt.engine.network_settings import place
from rgbt.engine.prediction import Prediction
from rgbt.engine.settings import TrainerSettings
from rgbt.engine.threads import fix_threads
from rgbt.metrics.metric import Regions
from rgbt.processes import num_processes
from rgbt.randomness import derive
from rgbt.runtime.group import Group, group_from_environment
from rgbt.spec.run_spec import RunSpec
from rgbt.transforms.view_sets import ViewSets


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
        prediction: windows and mirrored images of a prediction, and the size where it is counted.
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
    prediction: Prediction
    consistency: ViewSets
    trainer: TrainerSettings
    fabric: Fabric
    model: nn.Module
    weights: Report | None

    @property
    def selection_split(self) -> str | None:
        """The split that is evaluated during training.

        None where the data set has no image of it and the last checkpoint is tested: that one is
        not selected, so nothing is evaluated before the test.

        Raises:
            InputError: the split is unknown.
        """
        split = self.trainer.selection_split
        is_needed = self.trainer.tested == "best" or self.dataset.has(split)
        return split if is_needed else None


def open_session(
    spec: RunSpec,
    label_map: LabelMap | None = None,
    *,
    load_weights: bool = True,
    network: nn.Module | None = None,
) -> Session:
    """Build data set, transform and network; nothing is trained or evaluated yet.

    Weights are drawn from (seed, "weights") without touching the global generator; those that
    `model.weights` names replace them.

    Args:
        spec: the run.
        label_map: from the classes of the network to those of the data set, where they differ.
        load_weights: False: `model.weights` is left out, because an upstream run is not finished.
        network: used as it is; None: it is built from the settings.

    Raises:
        InputError: settings that do not fit each other, the machine or the file of weights.
    """
    keep_memory()
    fix_threads(spec.trainer.threads)
    trainer = spec.trainer
    fabric = open_fabric(trainer)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(derive(spec.drawn.weights, "weights"))
        model: nn.Module = spec.model.build() if network is None else network
    files: LabelledDataset = spec.dataset.build()
    if is_own(files):
        check_dataset(files)
    dataset = cached_dataset(files, spec.data.cache, num_threads=len(os.sched_getaffinity(0)))
    num_classes = spec.model.values.get("num_classes", dataset.num_classes)
    if label_map is not None:
        label_map.check(num_classes, tuple(dataset.classes), dataset.name)
    elif num_classes != dataset.num_classes:
        raise InputError(
            f"model.num_classes is {num_classes} but {dataset.name} has {dataset.num_classes} "
            "classes; omit model.num_classes to take the number from the data set. For a network "
            "that was trained on other classes, `rgbt predict` can map them with label_map=..."
        )
    if is_own(model):
        watch_model(model, num_classes)
    check_requirements({"prediction": spec.prediction, "model": model}, spec.plain)
    weights = start_from_weights(model, spec) if load_weights and network is None else None
    return Session(
        spec=spec,
        dataset=dataset,
        domains=spec.domains,
        transform=spec.transform.build(),
        loading=spec.data,
        regions=spec.metric.build(),
        prediction=spec.prediction,
        consistency=spec.consistency.build(),
        trainer=trainer,
        fabric=fabric,
        model=place(model, fabric.device, trainer),
        weights=weights,
    )


def open_fabric(trainer: TrainerSettings) -> Fabric:
    """Device and precision of a run.

    One device, except in a process that trains a run together with others: then its own device.

    Raises:
        InputError: the machine has no such device, or it does not support the precision.
    """
    group = group_from_environment() if num_processes() > 1 else None
    if group is not None:
        return connect(trainer, group)
    with _refusing_device(trainer):
        # Otherwise Fabric reads the variables of SLURM, also for a command that runs alone.
        return Fabric(
            accelerator=trainer.accelerator,
            devices=1,
            precision=trainer.precision,
            plugins=[LightningEnvironment()],
        )


def connect(trainer: TrainerSettings, group: Group) -> Fabric:
    """Device and precision of this process of a group, which is connected with the others.

    Raises:
        InputError: as `open_fabric`; the machine has fewer devices than processes.
    """
    from rgbt.engine.fabric import group_fabric  # not needed with one device

    with _refusing_device(trainer):
        return group_fabric(trainer, group)


@contextmanager
def _refusing_device(trainer: TrainerSettings) -> Iterator[None]:
    # Fabric sets itself to INFO when imported, and would say in a line what the configuration says.
    logging.getLogger("lightning_fabric").setLevel(logging.WARNING)
    try:
        yield
    except InputError:
        raise
    except (RuntimeError, ValueError) as error:
        raise InputError(
            f"trainer.accelerator={trainer.accelerator} with "
            f"trainer.precision={trainer.precision} cannot be used on this machine "
            f"({str(error).splitlines()[0]}). Choose another accelerator or precision."
        ) from error


def names_key(session: Session) -> str:
    """SHA-256 in hexadecimal over the names of the training splits and of the test split.

    Raises:
        InputError: a split is missing.
    """
    domains = (domain.split for domain in session.domains.named.values())
    lists = {split: session.dataset.names(split) for split in (*domains, "test")}
    return hashlib.sha256(json.dumps(lists).encode()).hexdigest()
