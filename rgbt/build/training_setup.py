"""Build and check the objects of a training before anything is written."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal

import torch
from torch import nn

from rgbt.build.contracts import CheckedLoss, CheckedScheme, is_own
from rgbt.build.initial_weights import InitialWeights
from rgbt.build.probes import (
    check_cameras,
    check_cells,
    check_external,
    check_own_parts,
    first_readable,
)
from rgbt.build.requirements import check_requirements
from rgbt.build.session import Session, open_session
from rgbt.checks import InputError
from rgbt.config.compose import available
from rgbt.data.domains import GIVEN, NONE, Domain
from rgbt.data.loaders import Batches, steps_per_epoch, train_batches
from rgbt.data.pairs import PairedBatches
from rgbt.data.pseudo_labels import PseudoLabelled, Unlabelled
from rgbt.data.rare_classes import RareClasses, count_rare_classes
from rgbt.dataset import LabelledDataset
from rgbt.engine.network_settings import prepare_training
from rgbt.engine.schedules import Schedule
from rgbt.engine.settings import TrainerSettings
from rgbt.engine.trainer import Scheme
from rgbt.processes import num_processes
from rgbt.randomness import derive
from rgbt.requirements import record_of
from rgbt.spec.run_spec import WEIGHTS, RunSpec, labels_key
from rgbt.tracking.terminal import info
from rgbt.types import AnyMasker, Loadable


@dataclass(frozen=True)
class TrainingSetup:
    """The objects of a training, before anything is written.

    Attributes:
        session: data, transform, network.
        datasets: of each domain, with the labels that it is trained with.
        model: the network as Fabric wrapped it.
        others: further networks that are trained, wrapped, by name.
        optimizers: by the names that the scheme's phases use.
        rare: how images of the source are drawn by class; None: each once per epoch.
        scheme: yields the phases of a step.
        schedule: learning rate factor per step.
    """

    session: Session
    datasets: dict[str, LabelledDataset]
    model: nn.Module
    others: dict[str, nn.Module]
    optimizers: dict[str, torch.optim.Optimizer]
    rare: RareClasses | None
    scheme: Scheme
    schedule: Schedule

    def splits(self) -> dict[str, str]:
        """Domain -> split that it is trained on."""
        return {name: domain.split for name, domain in self.session.domains.named.items()}

    def read_splits(self) -> tuple[str, ...]:
        """Every split that the run reads: of the training, of the selection if any, of the test."""
        splits = (*self.splits().values(), self.session.selection_split, "test")
        return tuple(dict.fromkeys(filter(None, splits)))

    def steps_per_epoch(self) -> int:
        """Batches of one epoch of the source."""
        return steps_per_epoch(
            self.datasets["source"], self.session.loading, self.splits()["source"]
        )

    def batches(self, steps: range) -> Batches[Loadable] | PairedBatches:
        """Training batches of these steps: of one domain, or a pair of batches of both."""
        session, seed = self.session, self.session.spec.drawn.order
        loading = replace(session.loading, augment=_where_to_augment(session))
        # Each domain is shuffled and augmented by draws of its own.
        seeds = {"source": seed, "target": derive(seed, "target domain")}
        transforms = {"source": session.transform, "target": session.transform}
        transforms["target"] = record_of(session.transform).for_target or session.transform
        found = [
            train_batches(
                *(self.datasets[name], split, transforms[name], loading),
                *(seeds[name], steps),
                self.rare if name == "source" else None,
            )
            for name, split in self.splits().items()
        ]
        if len(found) == 1:
            return found[0]
        return PairedBatches(*found, first=steps.start, per_step=session.trainer.accumulate)


def validate(spec: RunSpec) -> None:
    """Build everything once, so that errors are reported before the upstream runs are trained.

    Raises:
        InputError: as `set_up_training`; what unfinished upstream runs will write is left out.
    """
    for name in spec.domains.named:
        teacher = spec.dependency(labels_key(name))
        if teacher is not None:
            with torch.device("meta"):
                network = teacher.run.model.build()
            check_requirements(
                {"domains": spec.domains, f"network of {teacher.key}": network}, spec.plain
            )
    set_up_training(spec, upstream_finished=False)


def set_up_training(spec: RunSpec, *, upstream_finished: bool = True) -> TrainingSetup:
    """Build everything and read all lists of images of the run, so that errors come first.

    Args:
        spec: the run.
        upstream_finished: False: weights and pseudo-labels of upstream runs do not exist yet and
            are left out.

    Raises:
        InputError: settings that do not fit each other, the machine or the data.
    """
    missing = () if upstream_finished else [each.key for each in spec.dependencies]
    session = open_session(spec, load_weights=WEIGHTS not in missing)
    domains = session.domains
    masker: AnyMasker = spec.masker.build()
    loss = spec.loss.build()
    checked = CheckedLoss(loss) if is_own(loss) else loss
    _share_batch_norm(session.model, session.trainer)
    prepare_training(session.model, session.trainer, session.fabric.device)
    model = session.fabric.setup_module(session.model)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(derive(spec.drawn.weights, "scheme weights"))  # of networks of its own
        scheme: Any = spec.scheme.build(
            **{"model": model, "loss": checked, "masker": masker, "domains": domains},
            dataset=session.dataset,
        )
    components = {
        **{"scheme": scheme, "loss": loss, "domains": domains, "model": session.model},
        **{"masker": masker, "transform": session.transform, "data": session.loading},
        **{"dataset": session.dataset, "consistency": session.consistency},
        WEIGHTS: InitialWeights(spec.weights),
    }
    check_requirements(components, spec.plain)
    _check_splits(session)
    datasets = {
        name: session.dataset if labels_key(name) in missing else _labelled(session, name, domain)
        for name, domain in domains.named.items()
    }
    for name, domain in domains.named.items():
        steps_per_epoch(datasets[name], session.loading, domain.split)
        _check_labelled(session, name, domain)
    check_own_parts(session)
    check_external(session)
    check_cells(session, masker)
    check_cameras(session, scheme)
    if upstream_finished:
        _report_unpublished_settings(session)
    rare = None
    if session.loading.sampling == "rare_classes" and labels_key("source") not in missing:
        rare = count_rare_classes(datasets["source"], domains.source.split, session.loading)
    others, optimizers = _networks_and_optimizers(session, scheme)
    scheme = CheckedScheme(scheme, tuple(optimizers)) if is_own(scheme) else scheme
    return TrainingSetup(
        session, datasets, model, others, optimizers, rare, scheme, spec.schedule.build()
    )


def _check_splits(session: Session) -> None:
    """Read the lists of all splits of the run, so that one without images is refused first."""
    for domain in session.domains.named.values():
        session.dataset.names(domain.split)
    split = session.selection_split
    try:
        if split is not None:
            session.dataset.names(split)
    except InputError as error:
        if session.trainer.tested == "last":
            raise
        raise InputError(
            f"trainer.tested=best selects the checkpoint on {split}: {error} Or set "
            "trainer.tested=last, which selects none."
        ) from error
    session.dataset.names("test")


def _report_unpublished_settings(session: Session) -> None:
    """Report settings that are valid, but not those of the published numbers."""
    spec, data = session.spec, session.dataset
    expected: object = spec.scale.pretrained and record_of(session.model).pretrained_parts
    if expected and session.weights is None:
        info(
            "the published recipe starts from ImageNet weights, but this run starts from random "
            "weights. Name a file with pretrained=..., or expect lower scores than published."
        )
    meant = spec.recipe.dataset
    if spec.scale.name == "paper" and meant != data.name:
        known = data.name in available("recipe")
        info(
            f"the image sizes, batch size and steps of this recipe were published for {meant}, "
            f"not for {data.name}; "
            + (f"choose recipe={data.name}, or " if known else "")
            + "set recipe.train_sizes, crop_hw, batch_size, max_steps and eval_every, then "
            f"recipe.dataset={data.name}."
        )
    picked = session.trainer.selection_split
    if session.trainer.tested == "best" and picked != "test":
        shared = set(data.names(picked)) & set(data.names("test"))
        if shared:
            info(
                f"trainer.selection_split={picked}: {len(shared)} of its "
                f"{len(data.names(picked))} images are test images, so the best checkpoint is "
                "selected on images that are also reported."
            )


def _where_to_augment(session: Session) -> Literal["loader", "device"]:
    """What `LoaderSettings.augment` comes to on this device with this transform."""
    requested = session.loading.augment
    if requested == "auto":
        redraws = session.loading.sampling == "rare_classes"  # crops, by their labels
        can = record_of(session.transform).works_on_batches and not redraws
        return "device" if can and session.fabric.device.type == "cuda" else "loader"
    return requested


def _labelled(session: Session, name: str, domain: Domain) -> LabelledDataset:
    """The data set with the labels that a domain is trained with."""
    folder = session.spec.labels_folder(name)
    if folder is not None:
        found = PseudoLabelled(session.dataset, folder, with_confidence=domain.confidence)
        listed = session.dataset.names(domain.split)
        missing = found.labels.missing(listed)
        if missing and (session.loading.on_error == "raise" or len(missing) == len(listed)):
            raise InputError(
                f"domains.{name}.labels: {folder} has no pseudo-labels for {len(missing)} of the "
                f"{len(listed)} images of {domain.split}, such as '{missing[0]}'. Predict that "
                "split."
            )
        if found.labels.manifest["kept"] == 0:
            raise InputError(
                f"domains.{name}.labels: {folder} does not label any pixel, because its threshold "
                f"of {found.labels.manifest['threshold']:g} was above every confidence. Predict "
                "again with a lower threshold."
            )
        made_on = found.labels.manifest["fingerprint"]
        if domain.labels.startswith("experiment:") and made_on != session.dataset.fingerprint():
            raise InputError(
                f"{folder} was predicted on other files of {session.dataset.name} than those in "
                f"{session.dataset.root}. Choose another folder of runs (runs_dir=...), or remove "
                "the pseudo-labels to predict again."
            )
        return found
    return Unlabelled(session.dataset) if domain.labels == NONE else session.dataset


def _check_labelled(session: Session, name: str, domain: Domain) -> None:
    """Refuse labels that the data set does not have; report training images of the test split."""
    if domain.labels != GIVEN:
        return
    if first_readable(session, domain.split).label is None:
        raise InputError(
            f"domains.{name}.labels=given, but {session.dataset.name} has no labels for "
            f"{domain.split}. Name pseudo-labels (experiment:thermal_teacher/best.pt), or set it "
            "to none."
        )
    shared = set(session.dataset.names(domain.split)) & set(session.dataset.names("test"))
    if shared:
        info(
            f"domains.{name}.split={domain.split}: {len(shared)} of its images are test images, "
            "so test scores will not measure performance on unseen images."
        )


def _share_batch_norm(network: nn.Module, trainer: TrainerSettings) -> None:
    """Let the processes of a run normalise their batch together, unless each has its own part."""
    if num_processes() == 1:
        return
    from rgbt.engine.batch_norm import check_batch_norm_parts, synchronise_batch_norm

    check_batch_norm_parts(trainer.batch_norm_parts, num_processes())
    if trainer.batch_norm_parts == 1:
        synchronise_batch_norm(network)


def _networks_and_optimizers(
    session: Session, scheme: Any
) -> tuple[dict[str, nn.Module], dict[str, torch.optim.Optimizer]]:
    """Further networks of a scheme, wrapped in place, and all optimisers."""
    builder, fabric = session.spec.optimizer.build(), session.fabric
    record = record_of(scheme)
    parts, others = record.optimizers, record.networks
    built = {name: builder(session.model, without=without) for name, without in parts.items()}
    for name in record.builders:
        _share_batch_norm(others[name], session.trainer)
        built[name] = record.builders[name](others[name])
        others[name] = fabric.setup_module(others[name])
    wrapped: Any = {name: fabric.setup_optimizers(each) for name, each in built.items()}
    return others, wrapped
