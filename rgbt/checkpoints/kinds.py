"""Kinds of files of weights: how each is recognised, and where its tensors go in a network.

`KINDS` has a row for each kind of file that a family of networks takes: files of whole networks as
their authors publish them, and of ImageNet backbones. The names here are those of the releases but
for a prefix and a few words. How a file is read and loaded is in `files` and `load`.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

from torch import Tensor, nn

Tensors = Mapping[str, Tensor]

# Regular expression that fits no name.
NONE = r"(?!)"


@dataclass(frozen=True)
class Kind:
    """A kind of file, and how a network of one family is filled from it.

    Attributes:
        title: what the file is.
        has: beginnings of names, behind the prefix, that the file has.
        prefix: before every name that belongs to the network.
        needs: beginning of an entry that the network has; "": any network of the family.
        source: entry of the network -> name in the file, behind the prefix.
        unused: regular expression for names of the file that the network has no place for.
        fresh: for entries that such a file does not hold; a backbone has some.
        stems: for first convolutions, which may have other input channels than in the file.
        convention: overrides for inputs and evaluation of the release, which weights do not show.
    """

    title: str
    has: tuple[str, ...] = ()
    prefix: str = ""
    needs: str = ""
    source: Callable[[str], str] = str
    unused: str = NONE
    fresh: str = NONE
    stems: str = NONE
    convention: tuple[str, ...] = ()

    def recognises(self, names: Tensors) -> bool:
        """Whether a file with these names is of this kind."""
        return all(any(name.startswith(self.prefix + part) for name in names) for part in self.has)


def renaming(*names: tuple[str, str]) -> Callable[[str], str]:
    """Return a function that replaces pairs (regular expression, replacement) in turn in a name."""

    def renamed(name: str) -> str:
        for pattern, replacement in names:
            name = re.sub(pattern, replacement, name)
        return name

    return renamed


# Mask2Former: CRM and SpatialSeg, and Swin Transformers for both branches.

BRANCH = r"backbone\.(RGB|THR)_branch\."
CRM = Kind(
    "checkpoint of CRM or SpatialSeg",
    has=("backbone.RGB_branch.", "sem_seg_head."),
    prefix="network.",  # attribute of the LightningModule
    unused=r".*\.relative_position_index$|criterion\.empty_weight$",
    convention=("model/inputs=crm",),
)
# Released: DetectionCheckpointer with the thermal convolution averaged (keepdim). The file's last
# normalisation is not norm3.
SWIN = Kind(
    "ImageNet Swin Transformer",
    has=("patch_embed.proj.", "layers.0.blocks.0.attn.qkv.", "layers.0.downsample."),
    source=renaming((f"^{BRANCH}", "")),
    unused=r".*\.(relative_position_index|attn_mask)$|norm\.|head\.",
    fresh=rf"{BRANCH}(mask_token$|norm[0-3]\.)|backbone\.norm_layers\.|sem_seg_head\.",
    stems=r"backbone\.THR_branch\.patch_embed\.proj\.weight",
)

# timm 0.9 and later has the merging of two stages in the second (`checkpoint_filter_fn` of swin).
TIMM_SWIN = replace(
    SWIN,
    title="ImageNet Swin Transformer of timm",
    has=(*SWIN.has[:2], "layers.3.downsample."),
    source=renaming(
        (f"^{BRANCH}", ""),
        *((rf"^layers\.{n}\.downsample", f"layers.{n + 1}.downsample") for n in (2, 1, 0)),
    ),
)

# CMX and CMNeXt. Released: CMX and the temporal release feed thermal three times, so that the stem
# is copied; one of one channel gets the mean.

CMX = Kind(
    "CMX checkpoint",
    has=("backbone.patch_embed", "backbone.extra_patch_embed", "backbone.F"),
    convention=("model/inputs=cmx_released", "model.decoder_norm_eps_eval=1e-5"),
)
TEMPORAL = replace(
    CMX,
    title="CMX checkpoint of the temporal release",
    has=(*CMX.has, "voting."),
    unused=r"voting\.",  # which it never uses
    convention=("model/inputs=temporal",),
)
MIT = Kind(
    "ImageNet MiT",
    has=("patch_embed1.", "block1.0.attn."),
    source=renaming((r"^backbone\.(extra_)?", "")),
    unused=r"head\.",
    fresh=r"backbone\.F[RF]Ms\.|decode_head\.",
    stems=r"backbone\.extra_patch_embed1\.proj\.weight",
)

# Source: DELIVER release, with two modalities. The thermal patch embeddings, numbered from 0 there,
# and the decoder have other names than here, where they are those of CMX.
LAYERS = r"^(backbone\.extra_downsample_layers\.\d"
CMNEXT = Kind(
    "CMNeXt checkpoint",
    has=("backbone.patch_embed", "backbone.extra_block1.0.c_nets.", "backbone.extra_downsample_"),
    source=renaming(
        *((f"extra_patch_embed{n + 1}", f"extra_downsample_layers.{n}") for n in range(4)),
        (rf"{LAYERS}\.proj)", r"\1.module"),
        (rf"{LAYERS}\.norm)", r"\1.ln_0"),
        (r"(linear_fuse)\.0", r"\1.conv"),
        (r"(linear_fuse)\.1", r"\1.bn"),
    ),
    convention=("model/inputs=imagenet_unit",),
)

# Networks with a ResNet.

RESNET = Kind("ImageNet ResNet", has=("bn1.", "layer1.0.conv1.", "layer4.0.conv1."), unused=r"fc\.")
# HeatNet itself starts from random weights.
PSPNET_RESNET = replace(
    RESNET,
    source=renaming((r"^feats\.(\w+?)(_2)?\.", r"\1.")),
    fresh=r"(psp|up_\d|final)\.",
    stems=r"feats\.conv1(_2)?\.weight",
)
# The third stage of late fusion takes both images.
LATE_RESNET = replace(
    PSPNET_RESNET,
    needs="feats.layer2_2.",
    fresh=rf"{PSPNET_RESNET.fresh}|feats\.layer3\.0\.conv1\.",
    unused=r"fc\.|layer3\.0\.(conv1|downsample)\.",
)
# Number of a layer in the stem of semseg -> name in its ImageNet file, resnet50_v2.pth.
STEM = {"0": "conv1", "1": "bn1", "3": "conv2", "4": "bn2", "6": "conv3", "7": "bn3"}

DEEPLAB_RESNET = replace(
    RESNET,
    title="ImageNet ResNet (its strides sit on the 3x3 convolutions, not on the first 1x1)",
    source=renaming((r"^backbone\.", "")),
    fresh=r"(heads|auxiliary)\.",
)
# Released: AdaptSegNet and ADVENT start from their own file and skip its classifier, layer5. It was
# trained on B, G, R in 0..255 less the mean.
CAFFE_RESNET = replace(
    DEEPLAB_RESNET,
    title="DeepLab v2 start of AdaptSegNet and ADVENT",
    prefix="Scale.",
    unused=r"(fc|layer5)\.",
    convention=("model/inputs=caffe",),
)

# Vision transformers of DINOv2 and DINOv3, in the names of their authors and of other programs.

ENCODER = "backbone.encoder."
OUTSIDE = r"(?!backbone\.encoder\.)"
BLOCK = ("patch_embed.proj.", "blocks.0.attn.qkv.")
DINOV2 = Kind(
    "DINOv2 vision transformer",
    has=("cls_token", "pos_embed", "mask_token", "blocks.0.ls1.", *BLOCK),
    source=renaming((rf"^{ENCODER}", "")),
    fresh=OUTSIDE,
    convention=("model/inputs=cmx", "model.position_resize=factor"),
)
# Convention of files with registers.
SIZE = ("model/inputs=cmx", "model.position_resize=size")


# The released files hold the periods of the positions rounded to bfloat16.
DINOV3 = Kind(
    "DINOv3 vision transformer",
    has=("storage_tokens", "rope_embed.periods", "blocks.0.ls1.", *BLOCK),
    source=renaming((rf"^{ENCODER}", ""), ("^register_tokens$", "storage_tokens")),
    unused=r"blocks\.\d+\.attn\.qkv\.bias_mask$",
    fresh=OUTSIDE,
    convention=("model/inputs=cmx", "model.norm_eps=1e-05", "model.rope_base=100.0"),
)


# EfficientNet-Lite. The head of the classifier has a normalisation with the name of no branch.
LITE = Kind(
    "ImageNet EfficientNet-Lite",
    has=("_conv_stem.", "_bn0.", "_blocks.0._depthwise_conv."),
    source=renaming((r"^backbone\.encoders\.(rgb|thermal)\.", "")),
    unused=r"_(conv_head|bn1|fc)\.",
    fresh=r"(?!backbone\.encoders\.)",
    convention=("model/inputs=lite",),
)


# Module of rgbt.models -> kinds of files for its networks, in the order they are tried.
KINDS: Mapping[str, tuple[Kind, ...]] = {
    "mask2former": (CRM, replace(CRM, prefix=""), SWIN, TIMM_SWIN),
    "cmnext": (
        CMNEXT,
        replace(CMNEXT, has=CMNEXT.has[:2], source=str),  # with the names here
        replace(
            MIT,
            source=renaming((r"^backbone\.", "")),
            fresh=r"backbone\.(extra_|F[RF]Ms\.)|decode_head\.",
            stems=NONE,
        ),
    ),
    "cmx": (TEMPORAL, CMX, MIT),
    "rtfnet": (
        # Old files have no counters of batch normalisation.
        Kind(
            "RTFNet checkpoint",
            has=("encoder_rgb_", "encoder_thermal_", "deconv"),
            convention=("model/inputs=unit", "model.final_relu=true"),
        ),
        # Released: the thermal stem is the mean. Paper (model.thermal_stem=xavier): it is drawn.
        replace(
            RESNET,
            source=renaming((r"^encoder_(rgb|thermal)_", "")),
            fresh=r"deconv\d\.",
            stems=r"encoder_thermal_conv1\.weight",
        ),
    ),
    "mfnet": (
        Kind(
            "MFNet checkpoint",
            has=("conv1_rgb.conv.", "conv1_inf.conv.", "decode"),  # "inf" is thermal
            convention=("model/inputs=unit", "model.final_activation=true"),
        ),
    ),
    "pspnet": (
        Kind(
            "HeatNet checkpoint",
            has=("feats.",),
            prefix="trgb_segnet.",
            unused=r"critics\.",  # discriminators, which are separate networks here
            convention=("model/inputs=half", "model.align_corners=false"),
        ),
        LATE_RESNET,
        PSPNET_RESNET,
    ),
    "semseg": (
        Kind(
            "PSPNet checkpoint of semseg",
            has=("layer0.6.", "ppm.features.", "cls.4."),
            convention=("model/inputs=cmx",),
        ),
        replace(
            RESNET,
            title="ImageNet ResNet of semseg, with three stem convolutions",
            has=(*RESNET.has, "conv3.", "bn3."),
            source=renaming(*((rf"^layer0\.{n}\.", f"{name}.") for n, name in STEM.items())),
            fresh=r"(ppm|cls|aux)\.",
        ),
    ),
    "efficientnet_lite": (LITE,),
    "deeplabv2": (CAFFE_RESNET, DEEPLAB_RESNET),
    "dinov2": (
        replace(DINOV2, has=(*DINOV2.has, "register_tokens"), convention=SIZE),
        DINOV2,
        DINOV3,
    ),
}

OWN = Kind("file of rgbt")


def family_of(network: type[nn.Module]) -> str:
    """Return the module of rgbt.models that a class or a base of it is from, "" for all others."""
    for base in network.__mro__:
        family = family_named(base.__module__)
        if family:
            return family
    return ""


def family_named(path: str) -> str:
    """Return the same for a dotted path: "cmx" for "rgbt.models.cmx.model.CMX"."""
    words = path.split(".")
    return words[2] if words[:2] == ["rgbt", "models"] and len(words) > 2 else ""
