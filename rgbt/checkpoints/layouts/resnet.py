"""ResNets of torchvision, and the DeepLab v2 start that AdaptSegNet and ADVENT take."""

from __future__ import annotations

import re

from torch import nn

from rgbt.checkpoints.layout import NOT_IN_FILE, Facts, Rule, count_blocks, has_parts, shapes_of
from rgbt.checkpoints.read import Contents
from rgbt.requirements import record_of

DEPTHS: dict[tuple[bool, tuple[int, ...]], int] = {
    (False, (2, 2, 2, 2)): 18,
    (False, (3, 4, 6, 3)): 34,
    (True, (3, 4, 6, 3)): 50,
    (True, (3, 4, 23, 3)): 101,
    (True, (3, 8, 36, 3)): 152,
}
"""Bottlenecks or basic blocks, and how many per stage -> layers."""

SCALE = "Scale."
"""Before every name of DeepLab_resnet_pretrained_init-f81d91e8.pth."""

CAFFE = "trained on B, G, R in 0..255 less the mean (model/inputs=caffe) with Caffe's strides"
CLASSIFIER = (r"fc\.", "ImageNet's classifier")


def recognise(contents: Contents) -> Facts | None:
    """A file with a ResNet's names at the top, or behind "Scale."."""
    names = contents.tensors.keys()
    prefix = SCALE if names and all(name.startswith(SCALE) for name in names) else ""
    shapes = {name.removeprefix(prefix): s for name, s in shapes_of(contents.tensors).items()}
    if not has_parts(shapes, "bn1.", "layer1.0.conv1.", "layer4.0.conv1."):
        return None
    bottlenecks = any(re.match(r"layer\d\.\d+\.conv3\.", name) for name in shapes)
    blocks = tuple(count_blocks(shapes, rf"layer{stage}\.(\d+)\.") for stage in range(1, 5))
    layers = DEPTHS.get((bottlenecks, blocks))
    return Facts(
        layout="resnet",
        what="DeepLab v2 start of AdaptSegNet and ADVENT" if prefix else "ImageNet ResNet",
        size=f"ResNet-{layers}" if layers else "",
        prefix=prefix,
        fits=_fits(layers, bool(prefix)),
        remarks=(CAFFE,) if prefix else (),
    )


def _fits(layers: int | None, is_caffe: bool) -> tuple[tuple[str, ...], ...]:
    if layers is None:
        return ()
    if is_caffe:
        return (("model=deeplabv2", "model/inputs=caffe"),) if layers == 101 else ()
    others = {50: (("model=heatnet",),), 101: (("model=deeplabv2",),)}
    return ((f"model=rtfnet_{layers}",), *others.get(layers, ()))


def rule(family: str, model: nn.Module, facts: Facts) -> Rule | None:
    """How each family takes a ResNet; None where the file is AdaptSegNet's and it is not DeepLab.

    A thermal stem gets the mean over the RGB stem's input channels, or a copy if it has as many.
    """
    if family == "deeplabv2":
        return _deeplab(facts)
    if facts.prefix:
        return None
    return {"rtfnet": _rtfnet, "pspnet": _pspnet}.get(family, lambda _: None)(model)


def _rtfnet(model: nn.Module) -> Rule:
    """RTFNet: both encoders.

    Released: the thermal stem is the mean of the RGB stem. Paper (model.thermal_stem=xavier): it is
    drawn anew, like the decoder.
    """
    anew = record_of(model).drawn_anew
    return Rule(
        source=lambda entry: re.sub(r"^encoder_(rgb|thermal)_", "", entry),
        fresh=(
            (r"deconv\d\.", NOT_IN_FILE),
            *((re.escape(part), why) for part, why in anew.items()),
        ),
        leftover=(CLASSIFIER,),
        stems=("encoder_thermal_conv1.weight",),
    )


def _pspnet(model: nn.Module) -> Rule:
    """PSPNet: stem and first two stages of each image, then the shared stages.

    Released: HeatNet starts from random weights. With two branches layer3 takes both, so its first
    convolution cannot come from the file and its projection has no place. With one stem for all
    four channels, thermal gets the mean of the RGB ones.
    """
    shapes = shapes_of(model.state_dict())
    two = any(name.startswith("feats.layer2_2.") for name in shapes)
    both = "takes both images in late fusion"
    return Rule(
        source=lambda entry: re.sub(r"^feats\.(\w+?)(_2)?\.", r"\1.", entry),
        fresh=(
            (r"(psp|up_\d|final)\.", NOT_IN_FILE),
            *(((r"feats\.layer3\.0\.conv1\.", both),) if two else ()),
        ),
        leftover=(
            CLASSIFIER,
            *(((r"layer3\.0\.(conv1|downsample)\.", f"layer3 {both}"),) if two else ()),
        ),
        stems=("feats.conv1.weight", "feats.conv1_2.weight"),
    )


def _deeplab(facts: Facts) -> Rule:
    """DeepLab v2: the backbone, under torchvision's names.

    Released: AdaptSegNet and ADVENT start from their own file and skip its classifier, layer5.
    """
    strides = "its strides sit on the 3x3 convolutions, this backbone's on the first 1x1"
    return Rule(
        source=lambda entry: entry.removeprefix("backbone."),
        fresh=((r"(heads|auxiliary)\.", "not part of the file's network"),),
        leftover=(CLASSIFIER, (r"layer5\.", "classifier of the file's own classes")),
        remarks=() if facts.prefix else (strides,),
    )
