"""The network RTFNet: two ResNet encoders with added features, and Upception blocks.

Parameter names are the release's, so that its weights load as they are.
"""

from __future__ import annotations

from typing import Annotated, Literal

import torch
from annotated_types import MultipleOf
from torch import Tensor, nn
from torch.nn import functional as F

from rgbt.models.inputs import Images, Inputs, Network
from rgbt.models.parts import basic_stage, bottleneck_stage
from rgbt.ranges import BaseWidth, NumClasses
from rgbt.requirements import NetworkRecord
from rgbt.types import Output, View

# Depth of a ResNet -> blocks of its stages (He et al., Table 1).
BLOCKS = {
    18: (2, 2, 2, 2),
    34: (3, 4, 6, 3),
    50: (3, 4, 6, 3),
    101: (3, 4, 23, 3),
    152: (3, 8, 36, 3),
}

BASIC = (18, 34)  # the others have bottlenecks, which end in four times as many channels


class Upception(nn.Module):
    """Adds a 1x1, a 3x3 and a third convolution to a shortcut, then a ReLU unless `relu` is false.

    Block A has a 3x3 convolution and the identity, block B (`up`) a transposed convolution and a
    transposed shortcut: twice the size.
    """

    def __init__(self, in_channels: int, channels: int, *, up: bool, relu: bool = True) -> None:
        super().__init__()
        self.relu = relu
        self.conv1 = nn.Conv2d(in_channels, channels, 1, bias=False)
        self.bn1 = nn.BatchNorm2d(channels)
        self.conv2 = nn.Conv2d(channels, channels, 3, padding=1, bias=False)
        self.bn2 = nn.BatchNorm2d(channels)
        if up:
            self.conv3: nn.Module = nn.ConvTranspose2d(channels, channels, 2, 2, bias=False)
        else:
            self.conv3 = nn.Conv2d(channels, channels, 3, padding=1, bias=False)
        self.bn3 = nn.BatchNorm2d(channels)
        self.upsample = nn.Sequential()
        if up:
            self.upsample.append(nn.ConvTranspose2d(in_channels, channels, 2, 2, bias=False))
            self.upsample.append(nn.BatchNorm2d(channels))

    def forward(self, x: Tensor) -> Tensor:
        """(N, in, H, W) -> (N, out, H, W), with `up` (N, out, 2 H, 2 W)."""
        y = F.relu(self.bn1(self.conv1(x)))
        y = F.relu(self.bn2(self.conv2(y)))
        y = self.bn3(self.conv3(y)) + self.upsample(x)
        return F.relu(y) if self.relu else y


class RTFNet(Network):
    """Adds thermal features to RGB features after the stem and every stage, as Sun et al. do.

    The thermal encoder never sees the RGB image.

    Source: RTFNet (Sun, Zuo, Liu, RA-L 2019).   Released: yuxiangsun/RTFNet.

    The arguments are the keys of ``conf/model/rtfnet.yaml``. A thermal stem of three channels
    starts as a copy of RGB's instead of its mean; `thermal_stem` holds for ImageNet's weights too.
    """

    multiple = 32  # five halvings, which the decoder undoes exactly

    def __init__(
        self,
        *,
        num_classes: NumClasses,
        depth: Literal[18, 34, 50, 101, 152],
        base_width: Annotated[BaseWidth, MultipleOf(2)],
        final_relu: bool,
        thermal_stem: Literal["rgb_mean", "xavier"],
        inputs: Inputs,
    ) -> None:
        super().__init__()
        self.num_classes = num_classes
        # Parameters of the stem that ImageNet weights do not cover.
        anew = {"encoder_thermal_conv1.": "drawn anew with model.thermal_stem=xavier"}
        self.record = NetworkRecord(
            views=("rgbt",),
            features=True,
            pretrained_parts=("encoder_",),
            recomputed=("encoder_*_layer*.*", "deconv*.*"),
            drawn_anew=anew if thermal_stem == "xavier" else {},
        )
        stage, expansion = (basic_stage, 1) if depth in BASIC else (bottleneck_stage, 4)
        for part, image_channels in (("rgb", 3), ("thermal", inputs.thermal_channels)):
            stem = nn.Conv2d(image_channels, base_width, 7, stride=2, padding=3, bias=False)
            self.add_module(f"encoder_{part}_conv1", stem)
            self.add_module(f"encoder_{part}_bn1", nn.BatchNorm2d(base_width))
            self.add_module(f"encoder_{part}_maxpool", nn.MaxPool2d(3, stride=2, padding=1))
            channels = base_width
            for index, blocks in enumerate(BLOCKS[depth]):
                width = base_width * 2**index
                layer = stage(channels, width, blocks, stride=min(index + 1, 2))
                self.add_module(f"encoder_{part}_layer{index + 1}", layer)
                channels = expansion * width
        for number in range(1, 6):
            after, relu = (channels // 2, True) if number < 5 else (num_classes, final_relu)
            block = Upception(channels, channels, up=False)
            up = Upception(channels, after, up=True, relu=relu)
            self.add_module(f"deconv{number}", nn.Sequential(block, up))
            channels = after
        self.inputs = inputs
        # Initial weights: torchvision's in the encoders, Xavier's (uniform) in the decoder.
        for name, module in self.named_modules():
            if isinstance(module, nn.Conv2d) and name.startswith("encoder_"):
                nn.init.kaiming_normal_(module.weight, mode="fan_out", nonlinearity="relu")
            elif isinstance(module, nn.Conv2d | nn.ConvTranspose2d):
                nn.init.xavier_uniform_(module.weight)
        thermal = self.get_parameter("encoder_thermal_conv1.weight")
        if thermal_stem == "xavier":
            nn.init.xavier_uniform_(thermal)
        else:
            rgb = self.get_parameter("encoder_rgb_conv1.weight").detach()
            thermal.data.copy_(rgb if rgb.shape == thermal.shape else rgb.mean(1, keepdim=True))

    def predict(self, images: Images, view: View, generator: torch.Generator | None) -> Output:  # noqa: ARG002
        """Predict class scores from both images, >= 0 where `final_relu`.

        In aux: "features" (N, C, h, w) of the fourth stage of the RGB encoder, with those of the
        thermal one added.
        """
        unit = {name.removeprefix("encoder_"): child for name, child in self.named_children()}
        x = F.relu(unit["rgb_bn1"](unit["rgb_conv1"](images.rgb)))
        y = F.relu(unit["thermal_bn1"](unit["thermal_conv1"](images.thermal)))
        x, y = unit["rgb_maxpool"](x + y), unit["thermal_maxpool"](y)
        for number in range(1, 5):
            y = unit[f"thermal_layer{number}"](y)
            x = unit[f"rgb_layer{number}"](x) + y
        features = x
        for number in range(1, 6):
            x = unit[f"deconv{number}"](x)
        return Output(x, {"features": features})
