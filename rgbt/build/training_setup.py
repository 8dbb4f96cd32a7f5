"""Everything a training needs, built and looked at before anything is written."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal

import torch
from torch import nn

from rgbt.build.contracts import CheckedLoss, CheckedScheme, is_own
from rgbt.build.probes import check_cells, check_own_parts, example_hw, first_readable
from rgbt.build.session import Session, open_session
from rgbt.checks import InputError
from rgbt.config.compose import available
from rgbt.data.batches import Dataset
from rgbt.data.domains import GIVEN, NONE, Domain
from rgbt.data.loaders import Batches, steps_per_epoch, train_batches
from rgbt.data.pairs import PairedBatches
from rgbt.data.pseudo_labels import PseudoLabelled, Unlabelled
from rgbt.engine.schedules import Schedule
from rgbt.engine.trainer import Scheme
from rgbt.losses.adversarial import cross_entropy, judged, least_squares
from rgbt.losses.distillation import sdc, sdn
from rgbt.losses.guidance import guidance
from rgbt.randomness import derive
from rgbt.spec.run_spec import WEIGHTS, Dependency, RunSpec, labels_key
from rgbt.tracking.terminal import info
from rgbt.transforms.virtual_view import VirtualView
from rgbt.types import VIEWS, Loadable, Masker, View

FUNCTIONS = {
    "sdc": sdc,
    "sdn": sdn,
    "guide": guidance,
    "judged_map": judged,
    "verdict_losses": {"least_squares": least_squares, "cross_entropy": cross_entropy},
}
"""What schemes compute with, by the name that they ask for it; they know no losses themselves."""


@dataclass(frozen=True)
class TrainingSetup:
    """The objects of a training, before anything is written.

    Attributes:
        session: data, transform, network.
        datasets: of each domain, with the labels that it is trained with.
        model: the network as Fabric wrapped it.
        others: further networks that are trained, wrapped, by name.
        optimizers: by the names that the scheme's phases use.
        scheme: yields the phases of a step.
        schedule: learning rate factor per step.
    """

    session: Session
    datasets: dict[str, Dataset]
    model: nn.Module
    others: dict[str, nn.Module]
    optimizers: dict[str, torch.optim.Optimizer]
    scheme: Scheme
    schedule: Schedule

    def splits(self) -> dict[str, str]:
        """Domain -> split that it is trained on."""
        return {name: domain.split for name, domain in self.session.domains.named.items()}

    def read_splits(self) -> tuple[str, ...]:
        """Every split that the run reads: of the training, of the selection, of the test."""
        splits = (*self.splits().values(), self.session.trainer.selection_split, "test")
        return tuple(dict.fromkeys(splits))

    def steps_per_epoch(self) -> int:
        """Batches of one epoch of the source."""
        return steps_per_epoch(
            self.datasets["source"], self.session.loading, self.splits()["source"]
        )

    def batches(self, steps: range) -> Batches[Loadable] | PairedBatches:
        """Training batches of these steps: of one domain, or a pair of batches of both."""
        session, seed = self.session, self.session.spec.seed
        loading = replace(session.loading, augment=_where_to_augment(session))
        # Each domain is shuffled and augmented by draws of its own.
        seeds = {"source": seed, "target": derive(seed, "target domain")}
        found = [
            train_batches(
                *(self.datasets[name], split, session.transform, loading),
                *(seeds[name], steps),
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
    for name, domain in spec.domains.named.items():
        teacher = spec.dependency(labels_key(name))
        if teacher is not None:
            _check_teacher_view(domain.teacher_view, teacher)
    set_up_training(spec, upstream_finished=False)


def _check_teacher_view(view: View | None, teacher: Dependency) -> None:
    """Refuse a view that the network of an upstream run does not predict from."""
    with torch.device("meta"):
        views = getattr(teacher.run.model.build(), "views", VIEWS)
    if view is not None and view not in views:
        raise InputError(
            f"{teacher.key.removesuffix('labels')}teacher_view={view}, but the network of "
            f"{teacher.run.name} predicts from {', '.join(views)}; choose one of these, or null."
        )


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
    for split in (
        *(domain.split for domain in domains.named.values()),
        *(session.trainer.selection_split, "test"),
    ):
        session.dataset.names(split)
    datasets = {
        name: session.dataset if labels_key(name) in missing else _labelled(session, name, domain)
        for name, domain in domains.named.items()
    }
    for name, domain in domains.named.items():
        steps_per_epoch(datasets[name], session.loading, domain.split)
        _check_labelled(session, name, domain)
    _where_to_augment(session)
    check_own_parts(session)
    masker: Masker = spec.masker.build()
    check_cells(session, masker)
    if upstream_finished:
        _tell_what_is_not_as_published(session)
    loss = spec.loss.build()
    loss = CheckedLoss(loss) if is_own(loss) else loss
    _check_loss(loss, session)
    model = session.fabric.setup_module(session.model)
    scheme = _scheme(session, model=model, loss=loss, masker=masker)
    _check_domains(scheme, session)
    _check_views(scheme, loss, session)
    others, optimizers = _set_up(session, scheme)
    scheme = CheckedScheme(scheme, tuple(optimizers)) if is_own(scheme) else scheme
    return TrainingSetup(
        session, datasets, model, others, optimizers, scheme, spec.schedule.build()
    )


def _tell_what_is_not_as_published(session: Session) -> None:
    """Remarks on what is no mistake, and yet not what a paper's numbers were made with."""
    spec, data = session.spec, session.dataset
    expected: object = spec.scale.pretrained and getattr(session.model, "pretrained_parts", ())
    if expected and session.weights is None:
        info(
            "the published recipe starts from ImageNet weights, this run from random ones; name a "
            "file with pretrained=..., or expect less than published."
        )
    meant = spec.recipe.dataset
    if spec.scale.name == "paper" and meant != data.name:
        known = data.name in available("recipe")
        info(
            f"sizes, batch and steps of the recipe are those for {meant}, not for {data.name}; "
            + (f"choose recipe={data.name}, or " if known else "")
            + "set recipe.train_sizes, crop_hw, batch_size, max_steps and eval_every, then "
            f"recipe.dataset={data.name}."
        )
    picked = session.trainer.selection_split
    if session.trainer.tested == "best" and picked != "test":
        shared = set(data.names(picked)) & set(data.names("test"))
        if shared:
            info(
                f"trainer.selection_split={picked}: {len(shared)} of its {len(data.names(picked))} "
                "images are test images, so that the best checkpoint is picked on what is reported."
            )


