"""Build and check the objects of a training before anything is written."""

from __future__ import annotations

from collections.abc import Collection
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache, cached_property, partial
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from lightning_fabric import Fabric
from numpy.typing import NDArray
from torch import nn

from rgbt.assembly.contracts import CheckedLoss, check_part, is_own
from rgbt.assembly.session import Session, open_session
from rgbt.assembly.trial import Lists, first_readable, try_parts
from rgbt.checks import InputError
from rgbt.data.domains import GIVEN, NONE, Domain
from rgbt.data.file_dataset import FileDataset
from rgbt.data.labels import classes_in, of_one_class
from rgbt.data.loaders import Batches, PairedBatches, steps_per_epoch, train_batches
from rgbt.dataset import LabelledDataset, reader_of
from rgbt.engine.batch_norm import check_batch_norm_parts, synchronise_batch_norm
from rgbt.engine.device import prepare_training
from rgbt.engine.fabric import open_fabric
from rgbt.engine.schedules import Schedule
from rgbt.engine.settings import TrainerSettings
from rgbt.processes import num_processes
from rgbt.randomness import derive, numpy_generator
from rgbt.requirements import (
    NetworkRecord,
    Record,
    SchemeRecord,
    TransformRecord,
    check_requirements,
    record_of,
)
from rgbt.runs.folder import read_marker
from rgbt.runs.needs import missing_files
from rgbt.runs.run_spec import WEIGHTS, RunSpec, labels_key
from rgbt.terminal import info
from rgbt.types import Sample

if TYPE_CHECKING:  # most runs have one domain, draw no classes, and train a network of this package
    from rgbt.data.rare_classes import RareClasses

# Images of a split whose headers are read for the range of their sizes, in about 0.2 seconds.
MOST_HEADERS = 1000

Hw = tuple[int, ...]


@dataclass(frozen=True)
class TrainingSetup:
    """The objects of a training, before anything is written.

    Attributes:
        datasets: of each domain, with the labels that it is trained with.
        model: the network as Fabric wrapped it.
        others: further networks that are trained, wrapped, by name.
        optimizers: by the names that the scheme's phases use.
        absent: sentences about classes that no label of a split shows.
        rare: how images of the source are drawn by class; None: each once per epoch.
    """

    session: Session
    fabric: Fabric
    datasets: dict[str, LabelledDataset]
    model: nn.Module
    others: dict[str, nn.Module]
    optimizers: dict[str, torch.optim.Optimizer]
    rare: RareClasses | None
    scheme: Any
    schedule: Schedule
    absent: tuple[str, ...]

    @cached_property
    def steps_per_epoch(self) -> int:
        """Batches of one epoch of the source."""
        split = self.session.domains.source.split
        return steps_per_epoch(self.datasets["source"], self.session.loading, split)

    @cached_property
    def sizes(self) -> dict[str, str]:
        """Of images as stored, trained and predicted: "480x640", "479x637 to 480x640".

        Of files, the headers of `MOST_HEADERS` images of each split are read, evenly spread.
        """
        session, of_split = self.session, _stored_sizes(self.session)
        train, test = of_split[session.domains.source.split], of_split["test"]
        rng, transform = numpy_generator(session.spec.seed_of("order"), "probe"), session.transform
        trained = [transform.train(_black(hw), rng) for hw in (min(train), max(train))]
        tested = [transform.test(_black(hw)) for hw in (min(test), max(test))]
        is_part = max(map(len, session.names.values())) > MOST_HEADERS
        some = f" (of {MOST_HEADERS} images a split)" if is_part else ""
        return {
            "stored": f"{_in_words(set[Hw]().union(*of_split.values()))}{some}",
            "trained": _in_words({example.thermal.shape for example in trained}),
            "predicted": _in_words({example.thermal.shape for example in tested}),
        }

    def batches(self, steps: range) -> Batches | PairedBatches:
        """Training batches of these steps: of one domain, or a pair of batches of both."""
        session, seed = self.session, self.session.spec.seed_of("order")
        loading = session.loading
        data, split = self.datasets["source"], session.domains.source.split
        source = train_batches(data, split, session.transform, loading, seed, steps, self.rare)
        target = session.domains.named.get("target")
        if target is None:
            return source
        transform = record_of(session.transform, TransformRecord).for_target or session.transform
        seed = derive(seed, "target domain")  # shuffled and augmented by draws of its own
        data = self.datasets["target"]
        second = train_batches(data, target.split, transform, loading, seed, steps, None)
        every = session.trainer.accumulate
        return PairedBatches(source, second, first=steps.start, per_step=every)


