"""Predict batches with a network: from which images, with which head, at which size."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor

from rgbt.assembly.session import Session
from rgbt.checks import InputError, check_choice
from rgbt.class_scores import best_of, classes_of
from rgbt.config.common_options import AS_TRAINED
from rgbt.data.domains import TestedHead
from rgbt.engine.evaluate import label_scores, shares
from rgbt.requirements import NetworkRecord, record_of
from rgbt.transforms.maps import bilinear, mixed, nearest
from rgbt.types import VIEWS, Batch, View

DEFAULT_VIEW = "default"  # value of `modality`


class Predictor:
    """Predicts batches from `view` with a network in evaluation mode; every image by its head.

    `heads` are those of images by their names; None: the network's only one.

    InputError: a view or a head that the network does not have.
    """

    def __init__(
        self, session: Session, view: View | None = None, head: TestedHead | None = None
    ) -> None:
        self.view = view_of(session, view)
        self.heads = heads_of(session, self.view, head)
        self.session, self._settings = session, session.prediction
        self.model = session.model.eval()

    def counted(self, batch: Batch) -> Batch:
        """Give a batch from the loader labels of the size at which classes are counted."""
        if self._settings.counted == "label":
            return batch
        resize = mixed if self._settings.label_resize == "bilinear" else nearest
        labels = [resize(label, _hw(batch.rgb)) for label in batch.label.numpy()]
        return replace(batch, label=torch.from_numpy(np.stack(labels)))

    def classes(self, batch: Batch) -> Tensor:
        """Predict the class of every pixel of the labels of a batch: (B, H', W') uint8."""
        if self._settings.enlarged == "scores":
            return classes_of(label_scores(*self._how(batch))).to(torch.uint8)
        # Predicted at the size of the images; class numbers are enlarged like brightness.
        small = replace(batch, label=batch.label.new_zeros(len(batch.label), *_hw(batch.rgb)))
        found = classes_of(label_scores(*self._how(small))).to(torch.uint8)
        maps = [bilinear(classes, _hw(batch.label)) for classes in found.cpu().numpy()]
        return torch.from_numpy(np.stack(maps)).to(found.device)

    def confident_classes(self, batch: Batch) -> tuple[Tensor, Tensor]:
        """Predict `classes`, and the probability (B, H', W') float32 of each."""
        scores = label_scores(*self._how(batch))
        # The class with the highest score has the highest probability.
        confidence, _ = best_of(shares(scores, self.model))
        if self._settings.enlarged == "scores":
            return classes_of(scores).to(torch.uint8), confidence
        return self.classes(batch), confidence

    def probabilities(self, batch: Batch) -> Tensor:
        """Predict `rgbt.engine.evaluate.shares` of the classes: (B, K, H', W') float32."""
        return shares(label_scores(*self._how(batch)), self.model)

    def _how(self, batch: Batch) -> tuple[Any, ...]:
        heads = self.heads(batch.name)
        return self.model, batch, self.session, self.view, heads, self._settings


def _hw(images: Tensor) -> tuple[int, int]:
    return images.shape[-2], images.shape[-1]


def chosen(modality: str, head: str = AS_TRAINED) -> tuple[View | None, TestedHead | None]:
    """Return view and head of the options of a command, None: as trained; InputError: no view."""
    check_choice("modality", modality, (DEFAULT_VIEW, *VIEWS))
    view = None if modality == DEFAULT_VIEW else cast(View, modality)
    return view, None if head == AS_TRAINED else cast(TestedHead, head)


def view_of(session: Session, view: View | None = None) -> View:
    """Return the view that a network predicts from; None: of its source domain, or its first."""
    known = record_of(session.model, NetworkRecord).views
    if view is None:
        return session.domains.source.view or known[0]
    if known == ("rgbt",) and view != "rgbt":
        other = "thermal" if view == "rgb" else "rgb"
        raise InputError(
            f"modality={view}: this network needs both images; in rgbt predict and evaluate, "
            f"corruption=removed:{other} gives it a black one."
        )
    check_choice("modality", view, known)
    return view


def heads_of(
    session: Session, view: View, head: TestedHead | None = None
) -> Callable[[tuple[str, ...]], tuple[str | None, ...]]:
    """Return a function of names of images: the head of each, None: the network's only one.

    InputError: `head` selects one of two, and the network has one.
    """
    requested = session.domains.tested_head if head is None else head
    if head not in (None, "own"):
        session.domains.head_of(view, None, head)  # there are two

    def choose(names: tuple[str, ...]) -> tuple[str | None, ...]:
        dark = None
        if requested == "own" and session.domains.target_is == "night":
            with suppress(InputError):  # a user's own files are in no list
                dark = session.dataset.nights(names)
        nights = dark or (None,) * len(names)
        return tuple(session.domains.head_of(view, night, requested) for night in nights)

    return choose
