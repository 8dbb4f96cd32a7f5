"""Build the objects that every command needs from the specification of a run."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from omegaconf import OmegaConf
from torch import nn

from rgbt.assembly.contracts import check_dataset, watch_model
from rgbt.checks import InputError
from rgbt.config.compose import compose, flatten
from rgbt.config.stored_config import read_settings
from rgbt.data.cache import CachedDataset
from rgbt.data.domains import Domains
from rgbt.data.file_dataset import FileDataset
from rgbt.data.loader_settings import LoaderSettings
from rgbt.data.thermal import Range
from rgbt.dataset import LabelledDataset, reader_of
from rgbt.engine.device import (
    autocast,
    choose_device,
    fix_threads,
    keep_memory,
    place,
    set_matmul_precision,
)
from rgbt.engine.prediction import Prediction
from rgbt.engine.settings import TrainerSettings
from rgbt.metrics.metric import Regions
from rgbt.randomness import derive
from rgbt.requirements import check_requirements
from rgbt.runs.run_spec import WEIGHTS, RunSpec
from rgbt.terminal import info
from rgbt.transforms.views import ViewSets

if TYPE_CHECKING:  # most runs start at random, and few map classes
    from rgbt.checkpoints.load import Plan
    from rgbt.data.label_map import LabelMap


@dataclass(frozen=True)
class Session:
    """What every command needs, built once.

    Attributes:
        regions: partition of the image and the rule for absent classes.
        consistency: virtual views that TC and CA are measured on, if any.
        model: the network, on the device, not wrapped.
        weights: what it took from a file, None where it is random.
        thermal_range: what `auto` found, in degrees Celsius where the data set has a unit; None:
            another setting.
        step: the optimiser step of trained weights; 0 where none is known.
        folder: of the run whose network it is; of another network, where its evaluations lie.
        label: name of the trained network in tables.
        run: key of the run whose network it is; "" for others.
        digest: SHA-256 of the file of another network and of its settings.
        checkpoint: "best" or "last", of a run.
        changed: what of its measurements differs from the test that the run ends with: keys of
            `measured_settings`, "partition", "dataset".
        dataset_words: overrides that make the data set another one than that of the run.
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
    device: torch.device
    model: nn.Module
    weights: Plan | None
    thermal_range: Range | None = None
    step: int = 0
    folder: Path = Path()
    label: str = ""
    run: str = ""
    digest: str = ""
    checkpoint: str = "best"
    changed: tuple[str, ...] = ()
    dataset_words: tuple[str, ...] = ()

    def autocast(self) -> AbstractContextManager[Any]:
        """Return the context of a forward pass at the precision of the run."""
        return autocast(self.device, self.trainer.precision)

    @cached_property
    def selection_split(self) -> str | None:
        """The split that is evaluated during training.

        None where the data set has no image of it and the last checkpoint is tested.
        """
        split = self.trainer.selection_split
        is_needed = self.trainer.tested == "best" or self.dataset.has(split)
        return split if is_needed else None

    @cached_property
    def names(self) -> dict[str, tuple[str, ...]]:
        """Images of every split that the run reads: training, selection if any, and test."""
        trained = (domain.split for domain in self.domains.named.values())
        splits = dict.fromkeys(filter(None, (*trained, self.selection_split, "test")))
        return {split: self.dataset.names(split) for split in splits}


