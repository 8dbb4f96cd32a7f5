"""Published files that the recipes start from, and which recipe starts from which file.

The page reference/weights.md of the documentation and `rgbt weights inspect` show this table. A
recipe is an experiment at scale=paper. Nothing here is downloaded.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from fnmatch import fnmatchcase

from rgbt.checkpoints.layout import Facts

DIGITS = 8
"""Hexadecimal digits of a SHA-256 in the names of PyTorch's files, and in `Start.digest`."""


@dataclass(frozen=True)
class Start:
    """A published file of weights of a backbone, or of a whole network for `model.weights`.

    Attributes:
        file: its name.
        trained_on: architecture and pretraining.
        origin: where its authors publish it.
        models: networks (`model=`) that it fits.
        digest: first digits of its SHA-256; "" where its authors state none.
    """

    file: str
    trained_on: str
    origin: str
    models: tuple[str, ...]
    digest: str = ""


@dataclass(frozen=True)
class Recipe:
    """Experiments that start from the same files.

    Attributes:
        experiments: names, or patterns with *.
        model: beginning of the names of their networks.
        files: of `STARTS`; none: the network starts from random values.
        source: who starts so.
    """

    experiments: tuple[str, ...]
    model: str
    files: tuple[str, ...]
    source: str

    def named(self, experiments: Collection[str]) -> tuple[str, ...]:
        """Those of `experiments` that are meant."""
        patterns = self.experiments
        return tuple(n for n in experiments if any(fnmatchcase(n, each) for each in patterns))


WINDOW = 7
"""Side of the attention windows of every recipe, in tokens."""

SWIN = "github.com/SwinTransformer/storage, release v1.0.0"
SEGFORMER = "github.com/NVlabs/SegFormer"
DINOV2 = "dl.fbaipublicfiles.com/dinov2"
DINOV3 = "ai.meta.com/resources/models-and-libraries/dinov3-downloads (a link by mail)"
IMAGENET = "ImageNet-1K, 224 x 224 pixels"
RESNETS = {
    18: ("f37072fd", "5c106cde"),
    34: ("b627a593", "333f7ec4"),
    50: ("0676ba61", "19c8e357"),
    101: ("63fe2227", "5d3b4d8f"),
    152: ("394f9c45", "b121ed2d"),
}
"""Layers -> digests of the file of today and of the one before."""

STARTS = (
    # The digest is that of a public copy of the same name with 114,342,173 bytes.
    Start(
        "swin_tiny_patch4_window7_224.pth",
        f"Swin-T, {IMAGENET}",
        SWIN,
        ("mask2former_swin_t",),
        "9f71c168",
    ),
    Start(
        "swin_small_patch4_window7_224.pth", f"Swin-S, {IMAGENET}", SWIN, ("mask2former_swin_s",)
    ),
    Start("swin_base_patch4_window7_224.pth", f"Swin-B, {IMAGENET}", SWIN, ("mask2former_swin_b",)),
    Start(
        "swin_base_patch4_window7_224_22kto1k.pth",
        f"Swin-B, ImageNet-22K, then {IMAGENET}",
        SWIN,
        ("mask2former_swin_b",),
    ),
    *(
        Start(
            f"mit_b{size}.pth",
            f"MiT-B{size}, {IMAGENET}",
            SEGFORMER,
            (f"cmx_b{size}", f"cmnext_b{size}"),
        )
        for size in range(6)
    ),
    Start(
        "cmnext_b4_mfnet_rgbt.pth",
        "whole CMNeXt-B4, trained on MFNet, its epoch selected on the test images",
        "github.com/jamycheung/DELIVER (Google Drive)",
        ("cmnext_b4",),
    ),
    # Since April 2021 (pytorch/vision, pull request 3620) the same weights are stored anew.
    *(
        Start(
            f"resnet{layers}-{digest}.pth",
            f"ResNet-{layers}, {IMAGENET} ({since})",
            "download.pytorch.org/models",
            (f"rtfnet_{layers}", *(("deeplabv2",) if layers == 101 else ())),
            digest,
        )
        for layers, digests in RESNETS.items()
        for digest, since in zip(digests, ("IMAGENET1K_V1", "before 2021"), strict=True)
    ),
    Start(
        "DeepLab_resnet_pretrained_init-f81d91e8.pth",
        "ResNet-101 of DeepLab v2 (pretraining not stated)",
        "github.com/wasidennis/AdaptSegNet (vllab.ucmerced.edu)",
        ("deeplabv2",),
        "f81d91e8",
    ),
    Start(
        "resnet50_v2.pth",
        "ResNet-50 with three stem convolutions, ImageNet-1K",
        "github.com/hszhao/semseg (initmodel)",
        ("semseg",),
    ),
    *(
        Start(
            f"dinov2_vit{size}14{file}_pretrain.pth",
            f"ViT-{size.upper()}/14{registers}, DINOv2 on LVD-142M",
            f"{DINOV2}/dinov2_vit{size}14",
            (f"dinov2_vit{size}14{model}",),
        )
        for size in ("s", "b")
        for file, registers, model in (("", "", ""), ("_reg4", " with four registers", "_reg"))
    ),
    *(
        Start(
            f"dinov3_{model}_pretrain_lvd1689m-{digest}.pth",
            f"{size}/16, DINOv3 on LVD-1689M",
            DINOV3,
            (f"dinov3_{model}",),
            digest,
        )
        for model, size, digest in (
            ("vits16", "ViT-S", "08c60483"),
            ("vits16plus", "ViT-S+", "4057cbaa"),
            ("vitb16", "ViT-B", "73cec8be"),
        )
    ),
)

