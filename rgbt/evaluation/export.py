"""Export a trained network to a file, after its graph was compared with the network."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor
from torch.nn import functional as F

import rgbt
from rgbt.build.load_run import TrainedNetwork
from rgbt.build.session import Session
from rgbt.checks import InputError
from rgbt.class_scores import classes_of
from rgbt.data.batches import collate
from rgbt.data.domains import TestedHead
from rgbt.data.to_predict import of_split
from rgbt.evaluation.prediction import heads_of, view_of
from rgbt.exported.description import Description, require_packages
from rgbt.exported.graph import OPSET, ScoresOfImages, onnx_bytes, torch_bytes, traced
from rgbt.exported.onnx_network import ExportedNetwork
from rgbt.files.atomic import write_atomic
from rgbt.requirements import record_of
from rgbt.types import View

ONNX, TORCH = ".onnx", ".pt2"
"""Endings of the two formats."""

Hw = tuple[int, int]
"""Height and width, pixels."""

ScoresOf = Callable[[Tensor, Tensor], Tensor]
"""RGB (B, 3, H, W) and thermal (B, 1, H, W) in [0, 1] to class scores (B, K, H, W)."""


@dataclass(frozen=True, kw_only=True)
class ExportRequest:
    """What is exported, and how it is compared.

    Attributes:
        out: new file; its ending chooses the format.
        view: input images; None: those that the network is designed for.
        head: of a network with a head per domain; None: as the run's configuration says.
        image_hw: height and width of the images; None: those of the data set after the transform.
        split: whose images are compared.
        num_images: how many of them, the first ones.
        tolerance: largest difference of scores as a share of the largest score, and largest share
            of pixels with another class.
    """

    out: Path
    view: View | None
    head: TestedHead | None
    image_hw: Hw | None
    split: str
    num_images: int
    tolerance: float


@dataclass(frozen=True)
class Comparison:
    """An exported graph against the network in PyTorch, on the same images.

    Attributes:
        num_images: that were compared.
        difference: largest absolute difference of two scores.
        largest: largest absolute score.
        equal: share of pixels with the same class.
    """

    num_images: int
    difference: float
    largest: float
    equal: float

    def check(self, tolerance: float) -> None:
        """Raise InputError where the graph differs by more than `tolerance`."""
        share = self.difference / self.largest if self.largest else self.difference
        if not (share <= tolerance and 1 - self.equal <= tolerance):
            raise InputError(
                f"the exported graph differs from the network by {share:.3g} of the largest score, "
                f"and in the class of {1 - self.equal:.3%} of the pixels, more than "
                f"tolerance={tolerance:g}; no file was written. Choose the other format, or a "
                "higher tolerance."
            )


def export(opened: TrainedNetwork, request: ExportRequest) -> tuple[Description, Comparison]:
    """Write the exported network of `opened`, unless its graph gives other scores.

    The graph computes in float32; images are compared on the CPU in the same precision.

    Raises:
        InputError: an unknown format or existing file; a network with a head per image; a graph
            that cannot be made, or that differs from the network.
    """
    check_out(request.out)
    session = opened.session
    names = session.dataset.names(request.split)
    view = view_of(session, request.view)
    head = only_head(session, view, request.head, names)
    images = list(_images(session, request))
    network = session.model.cpu().float().eval()
    graph = ScoresOfImages(network, view=view, head=head)
    image_hw = (images[0][0].shape[-2], images[0][0].shape[-1])
    description = _description(opened, request, image_hw, view=view, head=head)
    program = traced(graph, image_hw)
    if request.out.suffix == ONNX:
        content = onnx_bytes(program, description)
        scores_of: ScoresOf = _scores_of(ExportedNetwork(content, request.out))
    else:
        content = torch_bytes(program, description)
        scores_of = program.module()
    compared = compare(graph, scores_of, images)
    compared.check(request.tolerance)
    request.out.parent.mkdir(parents=True, exist_ok=True)
    write_atomic(request.out, content)
    return description, compared


def check_out(out: Path) -> None:
    """Refuse a file that cannot be written, before a network is opened.

    Raises:
        InputError: an unknown ending, an existing file, a folder that does not take files, or the
            packages for ONNX are missing.
    """
    if out.suffix not in (ONNX, TORCH):
        raise InputError(
            f"out={out}: expected a file name that ends in {ONNX}, or in {TORCH} for the format of "
            "torch.export."
        )
    if out.exists():
        raise InputError(
            f"out={out} exists, and an export overwrites no file; choose another name."
        )
    folder = next(each for each in out.absolute().parents if each.exists())
    if not (folder.is_dir() and os.access(folder, os.W_OK | os.X_OK)):
        raise InputError(
            f"out={out}: {folder} is not a folder in which files can be written; choose another "
            "folder."
        )
    if out.suffix == ONNX:
        require_packages()


def compare(
    reference: ScoresOf, scores_of: ScoresOf, images: list[tuple[Tensor, Tensor]]
) -> Comparison:
    """Two functions on the same images: the first one alone, then two at a time.

    Args:
        reference: the network in PyTorch.
        scores_of: the exported graph.
        images: RGB (1, 3, H, W) and thermal (1, 1, H, W) each, at least one.
    """
    difference = largest = 0.0
    same = total = 0
    groups = [images[:1], *(images[at : at + 2] for at in range(1, len(images), 2))]
    with torch.inference_mode():
        for group in groups:
            rgb, thermal = (torch.cat(parts) for parts in zip(*group, strict=True))
            expected, found = reference(rgb, thermal), scores_of(rgb, thermal)
            difference = max(difference, float((expected - found).abs().max()))
            largest = max(largest, float(expected.abs().max()))
            classes = classes_of(expected)
            same += int((classes == classes_of(found)).sum())
            total += classes.numel()
    return Comparison(len(images), difference, largest, same / total)


def _scores_of(network: ExportedNetwork) -> ScoresOf:
    def scores_of(rgb: Tensor, thermal: Tensor) -> Tensor:
        logits = network(rgb, thermal).logits
        assert isinstance(logits, Tensor), "an exported network always has scores"
        return logits

    return scores_of


def only_head(
    session: Session, view: View, head: TestedHead | None, names: tuple[str, ...]
) -> str | None:
    """The name of the head that predicts the images `names`; None: the network has one for all.

    Args:
        session: its domains choose the head of an image.
        view: input images of the network.
        head: as in `ExportRequest`.
        names: of images of the data set.

    Raises:
        InputError: images have different heads.
    """
    heads = set(heads_of(session, view, head)(names))
    if len(heads) > 1:
        raise InputError(
            "the network predicts an image with the head of its domain, but an exported graph has "
            "one head; choose it with head=source or head=target."
        )
    return heads.pop() if heads else None


def _images(session: Session, request: ExportRequest) -> Iterator[tuple[Tensor, Tensor]]:
    """Images (1, C, H, W) in [0, 1] as the network gets them, all of one size."""
    found = of_split(session.dataset, request.split)
    wanted = request.image_hw
    if not found.names:
        raise InputError(f"split '{request.split}' of {session.dataset.name} has no image.")
    for name in found.names[: request.num_images]:
        batch = collate([session.transform.test(found.read(name))], "").to("cpu")
        wanted = wanted or _image_hw(session, (batch.rgb.shape[-2], batch.rgb.shape[-1]))
        rgb, thermal = (
            each
            if each.shape[-2:] == wanted
            else F.interpolate(each, size=wanted, mode="bilinear", align_corners=False)
            for each in (batch.rgb, batch.thermal)
        )
        yield rgb, thermal


def _image_hw(session: Session, whole: Hw) -> Hw:
    """Size of the images of one forward pass, of images of the size `whole`.

    Raises:
        InputError: the prediction shows the network images of several sizes.
    """
    settings = session.prediction
    window = settings.window_hw or (10**6, 10**6)
    sizes = {
        (min(window[0], round(scale * whole[0])), min(window[1], round(scale * whole[1])))
        for scale in settings.scales
    }
    if len(sizes) > 1:
        raise InputError(
            f"prediction.scales={list(settings.scales)} shows the network images of several sizes, "
            "but an exported graph takes one; set prediction.scales=[1.0]."
        )
    return sizes.pop()


def _description(
    opened: TrainedNetwork, request: ExportRequest, image_hw: Hw, *, view: View, head: str | None
) -> Description:
    session = opened.session
    # Where runs are tracked may hold a password and does not change a prediction.
    settings = {key: value for key, value in session.spec.plain.items() if key != "tracking"}
    return Description(
        version=rgbt.__version__,
        network=type(session.model).__name__,
        run=opened.label if not opened.step else opened.folder.parent.name,
        step=opened.step,
        dataset=session.dataset.name,
        fingerprint=session.dataset.fingerprint(),
        classes=tuple(session.dataset.classes),
        view=view,
        head=head,
        outputs=record_of(session.model).outputs,
        image_hw=image_hw,
        opset=OPSET if request.out.suffix == ONNX else 0,
        settings=settings,
    )
