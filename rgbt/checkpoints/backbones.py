"""Recognise files of ImageNet backbones, and map them to the networks.

Swin Transformers (the original files and those of timm), MiT (``mit_b0.pth`` to ``mit_b5.pth``),
ResNets of torchvision, and the DeepLab v2 start of AdaptSegNet and ADVENT.
"""

from __future__ import annotations

import math
import re
from dataclasses import replace

from torch import nn

from rgbt.checkpoints.layout import (
    DERIVED,
    NOT_IN_FILE,
    Facts,
    Layout,
    Rule,
    Shapes,
    count_blocks,
    has_parts,
    shapes_of,
    size_at,
)
from rgbt.checkpoints.read import Contents
from rgbt.checks import InputError
from rgbt.requirements import record_of

CLASSIFIER = "ImageNet's classifier"

SWINS: dict[tuple[int, tuple[int, ...]], str] = {
    (96, (2, 2, 6, 2)): "swin_t",
    (96, (2, 2, 18, 2)): "swin_s",
    (128, (2, 2, 18, 2)): "swin_b",
    (192, (2, 2, 18, 2)): "swin_l",
}
"""Channels of the first stage and blocks per stage -> name."""

SWIN_TITLES = {"swin_t": "Swin-T", "swin_s": "Swin-S", "swin_b": "Swin-B", "swin_l": "Swin-L"}
LABELS_22K = (21841, 21842)
MERGING = "layers.{}.downsample.reduction.weight"
"""Stage -> a name of the patch merging that is saved with it; no file has it in all four."""

TABLE = "layers.0.blocks.0.attn.relative_position_bias_table"
BRANCHES = ("backbone.RGB_branch.", "backbone.THR_branch.")


def swin_size(shapes: Shapes, prefix: str) -> str:
    """The name of the size of the Swin behind `prefix`, "" for unpublished ones."""
    depths = tuple(
        count_blocks(shapes, rf"{re.escape(prefix)}layers\.{stage}\.blocks\.(\d+)\.")
        for stage in range(4)
    )
    return SWINS.get((size_at(shapes, f"{prefix}patch_embed.norm.weight") or 0, depths), "")


def _recognise_swin(contents: Contents) -> Facts | None:
    """A file with Swin's names at the top.

    timm 0.9 and later (timm/models/swin_transformer.py, `checkpoint_filter_fn`) saves the merging
    between two stages with the second of them; the original files have it with the first.
    """
    shapes = shapes_of(contents.tensors)
    if not has_parts(shapes, "patch_embed.proj.", "layers.0.blocks.0.attn.qkv."):
        return None
    size = swin_size(shapes, "")
    is_timm = MERGING.format(3) in shapes and MERGING.format(0) not in shapes
    labels = size_at(shapes, "head.fc.weight" if is_timm else "head.weight")
    return Facts(
        layout="swin_timm" if is_timm else "swin",
        what=f"ImageNet Swin Transformer{' of timm' if is_timm else ''}",
        size=SWIN_TITLES.get(size, ""),
        fits=((f"model=mask2former_{size}",),) if size and size != "swin_l" else (),
        window=_window(size_at(shapes, TABLE)),
        remarks=("trained on ImageNet-22k",) if labels in LABELS_22K else (),
    )


def _window(rows: int | None) -> int | None:
    """Side of an attention window from the rows of its bias table, (2 w - 1)^2."""
    return None if rows is None else (math.isqrt(rows) + 1) // 2


def _swin_rule(family: str, model: nn.Module, facts: Facts) -> Rule | None:
    """Both branches get the file; the thermal patch convolution its mean over the input channels.

    Released: CRM and SpatialSeg, DetectionCheckpointer with the thermal convolution averaged
    (keepdim). Output normalisations, mask tokens, fusion and head are not in the file; the file's
    last normalisation is not norm3.

    Raises:
        InputError: windows of another size.
    """
    if family != "mask2former":
        return None
    own = _window(size_at(shapes_of(model.state_dict()), f"{BRANCHES[0]}{TABLE}"))
    if own != facts.window and facts.window is not None:
        raise InputError(
            f"an {facts.title} with windows of {facts.window} x {facts.window} tokens, while those "
            f"of this network are {own} x {own} and their bias tables cannot be exchanged; use "
            "the file for windows of that size (7 x 7: ImageNet at 224 pixels)."
        )
    return Rule(
        source=lambda entry: entry.removeprefix(BRANCHES[0]).removeprefix(BRANCHES[1]),
        fresh=(
            (r"backbone\.(RGB|THR)_branch\.mask_token$", NOT_IN_FILE),
            (r"backbone\.(RGB|THR)_branch\.norm[0-3]\.", NOT_IN_FILE),
            (r"backbone\.norm_layers\.", NOT_IN_FILE),
            (r"sem_seg_head\.", NOT_IN_FILE),
        ),
        leftover=(
            (r".*\.relative_position_index$", DERIVED),
            (r".*\.attn_mask$", DERIVED),
            (r"norm\.", "normalises ImageNet's last features, which the decoder does not use"),
            (r"head\.", CLASSIFIER),
        ),
        stems=("backbone.THR_branch.patch_embed.proj.weight",),
    )


