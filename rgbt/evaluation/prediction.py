"""Code shared by all evaluations of a network: view, heads, batches, normalisation, counts.

Statistics of batch normalisation can be computed again from images without labels: Li et al.,
"Revisiting Batch Normalization For Practical Domain Adaptation" (2016), Algorithm 1 (AdaBN); Nado
et al., "Evaluating Prediction-Time Batch Normalization ... under Covariate Shift" (2020).
They are of all values of all inputs, not an average of batches: that misses their differences.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn.modules.batchnorm import _BatchNorm

from rgbt.assembly.session import Session
from rgbt.checks import InputError, check_choice
from rgbt.data.domains import TestedHead
from rgbt.data.loaders import eval_batches
from rgbt.dataset import LabelledDataset, Subset
from rgbt.engine.evaluate import class_maps, confident_class_maps, probabilities
from rgbt.engine.progress import progress
from rgbt.evaluation.request import EvaluationRequest
from rgbt.metrics.counts import Counts
from rgbt.requirements import record_of
from rgbt.transforms.maps import bilinear, mixed, nearest
from rgbt.types import Batch, View

if TYPE_CHECKING:  # it imports this module
    from rgbt.evaluation.pair_predictions import PairSource

Names = tuple[str, ...]


# Images and how they are counted: with a network, or for predictions of any method.
EvaluationData: TypeAlias = "Session | PairSource"


class Predictor:
    """Predicts batches from `view` with `model` in evaluation mode; each image by its head."""

    def __init__(self, session: Session, model: nn.Module, request: EvaluationRequest) -> None:
        self.view = view_of(session, request.view)
        self._heads = heads_of(session, self.view, request.head)
        self._session = session
        self.model = model.eval()
        self._settings = session.prediction

    def counted(self, batch: Batch) -> Batch:
        """A batch from the loader, with labels of the size at which classes are counted."""
        if self._settings.counted == "label":
            return batch
        resize = mixed if self._settings.label_resize == "bilinear" else nearest
        labels = [resize(label, _hw(batch.rgb)) for label in batch.label.numpy()]
        return replace(batch, label=torch.from_numpy(np.stack(labels)))

    def classes(self, batch: Batch) -> Tensor:
        """`rgbt.engine.evaluate.class_maps` of a batch on the device."""
        if self._settings.enlarged == "scores":
            return class_maps(self.model, batch, *self._how(batch))
        # Predicted at the size of the images; class numbers are enlarged like brightness.
        small = replace(batch, label=batch.label.new_zeros(len(batch.label), *_hw(batch.rgb)))
        found = class_maps(self.model, small, *self._how(batch))
        maps = [bilinear(each, _hw(batch.label)) for each in found.cpu().numpy()]
        return torch.from_numpy(np.stack(maps)).to(found.device)

    def confident_classes(self, batch: Batch) -> tuple[Tensor, Tensor]:
        """`rgbt.engine.evaluate.confident_class_maps` of a batch on the device."""
        classes, confidence = confident_class_maps(self.model, batch, *self._how(batch))
        return (classes if self._settings.enlarged == "scores" else self.classes(batch)), confidence

    def probabilities(self, batch: Batch) -> Tensor:
        """`rgbt.engine.evaluate.probabilities` of a batch on the device."""
        return probabilities(self.model, batch, *self._how(batch))

    def _how(self, batch: Batch) -> tuple[Any, ...]:
        return self._session, self.view, self._heads(batch.name), self._settings


def check_request(session: Session, request: EvaluationRequest) -> None:
    """Refuse a view, head or split that there is not, before anything is printed (InputError)."""
    Predictor(session, session.model, request)
    parts_of_split(session.dataset, request)


def _hw(images: Tensor) -> tuple[int, int]:
    return images.shape[-2], images.shape[-1]


def view_of(session: Session, view: View | None = None) -> View:
    """The view that a network predicts from; None: that of its source domain, or its first."""
    known = record_of(session.model).views
    if view is None:
        return session.domains.source.view or known[0]
    check_choice("modality", view, known)
    return view


def heads_of(
    session: Session, view: View, head: TestedHead | None = None
) -> Callable[[tuple[str, ...]], tuple[str | None, ...]]:
    """Names of images -> the head that predicts each; None: the network's only one.

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


def counts_of(
    data: EvaluationData,
    split: str,
    by_name: Mapping[str, NDArray[np.int64]],
    partition: str,
    dtype: type[np.integer] = np.int32,
) -> Counts:
    """The counts (R, K, K) of each image as those of a split; InputError if there is none."""
    dataset, names = data.dataset, tuple(by_name)
    if not names:
        raise InputError(f"split '{split}' of {dataset.name}: no image could be read.")
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
        run=data.run if isinstance(data, Session) else "",
    )


def weights_digest(model: nn.Module) -> str:
    """SHA-256 in hexadecimal over names and bytes of all parameters and buffers that are saved."""
    digest = hashlib.sha256()
    for name, tensor in sorted(model.state_dict().items()):
        digest.update(f"{name} {tuple(tensor.shape)} {tensor.dtype}\n".encode())
        digest.update(tensor.detach().cpu().contiguous().reshape(-1).view(torch.uint8).numpy())
    return digest.hexdigest()


