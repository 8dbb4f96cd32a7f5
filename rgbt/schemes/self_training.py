"""Self-training: a teacher, which is an average of the network, labels the target in every step.

No run of a teacher is needed before (`domains.target.labels=experiment:...` has one). Class mixing
pastes the pixels of some classes of a source image on a target image.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Literal, Protocol

import torch
from torch import Tensor, nn

from rgbt.checks import InputError
from rgbt.losses.distances import FeatureDistance
from rgbt.losses.unlabelled import PseudoLabels, WeightedBy, pseudo_labels
from rgbt.processes import mean_count, own_draw
from rgbt.ranges import NonNegative, Share
from rgbt.requirements import Record, Requirement
from rgbt.schemes.domains import Passes, SourceAndTarget, draw_masks, scores
from rgbt.schemes.teacher import Normalisation, Teacher, frozen_copy
from rgbt.types import AnyMasker, Batch, GeneratorOf, Loss, Phase, TwoDomains, View

TEACHER = "teacher"
CONFIDENT_SHARE, CONFIDENCE = "teacher/confident_share", "teacher/confidence"
"""Names in the log: share of the target's pixels whose highest probability reaches the threshold,
and the mean of the highest probabilities."""

NUM_VALUES = 256
"""Values of a label: the classes and 255, which is pasted like a class."""

LUMA = (0.299, 0.587, 0.114)
"""Of red, green and blue (ITU-R BT.601)."""


class DatasetClasses(Protocol):
    """What is read of a data set (`rgbt.dataset.LabelledDataset`)."""

    classes: tuple[str, ...]


Augmentation = Callable[[Tensor, Tensor, torch.Generator], tuple[Tensor, Tensor]]
"""RGB and thermal -> images of the same shapes (`rgbt.transforms.strong`)."""


@dataclass(kw_only=True, eq=False)
class SelfTraining:
    """Cross-entropy of the source, of a mix of both domains, and of masked images.

        L = L_s(source) + L_s(mix) + masked_weight L_s(masked) + feature distance(source)

    The teacher predicts labels of the unchanged target. The mix is the target, with half of the
    classes of the source pasted on it, after strong augmentation. Its labels are those of the
    source where it is pasted, with weight 1, and those of the teacher elsewhere, with the weight q
    of `rgbt.losses.unlabelled`. The masked images hide cells of the target, and are trained with
    the labels of the teacher.

    Of an RGB-thermal pair, both images are pasted with the same pixels, and masked with the cells
    that `masker.pairing` gives each. A domain that sees one image pastes what it sees
    (`seen_as`).

    The feature distance (`rgbt.losses.distances`) compares the last stage of the encoder, of
    the unchanged source, with that of the network as it was when training started: with the weights
    and running statistics of `model.weights`, in evaluation mode.

    Source: DACS; DAFormer, Sec. 3.1 and 3.3 (rare class sampling: `rgbt.data.rare_classes`); MIC.
    Paper: q is a share of each image (DAFormer).   Released: of the batch.

    Attributes:
        model: the network.
        loss: L_s, of one domain; it weighs pixels by their confidence.
        masker: draws the hidden cells of the masked images.
        domains: a labelled source and a target whose labels are "none".
        augmentation: of the mix, and of masked images of the target.
        decay: of the teacher (`rgbt.schemes.teacher.Teacher`).
        teacher_norm: see there.
        threshold: probability from which a pixel of the teacher is confident.
        weighted_by: see `rgbt.losses.unlabelled`.
        ignored_top: share of the rows at the top without a pseudo-label.
        ignored_bottom: the same at the bottom.
        mixing: "classes", or "none": the target alone, augmented.
        masked_weight: of the loss of masked images, MIC: 1; 0: there are none.
        masked_images: "target": the images of the target, augmented; "both": those of the source,
            with its labels, and of the target, not augmented, each with half of the weight. MIC:
            "target"; from day to night "both" (mask_mode separate, with one image of each).
        feature_distance: its settings; None: there is none.
        dataset: names the classes for the feature distance.

    Raises:
        InputError: no row is left for pseudo-labels; an unknown thing class.
    """

    model: nn.Module
    loss: Loss
    masker: AnyMasker
    domains: SourceAndTarget
    augmentation: Augmentation
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
    dataset: DatasetClasses | None = None

    def __post_init__(self) -> None:
        if self.ignored_top + self.ignored_bottom >= 1:
            raise InputError("scheme.ignored_top + scheme.ignored_bottom must be below 1.")
        self.passes = Passes(
            model=self.model, loss=self.loss, domains=self.domains, gradients="apart"
        )
        self.teacher = Teacher(self.model, decay=self.decay, normalisation=self.teacher_norm)
        self.initial: nn.Module | None = None
        if self.feature_distance is not None:
            assert self.dataset is not None, "a run has a data set"
            self.feature_distance.indices(self.dataset.classes)
            self.initial = frozen_copy(self.model)

    @property
    def record(self) -> Record:
        """No labels of the target, weighted pixels, and what is read of masks and features."""
        setting = f"scheme.masked_weight={self.masked_weight:g}"
        distance = self.feature_distance
        return self.passes.record_with(
            Requirement("domains", "target_labels", False),
            Requirement("loss", "weighs_confidence", True),
            *(() if distance is None else distance.requires),
            masked=Requirement("masker", "hides_cells", bool(self.masked_weight), setting),
            networks={TEACHER: self.teacher.average},
        )

    def phases(self, batch: TwoDomains, generator_of: GeneratorOf) -> Iterator[Phase]:
        """One phase, or one per optimiser, of images in [0, 1]; see `LabelledDomains.phases`."""
        self.teacher.update(batch.step)
        labels = self._labels(batch.target, generator_of)
        target = replace(batch.target, label=labels.label, confidence=labels.weight)
        logged = {CONFIDENT_SHARE: labels.confident, CONFIDENCE: labels.confidence}
        phases = self.passes.phases(
            lambda: self._source(batch.source, generator_of),
            lambda: self._target(batch.source, target, generator_of),
        )
        for number, phase in enumerate(phases):
            yield phase._replace(logged={} if number else logged)

    def _labels(self, target: Batch, generator_of: GeneratorOf) -> PseudoLabels:
        with torch.no_grad():
            network = self.teacher.network()
            output = self.passes.output("target", target, generator_of, network=network)
        ignored = (self.ignored_top, self.ignored_bottom)
        return pseudo_labels(scores(output), self.threshold, self.weighted_by, ignored)

    def _source(self, source: Batch, generator_of: GeneratorOf) -> dict[str, Tensor]:
        output, parts = self.passes.supervised("source", source, generator_of)
        if self.masked_weight and self.masked_images == "both":
            parts |= self._masked("source", source, generator_of)
        if self.initial is not None:
            assert self.feature_distance is not None
            assert self.dataset is not None
            with torch.no_grad():
                initial = self.passes.output("source", source, generator_of, network=self.initial)
            parts["source/feature_distance"] = self.feature_distance(
                output.aux["features"],
                initial.aux["features"],
                source.label,
                self.dataset.classes,
            )
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
        """Parts of masked images; those of two domains have half of the weight each."""
        masks = draw_masks(self.masker, batch, generator_of(f"{name} mask"))
        output = self.passes.output(name, batch, generator_of, masks)
        parts = self.loss(output, batch, generator_of(f"{name} masked loss"))
        weight = self.masked_weight * (0.5 if self.masked_images == "both" else 1.0)
        return {f"{name}/masked_{part}": weight * values.sum() for part, values in parts.items()}

    def _augmented(self, batch: Batch, generator: torch.Generator) -> Batch:
        rgb, thermal = self.augmentation(batch.rgb, batch.thermal, generator)
        return replace(batch, rgb=rgb, thermal=thermal)


def pasted_pixels(label: Tensor, generator: torch.Generator) -> Tensor:
    """(B, H, W) bool: the pixels of half of the classes, drawn for every image.

    With n values in the labels of the batch, ceil(n / 2) of them are drawn for each image, without
    replacement. A drawn value that the image does not have pastes nothing.

    Source: ClassMix; DACS.   Released: DACS, DAFormer, HRDA and MIC, whose values are those of the
    batch and include 255.

    Args:
        label: (B, H, W) int64, 0..255.
        generator: of any device.
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
    """The target with the pixels `pasted` (B, H, W) of the source in both images and the label.

    Pasted pixels have weight 1; the others keep the confidence of the target, which it must have.
    """
    assert target.confidence is not None, "pseudo-labels have a weight"
    return replace(
        target,
        rgb=source.rgb.where(pasted[:, None], target.rgb),
        thermal=source.thermal.where(pasted[:, None], target.thermal),
        label=source.label.where(pasted, target.label),
        confidence=torch.ones_like(target.confidence).where(pasted, target.confidence),
    )


def seen_as(batch: Batch, own: View | None, other: View | None) -> Batch:
    """The batch with what its domain sees, in the channels that another domain sees.

    RGB becomes thermal as its luma; thermal becomes RGB as grey. A domain that sees RGB alone has
    no thermal images to paste. Domains with the same view, or with both images, paste what they
    have.
    """
    if {own, other} != {"rgb", "thermal"}:
        return batch
    if other == "rgb":
        return replace(batch, rgb=batch.thermal.expand_as(batch.rgb))
    luma = batch.rgb.new_tensor(LUMA).view(1, 3, 1, 1)
    return replace(batch, thermal=(batch.rgb * luma).sum(1, keepdim=True))