RECIPES = (
    Recipe(
        ("baseline", "crm*", "grbm*", "spatialseg*"),
        "mask2former",
        tuple(start.file for start in STARTS if start.file.startswith("swin_")),
        "CRM and SpatialSeg releases: Swin-T, -S or -B by the row; 22kto1k for Swin-B on KP alone",
    ),
    Recipe(
        ("dinov2",),
        "dinov2",
        tuple(start.file for start in STARTS if start.file.startswith("dinov2_")),
        "DINOv2 release; the combination with the head of Mask2Former is ours",
    ),
    Recipe(
        ("dinov3",),
        "dinov3",
        tuple(start.file for start in STARTS if start.file.startswith("dinov3_")),
        "DINOv3 release; the combination with the head of Mask2Former is ours",
    ),
    Recipe(("cmx*", "temporal_*"), "cmx", ("mit_b2.pth",), "CMX and Temporal releases"),
    Recipe(
        ("cmnext*",),
        "cmnext",
        ("mit_b4.pth",),
        "CMNeXt release (DELIVER): the RGB stream alone; the thermal stream is random",
    ),
    Recipe(
        ("rtfnet*",),
        "rtfnet",
        ("resnet152-394f9c45.pth", "resnet152-b121ed2d.pth"),
        "RTFNet release: torchvision's ResNet of its day, now IMAGENET1K_V1",
    ),
    Recipe(
        ("multi_head_*", "sh_*", "self_training_*"),
        "deeplabv2",
        ("DeepLab_resnet_pretrained_init-f81d91e8.pth", "resnet101-63fe2227.pth"),
        "thesis code: the first, with inputs of its own; the second has other strides",
    ),
    Recipe(
        ("heatnet*", "rgb_teacher", "thermal_teacher", "thermal_teacher_original"),
        "heatnet",
        (),
        "HeatNet release: N(0, 0.02)",
    ),
    Recipe(
        ("rgb_teacher_semseg", "thermal_teacher_semseg"),
        "semseg",
        ("resnet50_v2.pth",),
        "semseg, whose configuration the thesis code has; the thesis names no file",
    ),
    Recipe(("mfnet",), "mfnet", (), "MFNet release"),
)


def start_lines(
    facts: Facts, file: str, digest: str, experiments: Collection[str]
) -> list[tuple[str, str]]:
    """Which recipes a file fits and which published file it is, as lines of (word, text).

    Args:
        facts: of the file.
        file: its name.
        digest: its SHA-256 in hexadecimal.
        experiments: names of all experiments.
    """
    lines = []
    for override, *_ in facts.fits if facts.window in (None, WINDOW) else ():
        recipe = _recipe_of(facts, override)
        names = recipe.named(experiments) if recipe else ()
        key = "model.weights" if facts.family else "pretrained"
        if names:
            lines.append(("recipes", f"{', '.join(names)} (with {override} {key}=FILE)"))
    lines.append(("sha256", digest))
    for start in STARTS:
        if start.digest and digest.startswith(start.digest):
            lines.append(("published", f"{start.file}: {start.trained_on} ({start.origin})"))
        elif start.digest and start.file == file:
            remark = f"not the published {file}, whose SHA-256 begins with {start.digest}"
            lines.append(("remark", remark))
    return lines


def _recipe_of(facts: Facts, override: str) -> Recipe | None:
    """The recipe whose network a file holds, or whose backbone it starts."""
    model = override.removeprefix("model=")
    found = (each for each in RECIPES if model.startswith(each.model))
    return next((each for each in found if facts.family or each.files), None)