def _timm_swin_rule(family: str, model: nn.Module, facts: Facts) -> Rule | None:
    """As `_swin_rule`; the merging behind stage s is called that of stage s + 1."""
    rule = _swin_rule(family, model, facts)
    if rule is None:
        return None

    def source(entry: str) -> str:
        later = re.fullmatch(r"layers\.(\d)\.(downsample\..*)", name := rule.source(entry))
        return f"layers.{int(later[1]) + 1}.{later[2]}" if later else name

    return replace(rule, source=source)


MITS: dict[tuple[int, tuple[int, ...]], str] = {
    (32, (2, 2, 2, 2)): "b0",
    (64, (2, 2, 2, 2)): "b1",
    (64, (3, 4, 6, 3)): "b2",
    (64, (3, 4, 18, 3)): "b3",
    (64, (3, 8, 27, 3)): "b4",
    (64, (3, 6, 40, 3)): "b5",
}
"""Channels of the first stage and blocks per stage -> name."""


def mit_size(shapes: Shapes, prefix: str) -> str:
    """The size (b0 to b5) of the stream behind `prefix`, "" for unpublished ones."""
    depths = tuple(count_blocks(shapes, rf"{prefix}block{stage}\.(\d+)\.") for stage in range(1, 5))
    return MITS.get((size_at(shapes, f"{prefix}patch_embed1.norm.weight") or 0, depths), "")


def mit_title(size: str) -> str:
    """The size as it is printed: MiT-B2."""
    return f"MiT-{size.upper()}" if size else ""


def _recognise_mit(contents: Contents) -> Facts | None:
    """A file with one stream at the top."""
    shapes = shapes_of(contents.tensors)
    if not has_parts(shapes, "patch_embed1.", "block1.0.attn."):
        return None
    size = mit_size(shapes, "")
    fits = ((f"model=cmx_{size}",), (f"model=cmnext_{size}",)) if size else ()
    return Facts(layout="mit", what="ImageNet MiT", size=mit_title(size), fits=fits)


def _mit_rule(family: str, _model: nn.Module, _facts: Facts) -> Rule | None:
    """Both streams of CMX get the file, and the RGB stream of CMNeXt, whose other one is no MiT.

    A thermal stem of one channel gets the mean over the input channels.   Released: CMX and the
    temporal release feed thermal three times, so that the stem is copied.
    """
    if family == "cmnext":
        return Rule(
            source=lambda entry: entry.removeprefix("backbone."),
            fresh=((r"backbone\.(extra_|F[RF]Ms\.)", NOT_IN_FILE), (r"decode_head\.", NOT_IN_FILE)),
            leftover=((r"head\.", CLASSIFIER),),
        )
    if family != "cmx":
        return None
    return Rule(
        source=lambda entry: entry.removeprefix("backbone.").removeprefix("extra_"),
        fresh=((r"backbone\.F[RF]Ms\.", NOT_IN_FILE), (r"decode_head\.", NOT_IN_FILE)),
        leftover=((r"head\.", CLASSIFIER),),
        stems=("backbone.extra_patch_embed1.proj.weight",),
    )