def open_session(
    spec: RunSpec,
    label_map: LabelMap | None = None,
    *,
    load_weights: bool = True,
    network: nn.Module | None = None,
    device: torch.device | None = None,
    thermal_range: Range | None = None,
) -> Session:
    """Build data set, transform and network; nothing is trained or evaluated yet.

    Args:
        spec: the run.
        label_map: from the classes of the network to those of the data set, where they differ.
        load_weights: False: `model.weights` is left out, because an upstream run is not finished.
        network: used as it is; None: built, with weights drawn from (seed, "weights").
        device: where the network is placed; None: `choose_device` of the settings.
        thermal_range: used where the data set has `auto`; None: found in its training images.

    Raises:
        InputError: settings that do not fit each other, the machine or the file of weights.
    """
    trainer, loading = spec.trainer, spec.data
    keep_memory()
    fix_threads(trainer.threads)
    device = device or choose_device(trainer)
    set_matmul_precision(device, trainer)
    built = spec.build("dataset", "transform", "metric", "consistency")
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(derive(spec.seed_of("weights"), "weights"))
        model: nn.Module = spec.model.build() if network is None else network
    dataset: LabelledDataset = built["dataset"]
    check_dataset(dataset)
    reader = reader_of(dataset)
    found = reader.settle_range(thermal_range) if isinstance(reader, FileDataset) else None
    if loading.cache is not None:
        dataset = CachedDataset(dataset, loading.cache)
    num_classes = spec.model.values.get("num_classes", dataset.num_classes)
    if label_map is not None:
        label_map.check(num_classes, tuple(dataset.classes), dataset.name)
    elif num_classes != dataset.num_classes:
        raise InputError(
            f"model.num_classes is {num_classes} but {dataset.name} has {dataset.num_classes} "
            "classes; `rgbt predict` can map classes with label_map=..."
        )
    watch_model(model, num_classes)
    check_requirements({"prediction": spec.prediction, "model": model})
    weights = start_from_weights(model, spec) if load_weights and network is None else None
    return Session(
        spec=spec,
        dataset=dataset,
        domains=spec.domains,
        transform=built["transform"],
        loading=loading,
        regions=built["metric"],
        prediction=spec.prediction,
        consistency=built["consistency"],
        trainer=trainer,
        device=device,
        model=place(model, device, trainer),
        weights=weights,
        thermal_range=found,
    )


def start_from_weights(model: nn.Module, spec: RunSpec) -> Plan | None:
    """Load the weights that `model.weights` names and report this on stderr; None without weights.

    A second line warns if the network has other inputs or settings than the weights were trained
    with, as far as the file or its layout tells. InputError: the file does not fit.
    """
    source, fresh = spec.weights_path, tuple(spec.model.plain.get("fresh") or ())
    if source is None:
        if fresh:
            raise InputError("model.fresh has no effect without model.weights.")
        return None
    from rgbt.checkpoints.load import load_weights  # most runs start at random

    dependency = spec.dependency(WEIGHTS)
    is_common = dependency is not None and dependency.is_common
    plan = load_weights(model, source, fresh, other_classes=is_common)
    info(f"{plan.sentence()}.")
    node = spec.model.plain
    others = differences(node, plan.convention)
    noted, own = plan.inputs, node.get("inputs")
    beside = source.parent / "config.yaml"  # where the file is a checkpoint of a run
    if noted is None and plan.is_own and beside.is_file():
        noted = read_settings(beside).get("model", {}).get("inputs")
    if not others and None not in (noted, own) and noted != own:
        others.append("other inputs")
    if others:
        info(
            f"{source} was trained with {' '.join(others)}, but this network has other settings: "
            "its scores will differ from those of the trained network."
        )
    return plan


def differences(node: Mapping[str, Any], convention: Iterable[str]) -> list[str]:
    """Return which overrides, such as "model/inputs=unit", would change the network of a `node`."""
    return [override for override in convention if not _holds(node, override)]


def _holds(node: Mapping[str, Any], override: str) -> bool:
    key, _, text = override.partition("=")
    if key == "model/inputs":
        inputs = OmegaConf.to_container(compose([override]).model.inputs, resolve=True)
        return bool(node["inputs"] == inputs)
    try:
        value = json.loads(text)
    except json.JSONDecodeError:
        value = text
    return bool(node.get(key.removeprefix("model."), value) == value)


def measured_settings(plain: Mapping[str, Any]) -> dict[str, Any]:
    """Return the settings that decide how images are predicted, by dotted key."""
    nodes = {key: plain[key] for key in ("transform", "prediction")}
    nodes["trainer"] = {"precision": plain["trainer"]["precision"]}
    nodes["data"] = {"eval_batch_size": plain["data"]["eval_batch_size"]}
    return flatten(nodes)


def reader_settings(dataset: LabelledDataset) -> dict[str, Any]:
    """Return the settings of a data set that change the pixels of its files, by dotted key."""
    found = {f"dataset.{key}": value for key, value in dataset.decoding().items()}
    found.pop("dataset.layouts", None)  # which files these are, says the fingerprint
    if "dataset.codes" in found:  # numbers in label files, a setting of this name
        found["dataset.ids"] = found.pop("dataset.codes")
    return found


def names_key(session: Session) -> str:
    """Return the SHA-256 over the names of the training splits and of the test split."""
    domains = (domain.split for domain in session.domains.named.values())
    lists = {split: session.names[split] for split in (*domains, "test")}
    return hashlib.sha256(json.dumps(lists).encode()).hexdigest()