def _where_to_augment(session: Session) -> Literal["loader", "device"]:
    """What `LoaderSettings.augment` comes to; InputError where the transform cannot do it."""
    asked = session.loading.augment
    can = getattr(session.transform, "works_on_batches", False)
    if asked == "device" and not can:
        has_choice = "colour" in session.spec.transform.values
        works = "transform.colour=intended" if has_choice else "transform=crm"
        raise InputError(
            f"data.augment=device, but {type(session.transform).__name__} works on single images "
            f"as it is set; choose {works}, or data.augment=loader."
        )
    if asked == "auto":
        return "device" if can and session.fabric.device.type == "cuda" else "loader"
    return asked


def _labelled(session: Session, name: str, domain: Domain) -> Dataset:
    """The data set with the labels that a domain is trained with."""
    folder = session.spec.labels_folder(name)
    if folder is not None:
        found = PseudoLabelled(session.dataset, folder, with_confidence=domain.confidence)
        listed = session.dataset.names(domain.split)
        missing = found.labels.missing(listed)
        if missing and (session.loading.on_error == "raise" or len(missing) == len(listed)):
            raise InputError(
                f"domains.{name}.labels: {folder} has no pseudo-labels of {len(missing)} of the "
                f"{len(listed)} images of {domain.split}, such as '{missing[0]}'; predict that "
                "split."
            )
        if found.labels.manifest["kept"] == 0:
            raise InputError(
                f"domains.{name}.labels: {folder} holds no label of any pixel, its threshold of "
                f"{found.labels.manifest['threshold']:g} was above every confidence; predict with "
                "a lower one."
            )
        made_on = found.labels.manifest["fingerprint"]
        if domain.labels.startswith("experiment:") and made_on != session.dataset.fingerprint():
            raise InputError(
                f"{folder} was predicted on other files of {session.dataset.name} than those of "
                f"{session.dataset.root}; give the runs another folder (runs_dir=...), or remove "
                "that one to predict again."
            )
        return found
    return Unlabelled(session.dataset) if domain.labels == NONE else session.dataset


def _check_labelled(session: Session, name: str, domain: Domain) -> None:
    """Refuse labels that the data set does not have, and tell of those that it is tested on."""
    if domain.labels != GIVEN:
        return
    if first_readable(session, domain.split).label is None:
        raise InputError(
            f"domains.{name}.labels=given, but {session.dataset.name} has no labels of "
            f"{domain.split}; name pseudo-labels (experiment:thermal_teacher/best.pt), or set it "
            "to none."
        )
    shared = set(session.dataset.names(domain.split)) & set(session.dataset.names("test"))
    if shared:
        info(
            f"domains.{name}.split={domain.split}: {len(shared)} of its images are test images, "
            "so that the test says nothing of new ones."
        )


def _scheme(session: Session, **collaborators: Any) -> Scheme:
    """The scheme; weights of networks of its own are drawn from (seed, "scheme weights")."""
    spec = session.spec
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(derive(spec.seed, "scheme weights"))
        scheme: Scheme = spec.scheme.build(**collaborators, domains=session.domains, **FUNCTIONS)
    return scheme


