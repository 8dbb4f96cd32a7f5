"""Recognise files of whole networks, from the releases and from rgbt, and map their names.

The names in a release's file are ours, but for its prefix and a few constants: each rule says what
is left over, and each `released_*` writes a network's entries under the released names.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor, nn

from rgbt.checkpoints import cmnext
from rgbt.checkpoints.backbones import (
    SWIN_TITLES,
    mit_size,
    mit_title,
    resnet_layers,
    swin_size,
)
from rgbt.checkpoints.layout import (
    DERIVED,
    FAMILIES,
    Facts,
    Layout,
    Reasons,
    Rule,
    RuleOf,
    has_parts,
    shapes_of,
    size_at,
)
from rgbt.checkpoints.read import Contents

EXTERNAL_PREFIX = "network."
"""Before the names of a network from elsewhere (`rgbt.models.external.network`)."""


def _own_names(*leftover: tuple[str, str]) -> RuleOf:
    """The rule of files whose names are the network's, less some (see `Rule.leftover`)."""
    reasons: Reasons = leftover

    def rule(_family: str, _model: nn.Module, _facts: Facts) -> Rule:
        return Rule(leftover=reasons)

    return rule


CRM_PREFIX = "network."
"""Attribute of the LightningModule of CRM and SpatialSeg."""

RGB, THERMAL = "backbone.RGB_branch.", "backbone.THR_branch."
CLASS_WEIGHT = "sem_seg_head.predictor.class_embed.weight"
NO_OBJECT = 0.1
"""Last of the released loss's class weights."""


def _recognise_mask2former(contents: Contents) -> Facts | None:
    """The whole RGB-T Mask2Former as Lightning stores it: the two branches and the head."""
    names = contents.tensors.keys()
    prefix = CRM_PREFIX if any(name.startswith(CRM_PREFIX) for name in names) else ""
    if not has_parts(names, f"{prefix}{RGB}", f"{prefix}sem_seg_head."):
        return None
    shapes = {name.removeprefix(prefix): s for name, s in shapes_of(contents.tensors).items()}
    rows = size_at(shapes, CLASS_WEIGHT)
    size = swin_size(shapes, RGB)
    # Settings that only the configuration in the file shows.
    settings = {key.split("MODEL.")[-1]: value for key, value in contents.settings.items()}
    joined = settings.get("FUSION.AGGREGATION")
    fusion = () if joined is None else (f"model.fusion={str(joined).lower()}",)
    start = settings.get("SWIN.SHARE_START_IDX", share_start(contents))
    share = (f"model.share_start={start}",) if start in (0, 1, 2, 3) else ()
    token = ("model.mask_token=shared",) if are_one(contents, "mask_token") else ()
    unusual = tuple(each for each in fusion if each != "model.fusion=max")
    return Facts(
        layout="mask2former",
        what="checkpoint of CRM or SpatialSeg",
        family="mask2former",
        size=SWIN_TITLES.get(size, ""),
        classes=None if rows is None else rows - 1,
        prefix=prefix,
        fits=((f"model=mask2former_{size}", *unusual, *share, *token),) if size else (),
        convention=("model/inputs=crm", *fusion),
    )


def share_start(contents: Contents) -> int:
    """First stage whose weights are one piece of memory under the names of both branches."""
    for stage in range(4):
        if are_one(contents, f"layers.{stage}.blocks.0.norm1.weight"):
            return stage
    return 4


def are_one(contents: Contents, name: str) -> bool:
    """Whether a tensor is one piece of memory under the names of both branches."""
    rgb, thermal = (
        next((t for key, t in contents.tensors.items() if key.endswith(f"{b}{name}")), None)
        for b in (RGB, THERMAL)
    )
    return rgb is not None and thermal is not None and rgb.data_ptr() == thermal.data_ptr()