class BatchMoments:
    """Hook of one normalisation: it uses the statistics of each batch, which are collected.

    Variances have the divisor n, as batches are normalised in training.
    """

    def __init__(self, norm: _BatchNorm) -> None:
        self.count = 0
        self._norm = norm
        self._mean = torch.zeros(norm.num_features, dtype=torch.float64)
        self._squares = torch.zeros(norm.num_features, dtype=torch.float64)

    def __call__(self, _: nn.Module, inputs: Sequence[Any]) -> None:
        """Measure the input (N, C, ...) of the normalisation, before it is normalised.

        Raises:
            InputError: one value for each channel, which would all be normalised to 0.
        """
        values: Tensor = inputs[0]
        count = values.numel() // values.shape[1]
        if count == 1:
            raise InputError(
                "batch_norm: one value for each channel has no variance; set data.eval_batch_size "
                "so that every batch has two images, also the last one by day and at night."
            )
        dims = (0, *range(2, values.dim()))
        batch_variance, batch_mean = torch.var_mean(values.float(), dims, correction=0)
        self._set(batch_mean, batch_variance)
        variance, mean = batch_variance.cpu().double(), batch_mean.cpu().double()
        # Chan et al., "Algorithms for Computing the Sample Variance" (1983), Eq. 2.1.
        share = count / (self.count + count)
        difference = mean - self._mean
        self._mean += share * difference
        self._squares += count * variance + self.count * share * difference.square()
        self.count += count

    def finish(self) -> None:
        """Give the normalisation what was collected; without an input it keeps what it has."""
        if self.count:
            self._set(self._mean, self._squares / self.count)

    def _set(self, mean: Tensor, variance: Tensor) -> None:
        self._norm.get_buffer("running_mean").copy_(mean)
        self._norm.get_buffer("running_var").copy_(variance)


def parts_of_split(
    dataset: LabelledDataset, request: EvaluationRequest
) -> list[tuple[Names, Names]]:
    """Names of images that share statistics, and of those that the statistics are computed from.

    Images by day and at night are apart, except for "recomputed" and where the data set does not
    state which images were taken at night.
    """
    wanted, names = request.batch_norm, dataset.names(request.split)
    if wanted is None:
        return [(names, ())]
    splits = wanted.splits
    sources = tuple(dict.fromkeys(n for each in splits for n in dataset.names(each))) or names
    dark, dark_sources = dataset.nights(names), dataset.nights(sources)
    if wanted.kind == "recomputed" or dark is None or dark_sources is None:
        return [(names, sources)]
    parts = []
    for night in sorted(set(dark)):
        own = tuple(n for n, each in zip(names, dark, strict=True) if each == night)
        measured = tuple(n for n, each in zip(sources, dark_sources, strict=True) if each == night)
        if not measured:
            time = "at night" if night else "by day"
            raise InputError(f"batch_norm_splits={','.join(splits)} has no images {time}.")
        parts.append((own, measured))
    return parts


@contextmanager
def normalised(
    session: Session, predictor: Predictor, request: EvaluationRequest, sources: Names
) -> Iterator[Names]:
    """A context in which the network has the requested statistics of `sources`.

    Gives the names of unreadable images, which are not in the statistics.
    """
    wanted = request.batch_norm
    if wanted is None:
        yield ()
        return
    every = (each for each in predictor.model.modules() if isinstance(each, _BatchNorm))
    norms = [each for each in every if each.running_mean is not None]
    if not norms:
        raise InputError(f"batch_norm={wanted.kind}: the network has none that can be changed.")
    stored = [{key: each.clone() for key, each in norm.state_dict().items()} for norm in norms]
    moments = [BatchMoments(norm) for norm in norms]
    skipped: Names = ()
    try:
        with ExitStack() as hooks:
            for norm, each in zip(norms, moments, strict=True):
                hooks.enter_context(norm.register_forward_pre_hook(each))
            if wanted.kind != "batch":
                skipped = _pass(session, predictor, sources)
                hooks.close()
                _finish(moments, wanted.kind)
            yield skipped
    finally:
        for norm, before in zip(norms, stored, strict=True):
            norm.load_state_dict(before)


def _finish(moments: Sequence[BatchMoments], kind: str) -> None:
    if not any(each.count for each in moments):
        raise InputError(f"batch_norm={kind}: no image could be read.")
    for each in moments:
        each.finish()


def _pass(session: Session, predictor: Predictor, names: Names) -> Names:
    """Predict images without using the predictions; the names of those that cannot be read."""
    from rgbt.data.pseudo_labels import Unlabelled  # the statistics are rarely computed again

    batches = eval_batches(
        Unlabelled(Subset(session.dataset, names)), "", session.transform, session.loading
    )
    with progress() as display:
        task = display.add_task("statistics", total=len(names), note="images")
        for batch in batches:
            predictor.classes(batch.to(session.device))
            display.advance(task, len(batch.name))
    return tuple(batches.skipped)
