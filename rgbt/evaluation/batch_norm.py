"""Statistics of batch normalisation that are computed again from images without labels.

Li et al., "Revisiting Batch Normalization For Practical Domain Adaptation" (2016), Algorithm 1
(AdaBN); Nado et al., "Evaluating Prediction-Time Batch Normalization ... under Covariate Shift"
(2020). They are of all values of all inputs, not an average of batches: that misses their
differences.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from copy import deepcopy
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.modules.batchnorm import _BatchNorm

from rgbt.assembly.session import Session
from rgbt.checks import InputError
from rgbt.data.loaders import eval_batches
from rgbt.dataset import LabelledDataset
from rgbt.evaluation.predict import Predictor
from rgbt.metrics.measurement import Measurement
from rgbt.terminal import progress

Names = tuple[str, ...]


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


def parts_of_split(dataset: LabelledDataset, wanted: Measurement) -> list[tuple[Names, Names]]:
    """Return names of images that share statistics, and of those that these are computed from.

    Images by day and at night are apart, except for "recomputed" and where the data set does not
    state which images were taken at night.
    """
    names, splits = dataset.names(wanted.split), wanted.statistics_of
    if wanted.statistics == "as trained":
        return [(names, ())]
    listed: list[str] = []
    for split in splits:
        listed += dataset.names(split)
    sources = tuple(dict.fromkeys(listed)) or names
    dark, dark_sources = dataset.nights(names), dataset.nights(sources)
    if wanted.statistics == "recomputed" or dark is None or dark_sources is None:
        return [(names, sources)]
    parts = []
    for night in sorted(set(dark)):
        own = tuple(n for n, is_dark in zip(names, dark, strict=True) if is_dark == night)
        times = zip(sources, dark_sources, strict=True)
        measured = tuple(n for n, is_dark in times if is_dark == night)
        if not measured:
            time = "at night" if night else "by day"
            raise InputError(f"batch_norm_splits={','.join(splits)} has no images {time}.")
        parts.append((own, measured))
    return parts


@contextmanager
def normalised(
    session: Session, predictor: Predictor, wanted: Measurement, sources: Names
) -> Iterator[Names]:
    """Give the network the wanted statistics of `sources` within this context.

    Yields the names of unreadable images, which are not in the statistics.
    """
    kind = wanted.statistics
    if kind == "as trained":
        yield ()
        return
    norms = []
    for module in predictor.model.modules():
        if isinstance(module, _BatchNorm) and module.running_mean is not None:
            norms.append(module)
    if not norms:
        raise InputError(f"batch_norm={kind}: the network has none that can be changed.")
    stored = [deepcopy(norm.state_dict()) for norm in norms]
    moments = [BatchMoments(norm) for norm in norms]
    try:
        with ExitStack() as hooks:
            for norm, collector in zip(norms, moments, strict=True):
                hooks.enter_context(norm.register_forward_pre_hook(collector))
            if kind == "batch":
                yield ()
                return
            skipped = _pass(session, predictor, sources)
        if not any(collector.count for collector in moments):
            raise InputError(f"batch_norm={kind}: no image could be read.")
        for collector in moments:
            collector.finish()
        yield skipped
    finally:
        for norm, before in zip(norms, stored, strict=True):
            norm.load_state_dict(before)


def _pass(session: Session, predictor: Predictor, names: Names) -> Names:
    """Predict images without using the predictions; the names of those that cannot be read."""
    from rgbt.data.pseudo_labels import Unlabelled  # the statistics are rarely computed again

    images = Unlabelled(session.dataset)
    batches = eval_batches(images, names, session.transform, session.loading)
    with progress() as display:
        task = display.add_task("statistics", total=len(names), note="images")
        for batch in batches:
            predictor.classes(batch.to(session.device))
            display.advance(task, len(batch.name))
    return tuple(batches.skipped)