def released_mask2former(state: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The released names: with the constants that are rebuilt here."""
    named = OrderedDict((f"{CRM_PREFIX}{key}", value) for key, value in state.items())
    for key, value in state.items():
        if key.endswith("relative_position_bias_table"):
            name = key.replace("bias_table", "index")
            named[f"{CRM_PREFIX}{name}"] = position_index(value.shape[0])
    empty = torch.ones(state[CLASS_WEIGHT].shape[0])
    empty[-1] = NO_OBJECT
    named[f"{CRM_PREFIX}criterion.empty_weight"] = empty
    return named


def position_index(rows: int) -> Tensor:
    """Row of the bias table for every pair of tokens of a window.

    Args:
        rows: of the table, (2 w - 1)^2 for windows of w x w tokens.

    Returns:
        (w^2, w^2) int64: (dy + w - 1) (2 w - 1) + dx + w - 1, first token less second.
    """
    span = round(rows**0.5)
    side = (span + 1) // 2
    y, x = torch.arange(side * side) // side, torch.arange(side * side) % side
    dy, dx = y[:, None] - y[None], x[:, None] - x[None]
    index: Tensor = (dy + side - 1) * span + dx + side - 1
    return index


CMX_CLASSIFIER = "decode_head.linear_pred.weight"
CMX_RELEASED = ("model/inputs=cmx_released", "model.decoder_norm_eps_eval=1e-5")
CMX_TEMPORAL = ("model/inputs=temporal",)


def _recognise_cmx(contents: Contents) -> Facts | None:
    """Both streams under `backbone.`; the unused `voting.` distinguishes the releases."""
    shapes = shapes_of(contents.tensors)
    if not has_parts(shapes, "backbone.patch_embed", "backbone.extra_patch_embed", "backbone.F"):
        return None
    temporal = has_parts(shapes, "voting.")
    size = mit_size(shapes, "backbone.")
    convention = CMX_TEMPORAL if temporal else CMX_RELEASED
    return Facts(
        layout="cmx",
        what="CMX checkpoint of the temporal release" if temporal else "CMX checkpoint",
        family="cmx",
        size=mit_title(size),
        classes=size_at(shapes, CMX_CLASSIFIER),
        fits=((f"model=cmx_{size}", *convention),) if size else (),
        convention=convention,
    )


def released_temporal(state: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The temporal release's names: CMX's and a convolution that it never uses, as zeros."""
    classes = state[CMX_CLASSIFIER].shape[0]
    voting = {"voting.weight": torch.zeros(classes, 2 * classes, 3, 3)}
    return OrderedDict(**state, **voting, **{"voting.bias": torch.zeros(classes)})


RTFNET_RELEASED = ("model/inputs=unit", "model.final_relu=true")


def _recognise_rtfnet(contents: Contents) -> Facts | None:
    """A bare state dict with both encoders and the decoder; old ones have no counters."""
    shapes = shapes_of(contents.tensors)
    if not has_parts(shapes, "encoder_rgb_", "encoder_thermal_", "deconv"):
        return None
    layers = resnet_layers(shapes, "encoder_rgb_")
    return Facts(
        layout="rtfnet",
        what="RTFNet checkpoint",
        family="rtfnet",
        size=f"ResNet-{layers}" if layers else "",
        classes=size_at(shapes, "deconv5.1.conv1.weight"),
        fits=((f"model=rtfnet_{layers}",),) if layers else (),
        convention=RTFNET_RELEASED,
    )


MFNET_WIDTHS = {"conv1_rgb": 16, "conv5_rgb.conv1_left": 48, "conv5_inf.conv1_left": 18}
"""Channels of some units of the published size."""

MFNET_RELEASED = ("model/inputs=unit", "model.final_activation=true")


def _recognise_mfnet(contents: Contents) -> Facts | None:
    """A bare state dict with both encoders ("inf" is thermal) and the decoder."""
    shapes = shapes_of(contents.tensors)
    if not has_parts(shapes, "conv1_rgb.conv.", "conv1_inf.conv.", "decode"):
        return None
    published = all(
        size_at(shapes, f"{unit}.conv.weight") == width for unit, width in MFNET_WIDTHS.items()
    )
    return Facts(
        layout="mfnet",
        what="MFNet checkpoint",
        family="mfnet",
        classes=size_at(shapes, "decode1.conv.weight"),
        fits=(("model=mfnet",),) if published else (),
        convention=MFNET_RELEASED,
    )


HEATNET_PREFIX = "trgb_segnet."
HEATNET_WRAPPED = "module."
"""Prefix of every name in the released files."""

HEATNET_STEMS = {1: "heatnet_thermal", 3: "heatnet_rgb", 4: "heatnet_early"}
"""Channels of a single stem -> configuration."""

HEATNET_RELEASED = ("model/inputs=half", "model.align_corners=false")


def _recognise_heatnet(contents: Contents) -> Facts | None:
    """The segmentation network and its discriminators in one module."""
    shapes = {
        name.removeprefix(HEATNET_PREFIX): shape
        for name, shape in shapes_of(contents.tensors).items()
        if name.startswith(HEATNET_PREFIX)
    }
    if not has_parts(shapes, "feats."):
        return None
    channels = size_at(shapes, "feats.conv1.weight", 1) or 0
    two = has_parts(shapes, "feats.conv1_2.")
    name = "heatnet" if two else HEATNET_STEMS.get(channels, "")
    return Facts(
        layout="heatnet",
        what="HeatNet checkpoint",
        family="pspnet",
        size="ResNet-50" if size_at(shapes, "feats.conv1.weight") == 64 else "",
        classes=size_at(shapes, "final.0.weight"),
        prefix=HEATNET_PREFIX,
        fits=((f"model={name}",),) if name else (),
        convention=HEATNET_RELEASED,
    )


def released_heatnet(state: Mapping[str, Tensor]) -> dict[str, Any]:
    """The network's released names; there are none of discriminators."""
    return OrderedDict((f"{HEATNET_WRAPPED}{HEATNET_PREFIX}{k}", v) for k, v in state.items())


SEMSEG = ("model/inputs=cmx",)


def _recognise_semseg(contents: Contents) -> Facts | None:
    """PSPNet as semseg's training script stores it."""
    shapes = shapes_of(contents.tensors)
    if not has_parts(shapes, "layer0.6.", "ppm.features.", "cls.4."):
        return None
    layers = resnet_layers(shapes, "")
    return Facts(
        layout="semseg",
        what="PSPNet checkpoint of semseg",
        family="semseg",
        size=f"ResNet-{layers}" if layers else "",
        classes=size_at(shapes, "cls.4.weight"),
        fits=(("model=semseg",),) if layers == 50 else (),
        convention=SEMSEG,
    )


RELEASES = {
    **cmnext.LAYOUTS,
    "mask2former": Layout(
        _recognise_mask2former,
        _own_names(
            (r".*\.relative_position_index$", DERIVED),
            (r"criterion\.empty_weight$", "belongs to the loss"),
        ),
    ),
    "cmx": Layout(_recognise_cmx, _own_names((r"voting\.", "never used by the temporal release"))),
    "rtfnet": Layout(_recognise_rtfnet, _own_names()),
    "mfnet": Layout(_recognise_mfnet, _own_names()),
    "semseg": Layout(_recognise_semseg, _own_names()),
    "heatnet": Layout(
        _recognise_heatnet,
        _own_names((r"critics\.", "a discriminator, which is a separate network here")),
    ),
}
"""By name."""


def released_external(state: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The author's names of a network from elsewhere, without the beginning that they have here."""
    return OrderedDict((name.removeprefix(EXTERNAL_PREFIX), each) for name, each in state.items())


def _recognise_own(contents: Contents) -> Facts | None:
    """A file with a note that rgbt wrote it; the network is recognised by its names."""
    if not contents.ours:
        return None
    guesses = (layout.recognise(contents) for layout in RELEASES.values())
    guess = next((facts for facts in guesses if facts is not None), Facts("own", ""))
    family = contents.note.get("family", "") or guess.family
    what = "export of a run" if contents.note else "checkpoint of a run"
    return Facts(
        layout="own",
        what=f"{what}, {FAMILIES.get(family, family)}" if family else what,
        family=family,
        size=guess.size,
        classes=guess.classes,
        fits=tuple(overrides[:1] for overrides in guess.fits),
    )


NETWORKS = {"own": Layout(_recognise_own, _own_names()), **RELEASES}
"""By name, in the order they are tried."""
