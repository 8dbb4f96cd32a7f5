"""Compute the statistics of batch normalisation again, from images without their labels.

One pass over the images. In it every normalisation uses mean and variance of its batch, as in
training, while all else is in evaluation mode. What it is left with are mean and variance over all
values of all its inputs, which are not an average of batches: that would miss the differences
between them.

Sources: Li et al., "Revisiting Batch Normalization For Practical Domain Adaptation" (2016),
Algorithm 1 (AdaBN: each domain has statistics of its own). Nado et al., "Evaluating Prediction-Time
Batch Normalization for Robustness under Covariate Shift" (2020): those of each test batch.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.nn.modules.batchnorm import _BatchNorm

from rgbt.build.session import Session
from rgbt.checks import InputError
from rgbt.data.loaders import eval_batches
from rgbt.data.pseudo_labels import Unlabelled
from rgbt.dataset import LabelledDataset, Subset
from rgbt.engine.progress import progress
from rgbt.evaluation.prediction import Predictor
from rgbt.evaluation.request import BatchNormRequest, EvaluationRequest

Names = tuple[str, ...]

DOMAINS = (" by day", " at night")


class Part(NamedTuple):
    """Images of the evaluated split that share statistics.

    Attributes:
        domain: " by day" or " at night", for messages; "": all images.
        names: of the images.
        sources: names of the images that give the statistics.
    """

    domain: str
    names: Names
    sources: Names


class BatchMoments:
    """Hook of one normalisation: it uses the statistics of each batch, which are collected.

    The collected variance is the mean squared difference to the mean of all values (divisor n), as
    batches are normalised in training.

    Args:
        name: of the normalisation, for messages.
        norm: its running statistics are overwritten.
    """

    def __init__(self, name: str, norm: _BatchNorm) -> None:
        self._name = name
        self._norm = norm
        self._count = 0
        self._mean = torch.zeros(norm.num_features, dtype=torch.float64)
        self._squares = torch.zeros(norm.num_features, dtype=torch.float64)

    def __call__(self, _: nn.Module, inputs: Sequence[Any]) -> None:
        """Measure the input (N, C, ...) of the normalisation, before it is normalised.

        Raises:
            InputError: one value for each channel, which would all be normalised to 0.
        """
        values: Tensor = inputs[0]
        if values.numel() == values.shape[1]:
            raise InputError(
                f"batch_norm=...: {self._name} gets one value for each channel of a batch of one "
                "image, which has no variance; set data.eval_batch_size so that every batch has "
                "two images or more, also the last one by day and at night."
            )
        dims = (0, *range(2, values.dim()))
        variance, mean = torch.var_mean(values.float(), dims, correction=0)
        self._set(mean, variance)
        self._add(mean.cpu().double(), variance.cpu().double(), values.numel() // values.shape[1])

    def _add(self, mean: Tensor, variance: Tensor, count: int) -> None:
        """Chan et al., "Algorithms for Computing the Sample Variance" (1983), Eq. 2.1."""
        share = count / (self._count + count)
        difference = mean - self._mean
        self._mean += share * difference
        self._squares += count * variance + self._count * share * difference.square()
        self._count += count

    def finish(self) -> bool:
        """Give the normalisation what was collected; False if it had no input and was left."""
        if self._count:
            self._set(self._mean, self._squares / self._count)
        return self._count > 0

    def _set(self, mean: Tensor, variance: Tensor) -> None:
        assert self._norm.running_mean is not None, "chosen by `_norms`"
        assert self._norm.running_var is not None, "chosen by `_norms`"
        self._norm.running_mean.copy_(mean)
        self._norm.running_var.copy_(variance)


def parts_of_split(dataset: LabelledDataset, request: EvaluationRequest) -> list[Part]:
    """The evaluated split by domain where each has statistics of its own, else as one part.

    It is one part too if the data set does not state which images were taken at night.

    Raises:
        InputError: there is no image to measure for a domain; an unknown split.
    """
    wanted, names = request.batch_norm, dataset.names(request.split)
    splits = (request.split,) if wanted is None else wanted.splits or (request.split,)
    sources = tuple(dict.fromkeys(name for split in splits for name in dataset.names(split)))
    if wanted is None or wanted.kind == "recomputed":
        return [Part("", names, sources)]
    measured = _by_domain(dataset, sources)
    parts = []
    for domain, own in _by_domain(dataset, names).items():
        if domain not in measured:
            raise InputError(
                f"batch_norm_splits={','.join(splits)} has no images{domain} of {dataset.name}, "
                f"but '{request.split}' has; add a split with such images."
            )
        parts.append(Part(domain, own, measured[domain]))
    return parts


def _by_domain(dataset: LabelledDataset, names: Names) -> dict[str, Names]:
    nights = dataset.nights(names)
    if nights is None:
        return {"": names}
    return {
        DOMAINS[night]: tuple(n for n, dark in zip(names, nights, strict=True) if dark == night)
        for night in sorted(set(nights))
    }


@contextmanager
def normalised(
    session: Session, predictor: Predictor, request: EvaluationRequest, part: Part
) -> Iterator[tuple[str, ...]]:
    """Within it, the network has the requested statistics of `part`; afterwards its own.

    Gives the names of unreadable images, which are not in the statistics.

    Args:
        session: reads the images.
        predictor: of the network.
        request: where `request.batch_norm` is None, nothing changes.
        part: one of `parts_of_split`.

    Raises:
        InputError: the network has no batch normalisation, or no image can be read; a batch whose
            statistics cannot be computed (`BatchMoments`).
    """
    wanted = request.batch_norm
    if wanted is None:
        yield ()
        return
    norms = _norms(predictor.model, wanted)
    stored = [{key: each.clone() for key, each in n.state_dict().items()} for n in norms.values()]
    skipped: Names = ()
    try:
        with ExitStack() as hooks:
            moments = [BatchMoments(name, norm) for name, norm in norms.items()]
            for norm, each in zip(norms.values(), moments, strict=True):
                hooks.enter_context(norm.register_forward_pre_hook(each))
            if wanted.kind != "batch":
                skipped = _pass(session, predictor, part.sources)
                hooks.close()
                _finish(moments, wanted)
            yield skipped
    finally:
        for norm, before in zip(norms.values(), stored, strict=True):
            norm.load_state_dict(before)


def _norms(model: nn.Module, wanted: BatchNormRequest) -> dict[str, _BatchNorm]:
    """The batch normalisations of a network that have running statistics, by name."""
    found = {
        name: module
        for name, module in model.named_modules()
        if isinstance(module, _BatchNorm) and module.running_mean is not None
    }
    if not found:
        raise InputError(
            f"batch_norm={wanted.kind} requires a network with batch normalisation that can be "
            f"changed, but {type(model).__name__} has none (exported and frozen ones cannot be "
            "changed); omit batch_norm=."
        )
    return found


def _pass(session: Session, predictor: Predictor, names: Names) -> Names:
    """Predict images without using the predictions; the names of those that cannot be read."""
    dataset = Unlabelled(Subset(session.dataset, names))
    with progress() as display:
        task = display.add_task("statistics", total=len(names), note="images")
        batches = eval_batches(dataset, "", session.transform, session.loading)
        for batch in batches:
            predictor.classes(batch.to(session.fabric.device))
            display.advance(task, len(batch.name))
    return tuple(batches.skipped)


def _finish(moments: Sequence[BatchMoments], wanted: BatchNormRequest) -> None:
    # A list: all of them, not only those before the first that has an input.
    if not any([each.finish() for each in moments]):
        raise InputError(
            f"batch_norm={wanted.kind}: no image could be read. Check the files with rgbt check."
        )


def statistics_in_words(
    session: Session, request: EvaluationRequest, skipped: Collection[str] = ()
) -> str:
    """The statistics of batch normalisation for people; "" for those of the training.

    For example: AdaBN, of 300 images by day and 300 images at night (train_day, train_night), in
    batches of 10. Images that were `skipped` are not counted.
    """
    wanted = request.batch_norm
    if wanted is None:
        return ""
    batches = f"in batches of {session.loading.eval_batch_size}"
    if wanted.kind == "batch":
        return f"{wanted.title}, {batches}"
    parts = parts_of_split(session.dataset, request)
    numbers = " and ".join(
        f"{sum(name not in skipped for name in part.sources)} images{part.domain}" for part in parts
    )
    splits = ", ".join(wanted.splits or (request.split,))
    return f"{wanted.title}, of {numbers} ({splits}), {batches}"