def _stored_sizes(session: Session) -> dict[str, set[Hw]]:
    """Read sizes of the images of each split; of those that are no files, of the first one."""
    reader = reader_of(session.dataset)
    size_of = reader.stored_hw if isinstance(reader, FileDataset) else None
    found: dict[str, set[Hw]] = {}
    for split, names in session.names.items():
        sizes = found[split] = set()
        for name in names[:: -(-len(names) // MOST_HEADERS)]:
            with suppress(InputError):  # the training reports what it cannot read
                sizes |= {size_of(name)} if size_of else set()
        if not sizes:
            sizes.add(first_readable(session, names).thermal.shape)
    return found


def _in_words(sizes: Collection[Hw]) -> str:
    ends = dict.fromkeys((min(sizes), max(sizes)))
    return " to ".join("x".join(map(str, hw)) for hw in ends)


def _black(hw: Hw) -> Sample:
    plane = np.zeros(hw, np.uint8)
    return Sample(rgb=np.dstack([plane] * 3), thermal=plane, label=plane, name="")


def _class_pixels(session: Session, domain: Domain) -> NDArray[np.int64]:
    """Count pixels of each class in each label of the source's split, (N, K); unlabelled: 0."""
    if domain.labels != GIVEN:
        raise InputError(
            f"loss.class_weights: expected numbers; weights are computed from labels of the data "
            f"set, but domains.source.labels is {domain.labels}."
        )
    from rgbt.data.rare_classes import class_pixels  # most runs count no classes

    return class_pixels(session.dataset, domain.split)


def validate(spec: RunSpec) -> None:
    """Build all but what unfinished upstream runs will write; errors as of `set_up_training`."""
    for name in spec.domains.named:
        teacher = spec.dependency(labels_key(name))
        if teacher is not None:
            with torch.device("meta"):
                network = teacher.run.model.build()
            check_requirements({"domains": spec.domains, f"network of {teacher.key}": network})
    set_up_training(spec, upstream_finished=False)


def set_up_training(spec: RunSpec, *, upstream_finished: bool = True) -> TrainingSetup:
    """Build everything and read all lists of images of the run, so that errors come first.

    Where not `upstream_finished`, weights and pseudo-labels of upstream runs are left out.
    InputError: settings that do not fit each other, the machine or the data.
    """
    missing = () if upstream_finished else [upstream.key for upstream in spec.dependencies]
    fabric = open_fabric(spec.trainer)
    # A run that resumes reads its images as before, whatever was added to them.
    started = None if spec.fresh else read_marker(spec.folder)
    session = open_session(
        spec,
        load_weights=WEIGHTS not in missing,
        device=fabric.device,
        thermal_range=None if started is None else started.get("thermal_range"),
    )
    session = replace(session, run=spec.key)
    domains, loading = session.domains, session.loading
    # Read at most once, by the first loss that asks for it.
    pixels = cache(partial(_class_pixels, session, domains.source))
    built = spec.build("masker", "loss", "optimizer", "schedule", class_pixels=pixels)
    masker, loss = built["masker"], built["loss"]
    checked = CheckedLoss(loss) if is_own(loss) else loss
    _share_batch_norm(session.model, session.trainer)
    prepare_training(session.model, session.trainer)
    model = fabric.setup_module(session.model)
    collaborators = {"model": model, "loss": checked, "masker": masker, "domains": domains}
    with torch.random.fork_rng(devices=[]):
        # For networks of the scheme.
        torch.manual_seed(derive(spec.seed_of("weights"), "scheme weights"))
        scheme: Any = spec.scheme.build(**collaborators, dataset=session.dataset)
    check_part("scheme", scheme)
    components = {
        "scheme": scheme,
        "loss": loss,
        "domains": domains,
        "model": session.model,
        "masker": masker,
        "transform": session.transform,
        "data": loading,
        "dataset": session.dataset,
        "consistency": session.consistency,
        WEIGHTS: SimpleNamespace(record=Record(others={"pretrained": spec.weights is not None})),
    }
    records = check_requirements(components)
    names = session.names
    datasets = {}
    for name, domain in domains.named.items():
        steps_per_epoch(session.dataset, loading, domain.split)
        is_missing = bool(missing) and labels_key(name) in missing
        datasets[name] = session.dataset if is_missing else _labelled(session, name, domain, names)
    try_parts(session, names, masker, records)
    absent = _absent_classes(session, names)
    if upstream_finished:
        _report_unpublished_settings(session, names)
    rare = None
    if loading.sampling == "rare_classes" and labels_key("source") not in missing:
        from rgbt.data.rare_classes import count_rare_classes  # most runs draw no classes

        rare = count_rare_classes(datasets["source"], domains.source.split, loading)
    others, optimizers = _networks_and_optimizers(
        session, built["optimizer"], fabric, records["scheme"]
    )
    return TrainingSetup(
        session=session,
        fabric=fabric,
        datasets=datasets,
        model=model,
        others=others,
        optimizers=optimizers,
        rare=rare,
        scheme=scheme,
        schedule=built["schedule"],
        absent=absent,
    )


def _absent_classes(session: Session, names: Lists) -> tuple[str, ...]:
    """Say what no label of a split shows; InputError: one class beside a 255 that may be one."""
    dataset, reader = session.dataset, reader_of(session.dataset)
    unread = {domain.split for domain in session.domains.named.values() if domain.labels != GIVEN}
    every = np.zeros(dataset.num_classes + 1, np.int64)
    lines: dict[str, list[str]] = {}
    for split in [split for split in names if split == "test" or split not in unread]:
        pixels, is_whole = classes_in(dataset, names[split], session.loading.on_error)
        every += pixels
        shown = zip(dataset.classes, pixels.tolist(), strict=False)
        absent = [name for name, number in shown if not number and name not in dataset.unscored]
        if absent and is_whole and pixels.any():
            text = (
                of_one_class(pixels, dataset.classes, None) or f"no label shows {', '.join(absent)}"
            )
            lines.setdefault(text, []).append(split)
    codes = reader.codes if isinstance(reader, FileDataset) else None
    fault = of_one_class(every, dataset.classes, codes)
    if fault and codes is not None and codes.assumed and every[-1]:
        raise InputError(f"{dataset.name}: {fault}.")
    return tuple(f"{', '.join(splits)}: {text}" for text, splits in lines.items())


def _shared_with_test(names: Lists, split: str) -> int:
    """Return the number of test images in a split."""
    return len(set(names[split]) & set(names["test"]))


def _report_unpublished_settings(session: Session, names: Lists) -> None:
    """Report settings that are valid, but not those of the published numbers."""
    spec, name = session.spec, session.dataset.name
    expected = spec.scale.pretrained and record_of(session.model, NetworkRecord).pretrained_parts
    if expected and session.weights is None:
        files = " or ".join(missing_files(spec)) or "a file"
        info(
            "the published recipe starts from ImageNet weights, but this run starts from random "
            f"weights. Get {files}, and name it with pretrained=..., or expect lower scores than "
            "published."
        )
    meant = spec.recipe.dataset
    if spec.scale.name == "paper" and meant != name:
        info(
            f"the image sizes, batch size and steps of this recipe were published for {meant}, not "
            f"for {name}; choose another recipe=..., or set them and recipe.dataset={name}."
        )
    picked = session.trainer.selection_split
    is_selected = session.trainer.tested == "best" and session.selection_split is not None
    trained = set(names[session.domains.source.split])
    if is_selected and (common := len(trained & set(names[picked]))):
        info(
            f"trainer.selection_split={picked}: {common} of its {len(names[picked])} images are "
            "trained on."
        )
    is_selected = session.trainer.tested == "best" and picked != "test"
    if is_selected and (shared := _shared_with_test(names, picked)):
        info(
            f"trainer.selection_split={picked}: the best checkpoint is selected on {shared} test "
            "images."
        )


def _labelled(session: Session, name: str, domain: Domain, names: Lists) -> LabelledDataset:
    """Return the data set with the labels that a domain is trained with; InputError without them.

    Reports training images of the test split.
    """
    dataset, key, split = session.dataset, f"domains.{name}", domain.split
    if domain.labels == GIVEN:
        if first_readable(session, names[split]).label is None:
            raise InputError(f"{key}.labels=given, but {dataset.name} has no labels for {split}.")
        if shared := _shared_with_test(names, split):
            info(
                f"{key}.split={split}: {shared} of its images are test images, so test scores will "
                "not measure performance on unseen images."
            )
        return dataset
    from rgbt.data.pseudo_labels import PseudoLabelled, Unlabelled  # a source has its own labels

    folder = session.spec.labels_folder(name)
    if domain.labels == NONE or folder is None:
        return Unlabelled(dataset)
    found = PseudoLabelled(dataset, folder, with_confidence=domain.confidence)
    listed = names[split]
    missing, manifest = found.labels.missing(listed), found.labels.manifest
    if missing and (session.loading.on_error == "raise" or len(missing) == len(listed)):
        raise InputError(
            f"{key}.labels: {folder} has no pseudo-labels for {len(missing)} of the {len(listed)} "
            f"images of {split}, such as '{missing[0]}'."
        )
    if manifest["kept"] == 0:
        raise InputError(
            f"{key}.labels: {folder} does not label any pixel, because its threshold of "
            f"{manifest['threshold']:g} was above every confidence."
        )
    is_ours = domain.labels.startswith("experiment:")
    if is_ours and manifest["fingerprint"] != dataset.fingerprint():
        raise InputError(
            f"{key}.labels: {folder} was predicted on other files of {dataset.name} than those in "
            f"{dataset.root}."
        )
    return found


def _share_batch_norm(network: nn.Module, trainer: TrainerSettings) -> None:
    """Let the processes of a run normalise their batch together, unless each has its own part."""
    number = num_processes()
    check_batch_norm_parts(trainer.batch_norm_parts, number)
    if number > 1 and trainer.batch_norm_parts == 1:
        synchronise_batch_norm(network)


def _networks_and_optimizers(
    session: Session, builder: Any, fabric: Fabric, record: SchemeRecord
) -> tuple[dict[str, nn.Module], dict[str, torch.optim.Optimizer]]:
    """Wrap further networks of a scheme in place, and make all optimisers by their `builder`."""
    parts, others = record.optimizers, record.networks
    built = {name: builder(session.model, without=without) for name, without in parts.items()}
    for name in record.builders:
        _share_batch_norm(others[name], session.trainer)
        built[name] = record.builders[name](others[name])
        others[name] = fabric.setup_module(others[name])
    wrapped: Any = {name: fabric.setup_optimizers(optimizer) for name, optimizer in built.items()}
    return others, wrapped