def _set_up(
    session: Session, scheme: Any
) -> tuple[dict[str, nn.Module], dict[str, torch.optim.Optimizer]]:
    """Further networks of a scheme, wrapped in place, and all optimisers."""
    builder, fabric = session.spec.optimizer.build(), session.fabric
    parts: dict[str, tuple[str, ...]] = getattr(scheme, "optimizers", {"main": ()})
    built = {name: builder(session.model, without=without) for name, without in parts.items()}
    others: dict[str, nn.Module] = getattr(scheme, "others", {})
    for name, module in others.items():
        built[name] = scheme.builders[name](module)
        others[name] = fabric.setup_module(module)
    optimizers: dict[str, Any] = {
        name: fabric.setup_optimizers(each) for name, each in built.items()
    }
    return others, optimizers


def _check_loss(loss: object, session: Session) -> None:
    """Refuse a loss that reads what it does not get, and what no loss reads."""
    model = session.model
    reads, predicts = getattr(loss, "reads", None), getattr(model, "predicts", None)
    if None not in (reads, predicts) and reads != predicts:
        key = "loss@loss.segmentation" if hasattr(loss, "reads_warped") else "loss"
        advice = {"scores": f"{key}=cross_entropy", "masks": f"{key}=set_criterion"}
        raise InputError(
            f"{type(loss).__name__} reads {reads}, but {type(model).__name__} predicts "
            f"{predicts}; choose {advice[str(predicts)]}, or another network."
        )
    classes = getattr(loss, "num_classes", session.dataset.num_classes)
    if classes != session.dataset.num_classes:
        raise InputError(
            f"loss.num_classes is {classes} but {session.dataset.name} has "
            f"{session.dataset.num_classes} classes; omit it, so that the data set decides."
        )
    for name, domain in session.domains.named.items():
        if domain.confidence and not getattr(loss, "reads_confidence", False):
            raise InputError(
                f"domains.{name}.confidence=true, but {type(loss).__name__} does not weigh pixels "
                "by it; choose loss=cross_entropy, or set it to false."
            )


def _check_views(scheme: object, loss: object, session: Session) -> None:
    """Refuse a loss of two frames without a second one, and cameras of other images."""
    views = getattr(scheme, "view", None)
    if views is None and hasattr(loss, "reads_warped"):
        raise InputError(
            f"{type(loss).__name__} is a loss of two frames, but {type(scheme).__name__} shows the "
            "network one; choose scheme=temporal_paper or temporal_released, or "
            "loss=cross_entropy."
        )
    if isinstance(views, VirtualView):
        # One example for nothing: a camera of other images is told before the run is begun.
        _check_camera("scheme", views, example_hw(session))
    if session.consistency.sets:
        shown = session.transform.test(first_readable(session, "test"))
        for image in (shown.rgb, shown.label):
            _check_camera("consistency", session.consistency.view, image.shape[:2])


def _check_camera(node: str, view: VirtualView, image_hw: tuple[int, int]) -> None:
    try:
        view.camera.matrix(image_hw)
    except InputError as error:
        raise InputError(f"{node}.view.{error}") from error


def _check_domains(scheme: object, session: Session) -> None:
    """Refuse domains that the scheme does not train on, and heads that the network lacks."""
    domains, model = session.domains, session.model
    if not hasattr(scheme, "domains"):
        source = domains.source
        if domains.target is not None or source.view is not None or source.head is not None:
            raise InputError(
                f"{type(scheme).__name__} trains on one domain as the network sees it by itself; "
                "choose domains=one, or scheme=two_domains or adversarial_thesis."
            )
    if session.domains.source.labels == NONE:
        raise InputError(
            "domains.source.labels=none, but every scheme reads labels of the source; set it to "
            "given, or name a folder of pseudo-labels."
        )
    heads = tuple(getattr(model, "heads", ()))
    for name, domain in domains.named.items():
        if domain.head is not None and domain.head not in heads:
            raise InputError(
                f"domains.{name}.head={domain.head}, but {type(model).__name__} has "
                + (f"the heads {', '.join(heads)}" if heads else "no heads to choose from")
                + "; choose one of them, or a DeepLab v2 with model.heads=[source,target]."
            )
        views = getattr(model, "views", VIEWS)
        if domain.view is not None and domain.view not in views:
            raise InputError(
                f"domains.{name}.view={domain.view}, but {type(model).__name__} predicts from "
                f"{', '.join(views)}; choose one of these, or another network."
            )
    if len(heads) > 1 and len(domains.heads) < len(heads):
        raise InputError(
            f"{type(model).__name__} has the heads {', '.join(heads)}, of which these domains "
            f"train {', '.join(domains.heads) or 'only the first'}; choose domains=day_to_night or "
            "rgb_to_thermal, or a network with one head."
        )
