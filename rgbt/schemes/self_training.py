"""Self-training: a teacher, which is an average of the network, labels the target in every step.

Class mixing pastes the pixels of some classes of a source image on a target image.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any, Literal

import torch
from torch import Tensor, nn
from torch.nn.modules.batchnorm import _BatchNorm

from rgbt.averaging import AveragedNetwork
from rgbt.checks import InputError
from rgbt.losses.distances import FeatureDistance
from rgbt.losses.unlabelled import WeightedBy, pseudo_labels
from rgbt.processes import mean_count, own_draw
from rgbt.ranges import NonNegative, Share
from rgbt.requirements import Requirement, SchemeRecord
from rgbt.schemes.domains import SCORES, Passes, SourceAndTarget, draw_masks, scores
from rgbt.types import AnyMasker, Batch, GeneratorOf, Loss, Phase, TwoDomains, View

TEACHER = "teacher"
# Names in the log: share of the target's pixels whose highest probability reaches the threshold,
# and the mean of the highest probabilities.
CONFIDENT_SHARE, CONFIDENCE = "teacher/confident_share", "teacher/confidence"

NUM_VALUES = 256  # values of a label: the classes and 255, which is pasted like a class
LUMA = (0.299, 0.587, 0.114)  # weights of red, green and blue (ITU-R BT.601)
Normalisation = Literal["batch", "running"]


class Teacher:
    """Keeps the moving average w' of the parameters w of a network, before step t.

        w' <- a w' + (1 - a) w,   a = min(1 - 1 / (t + 1), decay),   t = 0, 1, ...

    Buffers are not averaged. With the normalisation "batch" it is in training mode without dropout,
    stochastic depth and changes of statistics; with "running" in evaluation mode. `average` is w'.
    Source: Tarvainen and Valpola, "Mean teachers are better role models".   Released: "batch".
    """

    def __init__(self, network: nn.Module, *, decay: float, normalisation: Normalisation) -> None:
        self.average = AveragedNetwork(network, buffers=False)
        self._student = (network,)  # a tuple, so that it is no submodule
        self._decay, self._normalisation = decay, normalisation
        self._step: int | None = None

    def update(self, step: int) -> None:
        """Average the parameters before `step`; a second call in the same step does nothing."""
        if step != self._step:
            self._step = step
            self.average.update(self._student[0], max(1 / (step + 1), 1 - self._decay))

    def network(self) -> nn.Module:
        """Return the teacher, ready to predict; normalisations that the student froze stay so."""
        teacher = self.average.module.eval()
        if self._normalisation == "batch":
            both = zip(teacher.modules(), self._student[0].modules(), strict=True)
            for norm, own in both:
                if isinstance(norm, _BatchNorm) and own.training:
                    norm.train()
                    norm.track_running_stats = False
        return teacher


@dataclass(kw_only=True, eq=False)
class SelfTraining:
    """Cross-entropy of the source, of a mix of both domains, and of masked images.

        L = L_s(source) + L_s(mix) + masked_weight L_s(masked) + feature distance(source)

    The teacher predicts labels of the unchanged target. The mix is the target, with half of the
    classes of the source pasted on it, after strong augmentation. Its labels are those of the
    source where it is pasted, with weight 1, and those of the teacher elsewhere, with the weight q
    of `rgbt.losses.unlabelled`. The masked images hide cells of the target (MIC; from day to night
    of both), and have the labels of the teacher. Of an RGB-thermal pair, both images are pasted
    with the same pixels, and masked with the cells that `masker.pairing` gives each. A domain that
    sees one image pastes what it sees (`seen_as`).

    The feature distance (`rgbt.losses.distances`) compares the last stage of the encoder, of the
    unchanged source, with that of the network that training started from, in evaluation mode.

    Source: DACS; DAFormer, Sec. 3.1 and 3.3 (rare class sampling: `rgbt.data.rare_classes`); MIC.
    Paper: q is a share of each image (DAFormer).   Released: of the batch.

    The settings are the keys of ``conf/scheme/self_training.yaml``. `augmentation` maps RGB and
    thermal to images of the same shapes (`rgbt.transforms.strong`), `dataset` names the classes.
    """

    model: nn.Module
    loss: Loss
    masker: AnyMasker
    domains: SourceAndTarget
    augmentation: Callable[[Tensor, Tensor, torch.Generator], tuple[Tensor, Tensor]]
    decay: Share
    teacher_norm: Normalisation
    threshold: Share
    weighted_by: WeightedBy
    ignored_top: Share
    ignored_bottom: Share
    mixing: Literal["classes", "none"]
    masked_weight: NonNegative
    masked_images: Literal["target", "both"]
    feature_distance: FeatureDistance | None = None
    dataset: Any = None

    def __post_init__(self) -> None:
        if self.ignored_top + self.ignored_bottom >= 1:
            raise InputError("scheme.ignored_top + scheme.ignored_bottom must be below 1.")
        self.passes = Passes(self.model, self.loss, self.domains, "apart")
        self.teacher = Teacher(self.model, decay=self.decay, normalisation=self.teacher_norm)
        self.initial: nn.Module | None = None
        if self.feature_distance is not None:
            self.feature_distance.indices(self.dataset.classes)
            self.initial = copy.deepcopy(self.model).eval().requires_grad_(False)

    @property
    def record(self) -> SchemeRecord:
        """Require no labels of the target, weighted pixels, and what masks and features need."""
        setting = f"scheme.masked_weight={self.masked_weight:g}"
        distance = self.feature_distance
        return self.passes.record_with(
            SCORES,
            Requirement("domains", "target_labels", False),
            Requirement("loss", "weighs_confidence", True),
            *(() if distance is None else distance.requires),
            masked=Requirement("masker", "hides_cells", bool(self.masked_weight), setting),
            networks={TEACHER: self.teacher.average},
        )

    def phases(self, batch: TwoDomains, generator_of: GeneratorOf) -> Iterator[Phase]:
        """Yield one phase, or one per optimiser, of images in [0, 1]."""
        self.teacher.update(batch.step)
        with torch.no_grad():
            network = self.teacher.network()
            output = self.passes.output("target", batch.target, generator_of, network=network)
        ignored = (self.ignored_top, self.ignored_bottom)
        labels = pseudo_labels(scores(output), self.threshold, self.weighted_by, ignored)
        target = replace(batch.target, label=labels.label, confidence=labels.weight)
        logged = {CONFIDENT_SHARE: labels.confident, CONFIDENCE: labels.confidence}

        def cost(name: str) -> dict[str, Tensor]:
            if name == "source":
                return self._source(batch.source, generator_of)
            return self._target(batch.source, target, generator_of)

        for number, phase in enumerate(self.passes.phases(cost)):
            yield phase._replace(logged={} if number else logged)

    def _source(self, source: Batch, generator_of: GeneratorOf) -> dict[str, Tensor]:
        output, parts = self.passes.supervised("source", source, generator_of)
        if self.masked_weight and self.masked_images == "both":
            parts |= self._masked("source", source, generator_of)
        if self.feature_distance is not None:
            with torch.no_grad():
                initial = self.passes.output("source", source, generator_of, network=self.initial)
            now, start = output.aux["features"], initial.aux["features"]
            distance = self.feature_distance(now, start, source.label, self.dataset.classes)
            parts["source/feature_distance"] = distance
        return parts

    def _target(self, source: Batch, target: Batch, generator_of: GeneratorOf) -> dict[str, Tensor]:
        mix = target
        if self.mixing == "classes":
            assert self.passes.target is not None, "the record requires two domains"
            shown = seen_as(source, self.passes.source.view, self.passes.target.view)
            mix = mixed(shown, target, pasted_pixels(source.label, generator_of("class mix")))
        mix = self._augmented(mix, generator_of("mix augmentation"))
        parts = self.passes.supervised("target", mix, generator_of)[1]
        if self.masked_weight and self.masked_images == "target":
            target = self._augmented(target, generator_of("masked augmentation"))
        if self.masked_weight:
            parts |= self._masked("target", target, generator_of)
        return parts

    def _masked(self, name: str, batch: Batch, generator_of: GeneratorOf) -> dict[str, Tensor]:
        """Compute parts of masked images; those of two domains have half of the weight each."""
        masks = draw_masks(self.masker, batch, generator_of(f"{name} mask"))
        output = self.passes.output(name, batch, generator_of, masks)
        parts = self.loss(output, batch, generator_of(f"{name} masked loss"))
        weight = self.masked_weight * (0.5 if self.masked_images == "both" else 1.0)
        return {f"{name}/masked_{part}": weight * values.sum() for part, values in parts.items()}

    def _augmented(self, batch: Batch, generator: torch.Generator) -> Batch:
        rgb, thermal = self.augmentation(batch.rgb, batch.thermal, generator)
        return replace(batch, rgb=rgb, thermal=thermal)


def pasted_pixels(label: Tensor, generator: torch.Generator) -> Tensor:
    """Draw half of the classes for every image; returns their pixels, (B, H, W) bool.

    With n values in the labels of the batch, 255 among them, ceil(n / 2) are drawn for each image,
    without replacement. A drawn value that the image does not have pastes nothing.
    Source: ClassMix; DACS, DAFormer, HRDA and MIC as released.
    """
    present = torch.zeros(NUM_VALUES, device=label.device)
    present = mean_count(present.index_fill(0, label.flatten(), 1.0)) > 0

    def draw(count: int) -> Tensor:
        drawn = torch.rand(count, NUM_VALUES, generator=generator, device=generator.device)
        return drawn.to(label.device)

    # The present values come first, in random order; the number of draws does not depend on them.
    order = (own_draw(draw, len(label)) + ~present).argsort(1)
    place = torch.arange(NUM_VALUES, device=label.device).expand_as(order)
    rank = torch.empty_like(order).scatter_(1, order, place)
    drawn = rank < (present.sum() + 1) // 2
    return drawn.gather(1, label.flatten(1)).view_as(label)


def mixed(source: Batch, target: Batch, pasted: Tensor) -> Batch:
    """Paste the pixels `pasted` (B, H, W) of the source on the target; they have weight 1."""
    assert target.confidence is not None, "pseudo-labels have a weight"
    return replace(
        target,
        rgb=source.rgb.where(pasted[:, None], target.rgb),
        thermal=source.thermal.where(pasted[:, None], target.thermal),
        label=source.label.where(pasted, target.label),
        confidence=torch.ones_like(target.confidence).where(pasted, target.confidence),
    )


def seen_as(batch: Batch, own: View | None, other: View | None) -> Batch:
    """Move what the domain of a batch sees to the channels that another domain sees.

    RGB becomes thermal as its luma; thermal becomes RGB as grey; else it stays as it is.
    """
    if {own, other} != {"rgb", "thermal"}:
        return batch
    if other == "rgb":
        return replace(batch, rgb=batch.thermal.expand_as(batch.rgb))
    luma = batch.rgb.new_tensor(LUMA).view(1, 3, 1, 1)
    return replace(batch, thermal=(batch.rgb * luma).sum(1, keepdim=True))
