"""Code shared by all evaluations of a network: view, heads, batches and counts per image."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import ExitStack, suppress
from dataclasses import replace
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from rich.progress import Progress, TaskID
from torch import Tensor, nn

from rgbt.build.session import Session
from rgbt.checks import InputError, check_choice
from rgbt.data.cache.dataset import cached_layer
from rgbt.data.domains import TestedHead
from rgbt.data.loader_settings import LoaderSettings
from rgbt.dataset import LabelledDataset
from rgbt.engine.evaluate import class_maps, confident_class_maps, probabilities
from rgbt.engine.progress import progress
from rgbt.evaluation.request import EvaluationRequest
from rgbt.metrics.counts import Counts
from rgbt.metrics.metric import Regions
from rgbt.requirements import record_of
from rgbt.transforms.joint import View as ImageView
from rgbt.transforms.joint import whole_view
from rgbt.transforms.thesis import mixed
from rgbt.transforms.view_sets import ViewSets
from rgbt.types import Batch, View


class EvaluationData(Protocol):
    """Images and how they are counted; a `Session` has all of it and a network too."""

    @property
    def dataset(self) -> LabelledDataset:
        """Names, images and labels."""

    @property
    def transform(self) -> Any:
        """Makes examples of samples, see `rgbt.data.batches.Transform`."""

    @property
    def loading(self) -> LoaderSettings:
        """Batch sizes and workers."""

    @property
    def regions(self) -> Regions:
        """Partition of the image and the rule for absent classes."""

    @property
    def consistency(self) -> ViewSets:
        """Virtual views for TC and CA."""


class Predictor:
    """Predicts batches with `model`, left in evaluation mode; each image by its head.

    Attributes:
        model: the network.
        view: input images of the prediction.

    Raises:
        InputError: the network does not support the requested view.
    """

    def __init__(self, session: Session, model: nn.Module, request: EvaluationRequest) -> None:
        self.view = view_of(session, request.view)
        self._heads = heads_of(session, self.view, request.head)
        self._fabric = session.fabric
        self.model = model.eval()
        self._settings = session.prediction

    def counted(self, batch: Batch) -> Batch:
        """A batch from the loader, with labels of the size at which classes are counted."""
        if self._settings.counted == "label":
            return batch
        image_hw = batch.rgb.shape[-2], batch.rgb.shape[-1]
        resize = mixed if self._settings.label_resize == "bilinear" else ImageView.nearest
        label_hw = batch.label.shape[-2], batch.label.shape[-1]
        view = whole_view(label_hw, image_hw)
        labels = [resize(view, label) for label in batch.label.numpy()]
        return replace(batch, label=torch.from_numpy(np.stack(labels)))

    def classes(self, batch: Batch) -> Tensor:
        """`rgbt.engine.evaluate.class_maps` of a batch on the device."""
        if self._settings.enlarged == "scores":
            return class_maps(self.model, batch, *self._how(batch))
        return self._enlarged(class_maps(self.model, _image_sized(batch), *self._how(batch)), batch)

    def confident_classes(self, batch: Batch) -> tuple[Tensor, Tensor]:
        """`rgbt.engine.evaluate.confident_class_maps` of a batch on the device."""
        classes, confidence = confident_class_maps(self.model, batch, *self._how(batch))
        return (classes if self._settings.enlarged == "scores" else self.classes(batch)), confidence

    def probabilities(self, batch: Batch) -> Tensor:
        """`rgbt.engine.evaluate.probabilities` of a batch on the device."""
        return probabilities(self.model, batch, *self._how(batch))

    def _how(self, batch: Batch) -> tuple[Any, ...]:
        return self._fabric, self.view, self._heads(batch.name), self._settings

    def _enlarged(self, classes: Tensor, batch: Batch) -> Tensor:
        """Class numbers at the size of the labels, interpolated as if they were brightness."""
        view = whole_view(
            (classes.shape[1], classes.shape[2]), (batch.label.shape[-2], batch.label.shape[-1])
        )
        maps = [view.bilinear(each, np.uint8) for each in classes.cpu().numpy()]
        return torch.from_numpy(np.stack(maps)).to(classes.device)


def _image_sized(batch: Batch) -> Batch:
    """A batch whose labels have the size of its images, for predictions of that size."""
    return replace(batch, label=batch.label.new_zeros(len(batch.label), *batch.rgb.shape[-2:]))


def view_of(session: Session, view: View | None = None) -> View:
    """The view that the network of a session predicts from.

    None: the view of its source domain, or else the network's first view.

    Raises:
        InputError: the network does not predict from `view`.
    """
    known = record_of(session.model).views
    if view is None:
        return session.domains.source.view or known[0]
    check_choice("modality", view, known)
    return view


def heads_of(
    session: Session, view: View, head: TestedHead | None = None
) -> Callable[[tuple[str, ...]], tuple[str | None, ...]]:
    """Names of images -> the head that predicts each; None: the network's only one.

    Where `head` is None the run's configuration says which (`domains.tested_head`).
    """
    requested = session.domains.tested_head if head is None else head

    def choose(names: tuple[str, ...]) -> tuple[str | None, ...]:
        dark = None
        if requested == "own" and session.domains.target_is == "night":
            with suppress(InputError):  # a user's own files are in no list
                dark = session.dataset.nights(names)
        nights = dark or (None,) * len(names)
        return tuple(session.domains.head_of(view, night, requested) for night in nights)

    return choose


def counts_of(
    data: EvaluationData,
    split: str,
    by_name: Mapping[str, NDArray[np.int64]],
    partition: str,
    dtype: type[np.integer] = np.int32,
) -> Counts:
    """The counts (R, K, K) of each image as those of a split; stored as `dtype`.

    Raises:
        InputError: there is none, because no image could be read.
    """
    dataset, names = data.dataset, tuple(by_name)
    if not names:
        raise InputError(
            f"split '{split}' of {dataset.name}: no image could be read. Check the files with "
            "rgbt check."
        )
    return Counts(
        counts=np.stack(list(by_name.values())).astype(dtype),
        names=names,
        night=dataset.nights(names),
        classes=dataset.classes,
        partition=partition,
        dataset=dataset.fingerprint(),
        split=split,
        unscored=dataset.unscored,
        absent=data.regions.absent,
    )


def decode_ahead(session: Session, *splits: str) -> None:
    """Fill the image cache with these splits, if the session has one.

    In the main process, before others read from it; InputError where it cannot be written.
    """
    dataset = cached_layer(session.dataset)
    if dataset is None:
        return
    names = tuple(name for split in splits for name in dataset.names(split))
    with ExitStack() as shown:
        tasks: dict[str, TaskID] = {}
        display: list[Progress] = []

        def advance(what: str, done: int, total: int) -> None:
            if not display:  # where everything is there, nothing is shown
                display.append(shown.enter_context(progress()))
            if what not in tasks:
                tasks[what] = display[0].add_task(what, total=total, note="images")
            display[0].update(tasks[what], completed=done, total=total)

        dataset.ensure(names, advance)