RESNETS: dict[tuple[bool, tuple[int, ...]], int] = {
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
STRIDES = "its strides sit on the 3x3 convolutions, this backbone's on the first 1x1"
FC = (r"fc\.", CLASSIFIER)
DEEP_RESNET = "ImageNet ResNet of semseg, with three stem convolutions"
STEM = {"0": "conv1", "1": "bn1", "3": "conv2", "4": "bn2", "6": "conv3", "7": "bn3"}
"""Number of a layer in semseg's stem -> name in its ImageNet file."""


def resnet_layers(shapes: Shapes, prefix: str) -> int | None:
    """Layers of the ResNet behind `prefix`, None for unpublished ones."""
    bottlenecks = any(re.match(rf"{prefix}layer\d\.\d+\.conv3\.", name) for name in shapes)
    blocks = tuple(count_blocks(shapes, rf"{prefix}layer{stage}\.(\d+)\.") for stage in range(1, 5))
    return RESNETS.get((bottlenecks, blocks))


def _recognise_resnet(contents: Contents) -> Facts | None:
    """A file with a ResNet's names at the top, or behind "Scale."."""
    names = contents.tensors.keys()
    is_caffe = bool(names) and all(name.startswith(SCALE) for name in names)
    prefix = SCALE if is_caffe else ""
    shapes = {name.removeprefix(prefix): s for name, s in shapes_of(contents.tensors).items()}
    if not has_parts(shapes, "bn1.", "layer1.0.conv1.", "layer4.0.conv1."):
        return None
    layers = resnet_layers(shapes, "")
    if has_parts(shapes, "conv3.", "bn3."):
        return Facts(
            layout="resnet",
            what=DEEP_RESNET,
            size=f"ResNet-{layers}" if layers else "",
            fits=(("model=semseg",),) if layers == 50 else (),
        )
    fits: tuple[tuple[str, ...], ...] = ()
    if is_caffe and layers == 101:
        fits = (("model=deeplabv2", "model/inputs=caffe"),)
    elif layers and not is_caffe:
        others = {50: (("model=heatnet",),), 101: (("model=deeplabv2",),)}
        fits = ((f"model=rtfnet_{layers}",), *others.get(layers, ()))
    return Facts(
        layout="resnet",
        what="DeepLab v2 start of AdaptSegNet and ADVENT" if is_caffe else "ImageNet ResNet",
        size=f"ResNet-{layers}" if layers else "",
        prefix=prefix,
        fits=fits,
        remarks=(CAFFE,) if is_caffe else (),
    )


def _resnet_rule(family: str, model: nn.Module, facts: Facts) -> Rule | None:
    """How each family takes a ResNet; None where the file is AdaptSegNet's and it is not DeepLab.

    A thermal stem gets the mean over the RGB stem's input channels, or a copy if it has as many.
    Released: AdaptSegNet and ADVENT start from their own file and skip its classifier, layer5.
    """
    if family == "deeplabv2":
        return Rule(
            source=lambda entry: entry.removeprefix("backbone."),
            fresh=((r"(heads|auxiliary)\.", "not part of the file's network"),),
            leftover=(FC, (r"layer5\.", "classifier of the file's own classes")),
            remarks=() if facts.prefix else (STRIDES,),
        )
    if facts.prefix or (facts.what == DEEP_RESNET) != (family == "semseg"):
        return None
    return {"semseg": _semseg, "rtfnet": _rtfnet, "pspnet": _pspnet}.get(family, lambda _: None)(
        model
    )


def _rtfnet(model: nn.Module) -> Rule:
    """RTFNet: both encoders.

    Released: the thermal stem is the mean of the RGB stem. Paper (model.thermal_stem=xavier): it is
    drawn anew, like the decoder.
    """
    anew = ((re.escape(part), why) for part, why in record_of(model).drawn_anew.items())
    return Rule(
        source=lambda entry: re.sub(r"^encoder_(rgb|thermal)_", "", entry),
        fresh=((r"deconv\d\.", NOT_IN_FILE), *anew),
        leftover=(FC,),
        stems=("encoder_thermal_conv1.weight",),
    )


def _pspnet(model: nn.Module) -> Rule:
    """PSPNet: stem and first two stages of each image, then the shared stages.

    Released: HeatNet starts from random weights. With two branches layer3 takes both, so its first
    convolution cannot come from the file and its projection has no place. With one stem for all
    four channels, thermal gets the mean of the RGB ones.
    """
    two = any(name.startswith("feats.layer2_2.") for name in model.state_dict())
    both = "takes both images in late fusion"
    fresh = ((r"feats\.layer3\.0\.conv1\.", both),) if two else ()
    leftover = ((r"layer3\.0\.(conv1|downsample)\.", f"layer3 {both}"),) if two else ()
    return Rule(
        source=lambda entry: re.sub(r"^feats\.(\w+?)(_2)?\.", r"\1.", entry),
        fresh=((r"(psp|up_\d|final)\.", NOT_IN_FILE), *fresh),
        leftover=(FC, *leftover),
        stems=("feats.conv1.weight", "feats.conv1_2.weight"),
    )


def _semseg(_: nn.Module) -> Rule:
    """PSPNet of semseg: its ImageNet file, resnet50_v2.pth, has three stem convolutions.

    Released: hszhao/semseg. The pooling and both heads are drawn.
    """

    def source(entry: str) -> str:
        return re.sub(r"^layer0\.(\d)\.", lambda found: f"{STEM[found[1]]}.", entry)

    return Rule(source=source, fresh=((r"(ppm|cls|aux)\.", NOT_IN_FILE),), leftover=(FC,))


BACKBONES = {
    "mit": Layout(_recognise_mit, _mit_rule),
    "swin": Layout(_recognise_swin, _swin_rule),
    "swin_timm": Layout(_recognise_swin, _timm_swin_rule),
    "resnet": Layout(_recognise_resnet, _resnet_rule),
}
"""By name; tried after the whole networks."""
