"""What the networks with Mask2Former's head share: fusion of two modalities, views and passes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Any, Literal

import torch
from annotated_types import Interval, MultipleOf
from torch import Tensor, nn
from torch.nn import functional as F

from rgbt.checks import InputError
from rgbt.geometry.padding import STRIDE, padded_hw
from rgbt.models.inputs import Inputs, expand_cells
from rgbt.models.mask2former.head import GROUPS, HeadShape, PixelDecoder, QueryDecoder
from rgbt.models.parts import check_heads
from rgbt.ranges import Channels
from rgbt.requirements import NetworkRecord
from rgbt.types import VIEWS, MaskPair, Output, View

FAINTEST = 1e-6  # the smallest semantic score whose logarithm is taken

MODALITIES: tuple[Literal["rgb", "thermal"], ...] = ("rgb", "thermal")
LEVELS = ("res2", "res3", "res4", "res5")

FusionKind = Literal["max", "add"]
HiddenDim = Annotated[Channels, MultipleOf(GROUPS)]
NumQueries = Annotated[int, Interval(ge=1, le=10_000)]

RECORD = NetworkRecord(
    outputs="masks",
    views=VIEWS,
    stacks_passes=True,
    dense_logits=True,
    recomputed=(
        "sem_seg_head.pixel_decoder.transformer.encoder.layers.*",
        "sem_seg_head.predictor.transformer_*_layers.*",
    ),
)  # every such network, without its backbone

Widths = tuple[int, int, int, int]
# (N, C_s, H/s, W/s), s = 4, 8, 16, 32.
Maps = list[Tensor]


class Fusion(nn.ModuleDict):
    """Takes the normalised maximum (or sum) of the maps of both modalities, level by level.

    Source: CRM, Sec. III-B.   Released: the maps of a single modality are not normalised again.
    """

    def __init__(self, widths: Widths, fusion: FusionKind) -> None:
        super().__init__(
            {level: nn.BatchNorm2d(width) for level, width in zip(LEVELS, widths, strict=True)}
        )
        self.widths = widths
        self.fuse = torch.maximum if fusion == "max" else torch.add

    def forward(
        self, maps: dict[str, Maps], views: tuple[View, ...], passes: int, predictions: int
    ) -> Maps:
        """Return the maps of the first `predictions`, pass by pass, and within it view by view.

        `maps` are those of "rgb" and "thermal" of all `passes`; see `MaskNetwork.forward`. Batch
        normalisation takes the passes one after the other.
        """
        predicted = []
        for level, norm in enumerate(self.values()):
            by_view: list[Sequence[Tensor]] = []
            for view in views:
                if view != "rgbt":
                    by_view.append(_parts(maps[view][level], passes))
                    continue
                fused = self.fuse(maps["rgb"][level], maps["thermal"][level])
                if self.training:
                    by_view.append([norm(part) for part in _parts(fused, passes)])
                else:  # without batch statistics all passes are one call
                    by_view.append(_parts(norm(fused), passes))
            parts = [part for one_pass in zip(*by_view, strict=True) for part in one_pass]
            parts = parts[:predictions]
            predicted.append(torch.cat(parts) if len(parts) > 1 else parts[0])
        return predicted


def _parts(stacked: Tensor, passes: int) -> Sequence[Tensor]:
    """Split a stacked batch into its passes.

    One alone is not split: in an exported graph its size may be a symbol.
    """
    return (stacked,) if passes == 1 else stacked.chunk(passes)


class MaskNetwork(nn.Module):
    """Predicts classes and masks of queries from two images by a backbone.

    Source: Mask2Former, Sec. 3.2.

    A backbone has `maps(modality, image, hidden, generator)`, the maps of one normalised image with
    tokens that are hidden, (N, h, w) bool or None; `token_px`, the side of a token; and a `Fusion`
    under the name of the release, `norm_layers`.
    """

    backbone: Any

    def __init__(self, backbone: nn.Module, shape: HeadShape, inputs: Inputs) -> None:
        super().__init__()
        check_heads("model.attention_heads", (shape.attention_heads,), (shape.hidden_dim,))
        self.num_classes = shape.num_classes
        self.backbone = backbone
        pixel_decoder = PixelDecoder(self.backbone.norm_layers.widths, shape)
        self.sem_seg_head = nn.ModuleDict(
            {"pixel_decoder": pixel_decoder, "predictor": QueryDecoder(shape)}
        )
        self.inputs = inputs

    def forward(  # noqa: PLR0913 - what every network takes, and what is stacked
        self,
        rgb: Tensor,
        thermal: Tensor,
        masks: MaskPair | None = None,
        *,
        passes: int = 1,
        views: tuple[View, ...] = (),
        num_predictions: int | None = None,
        num_masks: int | None = None,
        generator: torch.Generator | None = None,
    ) -> Output:
        """Predict from every view and pass, as one batch through the head.

        Predictions are in the order F R T F' R' T': pass by pass, within it view by view. Images
        and masks are as `rgbt.models` says, N = passes * B, pass by pass. A cell is a square of a
        multiple of the backbone's `token_px` pixels; its pixels are 0, and the mask token takes the
        place of its tokens. Stochastic depth is drawn per sample and branch.

        `passes` are stacked copies of one batch, which the fusion's batch normalisation sees one
        after the other. `views` are predicted from, each at most once; () is "rgbt". A modality
        that no view needs is not computed. P = `num_predictions` are computed, the first ones, of
        which the first M = `num_masks` have mask logits (None: all). The others have class logits
        alone, which costs less, because the gradient of the finest features is not needed.

        Returns:
            logits: (B, K, H, W) float32 semantic scores in evaluation mode when there is one view
                and one pass, else None. They are sums over queries, not normalised.
            aux: with L = decoder_layers + 1, the last one final:
                "class_logits" (L, P, B, Q, K + 1), last column = no object;
                "mask_logits" (L, M, B, Q, h, w) at 1/4 of the padded size; in memory the order
                is M, B, L, Q, h, w.
        """
        views = views or VIEWS[:1]
        if not set(views) <= set(VIEWS) or len(set(views)) < len(views):
            raise InputError(f"modality: expected some of {VIEWS}, each once; view {views}.")
        stacked = len(views) * passes
        predictions = stacked if num_predictions is None else num_predictions
        with_masks = predictions if num_masks is None else num_masks
        if rgb.shape[0] % passes or not 1 <= with_masks <= predictions <= stacked:
            numbers = f"{with_masks} with masks of {predictions} of {stacked}"
            raise ValueError(f"{rgb.shape[0]} images, {passes} passes, predictions: {numbers}.")

        count = rgb.shape[0] // passes
        image_hw = rgb.shape[2], rgb.shape[3]
        images = self.inputs(rgb, thermal, masks, multiple=STRIDE)
        padded = images.rgb.shape[2], images.rgb.shape[3]
        hidden = None
        if masks is not None:
            hidden = expand_cells(masks, rgb.shape[0], padded, self.backbone.token_px)
        maps: dict[str, Maps] = {}
        for index, modality in enumerate(MODALITIES):
            if views != (MODALITIES[1 - index],):
                mask = None if hidden is None else hidden[index]
                maps[modality] = self.backbone.maps(modality, images[index], mask, generator)
        features = self.backbone.norm_layers(maps, views, passes, predictions)
        pyramid = self.sem_seg_head["pixel_decoder"](features, with_masks * count)
        class_logits, mask_logits = self.sem_seg_head["predictor"](pyramid)
        logits = None
        if not self.training and stacked == 1:
            logits = semantic_logits(class_logits[-1], mask_logits[-1], image_hw, padded)
        aux = {
            "class_logits": class_logits.unflatten(1, (predictions, count)),
            "mask_logits": mask_logits.unflatten(1, (with_masks, count)),
        }
        return Output(logits, aux)

    def dense_logits(self, output: Output, image_hw: tuple[int, int]) -> Tensor:
        """Return class scores (B, K, H, W) float32 of an output of one pass and view, in training.

        They are logarithms of the semantic scores, whose softmax is the share of a class.
        """
        classes, masks = (output.aux[name][-1, 0] for name in ("class_logits", "mask_logits"))
        scores = semantic_logits(classes, masks, image_hw, padded_hw(image_hw))
        return scores.clamp(min=FAINTEST).log()


def semantic_logits(
    class_logits: Tensor, mask_logits: Tensor, image_hw: tuple[int, int], padded: tuple[int, int]
) -> Tensor:
    """Return the score of every class at every pixel, at the size of the image.

        score(k, pixel) = sum over queries of softmax(class)(k) * sigmoid(mask)(pixel)

    (B, Q, K + 1) and (B, Q, h, w), which stands for an image of size `padded` whose top left part
    is `image_hw`, -> (B, K, H, W) float32, >= 0.   Source: Mask2Former release.
    """
    with torch.autocast(class_logits.device.type, enabled=False):
        masks = mask_logits.float()
        masks = F.interpolate(masks, size=padded, mode="bilinear", align_corners=False)
        masks = masks[..., : image_hw[0], : image_hw[1]].sigmoid()
        classes = class_logits.float().softmax(-1)[..., :-1]
        scores = classes.transpose(1, 2) @ masks.flatten(2)
        return scores.view(*scores.shape[:2], *image_hw)
