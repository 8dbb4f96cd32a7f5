"""Export a trained network to an ONNX file, after its graph was compared with the network."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor
from torch.nn import functional as F

from rgbt.assembly.session import Session
from rgbt.checks import InputError
from rgbt.class_scores import classes_of
from rgbt.data.loaders import collate
from rgbt.data.new_images import ToPredict, of_split
from rgbt.evaluation.predict import Predictor
from rgbt.exported.onnx_network import (
    ExportedNetwork,
    GraphDescription,
    ScoresOfImages,
    onnx_bytes,
    require_packages,
)
from rgbt.files.atomic import write_atomic
from rgbt.requirements import NetworkRecord, record_of
from rgbt.terminal import progress

NO_TRACKING = "rgbt.tracking.tracker.Tracking"

# Height and width, pixels.
Hw = tuple[int, int]

# RGB (B, 3, H, W) and thermal (B, 1, H, W) in [0, 1] to class scores (B, K, H, W).
ScoresOf = Callable[[Tensor, Tensor], Tensor]


@dataclass(frozen=True)
class Agreement:
    """An exported graph against the network in PyTorch, on the same images."""

    num_images: int
    difference: float  # largest absolute difference of two scores
    largest: float  # largest absolute score
    equal: float  # share of pixels with the same class

    def check(self, tolerance: float) -> None:
        """Raise InputError where scores, relative to the largest, or classes differ by more."""
        share = self.difference / self.largest if self.largest else self.difference
        if not (share <= tolerance and 1 - self.equal <= tolerance):
            raise InputError(
                f"tolerance={tolerance:g}: the exported graph differs from the network by "
                f"{share:.3g} of the largest score, and in the class of {1 - self.equal:.3%} of "
                "the pixels; no file was written."
            )


def export(
    predictor: Predictor,
    out: Path,
    split: str,
    image_hw: Hw | Literal["dynamic"] | None = None,
    num_images: int = 20,
    tolerance: float = 1e-3,
) -> tuple[GraphDescription, Agreement, dict[Hw, int]]:
    """Write the network of `predictor` in float32, unless the graph gives other scores on the CPU.

    It is compared on images of its size, resized ones where there is none; a dynamic one on images
    of every size, and on one of them resized to `other_sizes`.

    Args:
        predictor: of the network, from its view and with its head.
        out: the new file.
        split: whose images are compared.
        image_hw: height and width of the images; None: those of most images after the transform.
        num_images: how many images are compared, the first ones.
        tolerance: see `Agreement.check`.

    Returns:
        what was written, the comparison, and the number of images of the split by their size.

    Raises:
        InputError: an existing file, a network with a head per image, or a graph that cannot be
            made or that differs from the network.
    """
    check_out(out)
    session = predictor.session
    found = of_split(session.dataset, split)
    head = only_head(predictor, found.names)
    by_size = _names_by_size(session, found)
    if not by_size:
        raise InputError(f"split '{split}' of {session.dataset.name} has no image.")
    is_dynamic = image_hw == "dynamic"
    most = max(by_size, key=lambda hw: len(by_size[hw]))
    size = image_hw if isinstance(image_hw, tuple) else most
    graph = ScoresOfImages(session.model.cpu().float().eval(), view=predictor.view, head=head)
    description = GraphDescription(
        network=type(session.model).__name__,
        run=session.run or session.label,
        step=session.step,
        dataset=session.dataset.name,
        fingerprint=session.dataset.fingerprint(),
        classes=tuple(session.dataset.classes),
        view=predictor.view,
        head=head,
        outputs=record_of(session.model, NetworkRecord).outputs,
        image_hw=size,
        dynamic=is_dynamic,
        # The address of the tracking may hold a password, and does not change a prediction.
        settings={**with_range(session), "tracking": {"_target_": NO_TRACKING}},
    )
    content = onnx_bytes(graph, description)
    network = ExportedNetwork(content, out)
    readable = [name for names in by_size.values() for name in names]
    names = by_size.get(size, readable)
    if is_dynamic:  # one of each size, then others
        firsts = [of_one_size[0] for of_one_size in by_size.values()]
        names = [*dict.fromkeys([*firsts, *readable])]
    images = [_image(session, found, name) for name in names[:num_images]]
    if is_dynamic:
        images += [_resized(images[0], hw) for hw in other_sizes(size)]
    else:
        images = [_resized(pair, size) for pair in images]
    try:
        comparison = compare(graph, lambda rgb, thermal: network(rgb, thermal).logits, images)
        comparison.check(tolerance)
    except InputError as error:
        if not is_dynamic:
            raise
        raise InputError(
            f"image_hw=dynamic: {description.network} cannot leave its size open: {error}"
        ) from error
    out.parent.mkdir(parents=True, exist_ok=True)
    write_atomic(out, content)
    return description, comparison, {hw: len(names) for hw, names in by_size.items()}


def with_range(session: Session) -> dict[str, Any]:
    """Return the settings of a session, with what `auto` of the thermal range found."""
    plain, dataset = dict(session.spec.plain), dict(session.spec.plain["dataset"])
    if session.thermal_range is not None:
        limits, unit = list(session.thermal_range), dataset["thermal_range"]
        dataset["thermal_range"] = {**unit, "range": limits} if isinstance(unit, dict) else limits
    return {**plain, "dataset": dataset}


def check_out(out: Path) -> None:
    """Raise InputError for another ending, an existing file or missing packages for ONNX."""
    if out.suffix != ".onnx":
        raise InputError(f"out={out}: expected a file name that ends in .onnx.")
    if out.exists():
        raise InputError(f"out={out} exists, and an export overwrites no file.")
    require_packages()


def compare(
    reference: ScoresOf, scores_of: ScoresOf, images: list[tuple[Tensor, Tensor]]
) -> Agreement:
    """Compare the network in PyTorch with the exported graph on the same images, at least one.

    Of each size the first image is alone, then they come two at a time: RGB (1, 3, H, W), thermal
    (1, 1, H, W).
    """
    difference = largest = 0.0
    same = total = 0
    groups = []
    for hw in dict.fromkeys(rgb.shape for rgb, _ in images):
        alike = [pair for pair in images if pair[0].shape == hw]
        groups += [alike[:1], *(alike[at : at + 2] for at in range(1, len(alike), 2))]
    with torch.inference_mode():
        for group in groups:
            rgb, thermal = (torch.cat(parts) for parts in zip(*group, strict=True))
            expected, found = reference(rgb, thermal), scores_of(rgb, thermal)
            difference = max(difference, float((expected - found).abs().max()))
            largest = max(largest, float(expected.abs().max()))
            classes = classes_of(expected)
            same += int((classes == classes_of(found)).sum())
            total += classes.numel()
    return Agreement(len(images), difference, largest, same / total)


def only_head(predictor: Predictor, names: tuple[str, ...]) -> str | None:
    """Return the one head of the images `names`, None: the only one; InputError: they differ."""
    heads = set(predictor.heads(names))
    if len(heads) > 1:
        raise InputError(
            "head: an image is predicted with the head of its domain, but an exported graph has "
            "one; choose it with head=source or head=target."
        )
    return heads.pop() if heads else None


def other_sizes(image_hw: Hw) -> tuple[Hw, ...]:
    """Return sizes to compare a dynamic graph at: lower, narrower and larger, with odd sides."""
    height, width = image_hw
    lower, narrower = height * 3 // 4 | 1, width * 2 // 3 | 1
    return (lower, width), (height, narrower), (height * 5 // 4 | 1, width * 5 // 4 | 1)


def _names_by_size(session: Session, found: ToPredict) -> dict[Hw, list[str]]:
    """Names of all images of a split by their size in one forward pass."""
    by_size: dict[Hw, list[str]] = {}
    with progress() as display:
        task = display.add_task("sizes", total=len(found.names), note="images")
        for sample in found.samples(session.loading.on_error):
            shown = session.transform.test(sample).thermal.shape
            by_size.setdefault(_image_hw(session, (shown[0], shown[1])), []).append(sample.name)
            display.advance(task)
    return by_size


def _image(session: Session, found: ToPredict, name: str) -> tuple[Tensor, Tensor]:
    """RGB and thermal (1, C, H, W) in [0, 1] as the network gets them: their first window."""
    batch = collate([session.transform.test(found.read(name))], "").to("cpu")
    height, width = _image_hw(session, (batch.rgb.shape[-2], batch.rgb.shape[-1]))
    return batch.rgb[..., :height, :width], batch.thermal[..., :height, :width]


def _resized(pair: tuple[Tensor, Tensor], hw: Hw) -> tuple[Tensor, Tensor]:
    """Both images at another size, bilinear."""
    if pair[0].shape[-2:] == hw:
        return pair
    rgb, thermal = (F.interpolate(image, size=hw, mode="bilinear") for image in pair)
    return rgb, thermal


def _image_hw(session: Session, whole: Hw) -> Hw:
    """Size of the images of one forward pass, of images of the size `whole`; InputError if many."""
    window = session.prediction.window_hw or (10**6, 10**6)
    scales = session.prediction.scales
    sizes = {
        (min(window[0], round(scale * whole[0])), min(window[1], round(scale * whole[1])))
        for scale in scales
    }
    if len(sizes) > 1:
        raise InputError(
            f"prediction.scales={list(scales)}: an exported graph takes one size; "
            "set prediction.scales=[1.0]."
        )
    return sizes.pop()
