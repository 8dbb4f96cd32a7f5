"""The head of a Mask2Former: pixel decoder and query decoder on the features of any backbone."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from rgbt.checks import InputError, check_choice
from rgbt.geometry.padding import padded_hw
from rgbt.models.mask2former.backbone import Maps
from rgbt.models.mask2former.decoder import Predictor
from rgbt.models.mask2former.pixel_decoder import GROUPS, PixelDecoder
from rgbt.types import VIEWS, Output, View

FAINTEST = 1e-6
"""Smallest semantic score whose logarithm is taken."""


@dataclass(frozen=True, kw_only=True)
class HeadShape:
    """Sizes of the two decoders; see `rgbt.models.mask2former.model.Mask2Former`.

    Raises:
        InputError: `hidden_dim` that groups or heads do not divide.
    """

    num_classes: int
    hidden_dim: int
    num_queries: int
    encoder_layers: int
    encoder_ffn_dim: int
    decoder_layers: int
    decoder_ffn_dim: int
    attention_heads: int
    pixel_decoder_fp32: bool

    def __post_init__(self) -> None:
        if self.hidden_dim % GROUPS or self.hidden_dim % self.attention_heads:
            raise InputError(
                f"model.hidden_dim must be a multiple of {GROUPS} and of model.attention_heads "
                f"({self.attention_heads}), got {self.hidden_dim}."
            )


@dataclass(frozen=True)
class Requested:
    """What one forward pass predicts; see `rgbt.models.mask2former.model.Mask2Former.forward`.

    Attributes:
        views: at least one, none twice.
        passes: stacked copies of the batch.
        count: images of the batch.
        predictions: P.
        masks: M.
    """

    views: tuple[View, ...]
    passes: int
    count: int
    predictions: int
    masks: int

    @property
    def is_single(self) -> bool:
        """Whether there is one view and one pass."""
        return len(self.views) * self.passes == 1


def requested(
    num_images: int,
    passes: int,
    views: tuple[View, ...],
    num_predictions: int | None,
    num_masks: int | None,
) -> Requested:
    """The request of a forward pass, arguments as there.

    Raises:
        ValueError: passes, views or numbers of predictions that do not fit.
        InputError: an unknown view.
    """
    views = views or VIEWS[:1]
    if passes < 1 or num_images % passes:
        raise ValueError(f"{num_images} images are not {passes} stacked passes of one batch.")
    if len(set(views)) < len(views):
        raise ValueError(f"views must name each view at most once, got {views}.")
    for view in views:
        check_choice("view", view, VIEWS)
    stacked = len(views) * passes
    predictions = stacked if num_predictions is None else num_predictions
    with_masks = predictions if num_masks is None else num_masks
    if not 1 <= with_masks <= predictions <= stacked:
        raise ValueError(
            f"num_predictions={num_predictions} and num_masks={num_masks} do not fit: expected "
            f"1 <= num_masks <= num_predictions <= {stacked} (views times passes)."
        )
    return Requested(views, passes, num_images // passes, predictions, with_masks)


class MaskHead(nn.Module):
    """Features of four strides to classes and masks of queries.

    Source: Mask2Former, Sec. 3.2.

    `widths` are the channels of the features at strides 4, 8, 16, 32.
    """

    def __init__(self, shape: HeadShape, widths: tuple[int, int, int, int]) -> None:
        super().__init__()
        self.pixel_decoder = PixelDecoder(
            widths,
            hidden_dim=shape.hidden_dim,
            encoder_layers=shape.encoder_layers,
            heads=shape.attention_heads,
            ffn_dim=shape.encoder_ffn_dim,
            fp32=shape.pixel_decoder_fp32,
        )
        self.predictor = Predictor(
            shape.num_classes,
            hidden_dim=shape.hidden_dim,
            num_queries=shape.num_queries,
            num_layers=shape.decoder_layers,
            heads=shape.attention_heads,
            ffn_dim=shape.decoder_ffn_dim,
        )

    def forward(self, features: Maps, wanted: Requested, image_hw: tuple[int, int]) -> Output:
        """Predictions from features of images that are padded to multiples of 32.

        Args:
            features: P B of each stride, as `rgbt.models.mask2former.backbone.Fusion` returns them.
            wanted: the request.
            image_hw: size of the images without the padding.

        Returns:
            as `rgbt.models.mask2former.model.Mask2Former.forward`.
        """
        pyramid = self.pixel_decoder(features, wanted.masks * wanted.count)
        classes, mask_logits = self.predictor(pyramid)
        logits = None
        if not self.training and wanted.is_single:
            full_hw = padded_hw(image_hw)
            logits = semantic_logits(classes[-1], mask_logits[-1], image_hw, full_hw)
        aux = {
            "class_logits": classes.unflatten(1, (wanted.predictions, wanted.count)),
            "mask_logits": mask_logits.unflatten(1, (wanted.masks, wanted.count)),
        }
        return Output(logits, aux)


def dense_logits(output: Output, image_hw: tuple[int, int]) -> Tensor:
    """Class scores of every pixel in training, for losses that compare dense predictions.

    `output` is of one pass and view. (B, K, H, W) float32: logarithm of the semantic scores, so
    that their softmax is the share of a class in the sum over classes.
    """
    scores = semantic_logits(
        output.aux["class_logits"][-1, 0],
        output.aux["mask_logits"][-1, 0],
        image_hw,
        padded_hw(image_hw),
    )
    return scores.clamp(min=FAINTEST).log()


def semantic_logits(
    class_logits: Tensor, mask_logits: Tensor, image_hw: tuple[int, int], padded: tuple[int, int]
) -> Tensor:
    """Score of every class at every pixel, at the size of the image.

        score(k, pixel) = sum over queries of softmax(class)(k) * sigmoid(mask)(pixel)

    Source: Mask2Former release, semantic inference; the no-object class is dropped.

    (B, Q, K + 1) and (B, Q, h, w), which stands for an image of size `padded` whose top left part
    is `image_hw`, -> (B, K, H, W) float32, >= 0.
    """
    with torch.autocast(class_logits.device.type, enabled=False):
        masks = F.interpolate(
            mask_logits.float(), size=padded, mode="bilinear", align_corners=False
        )
        masks = masks[..., : image_hw[0], : image_hw[1]].sigmoid()
        classes = class_logits.float().softmax(-1)[..., :-1]
        scores = classes.transpose(1, 2) @ masks.flatten(2)
        return scores.view(*scores.shape[:2], *image_hw)
