"""Feed an author's network, and find the class scores in what it returns."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Annotated, Any, Literal

import torch
from annotated_types import Interval, Len
from torch import Tensor
from torch.nn import functional as F

from rgbt.checks import InputError, described
from rgbt.models.inputs import Images
from rgbt.ranges import Text

Feed = Literal["stacked", "pair", "pair_and_edges", "list", "dicts", "thermal"]
"""How a network takes its images; see `FEEDS`."""

Index = Annotated[int, Interval(ge=-1000, le=1000)]
ScorePath = Annotated[tuple[Index | Text, ...], Len(0, 16)]
"""Indices, keys and attributes that lead to scores; "*" stacks what follows of every element."""

ScorePaths = Annotated[tuple[ScorePath, ...], Len(1, 16)]

FEEDS: Mapping[Feed, Callable[[Images, Tensor], tuple[Any, ...]]] = {
    "stacked": lambda images, _: (torch.cat(images, 1),),
    "pair": lambda images, _: (images.rgb, images.thermal),
    "pair_and_edges": lambda images, edges: (images.rgb, images.thermal, edges),
    "list": lambda images, _: ([images.rgb, images.thermal],),
    "dicts": lambda images, _: ([{"image": each} for each in torch.cat(images, 1)],),
    "thermal": lambda images, _: (images.thermal,),
}
"""Form -> arguments of the call: of normalised images and of an edge map."""


def edge_map(rgb: Tensor, thermal: Tensor) -> Tensor:
    """Edges of both images, as EGFNet writes them to files.

        E = (e(Y) + e(T)) mod 256, e(X) = round((|dx X| + |dy X|) / 2), slopes at most 255

    Y is the luma of RGB (BT.601) and T thermal, in whole grey levels; dx and dy are 3 x 3 Sobel
    operators. Source: ShaohuaDong2021/EGFNet, sobel.py, whose conversion to bytes wraps sums above
    255.

    Args:
        rgb: (N, 3, H, W) in [0, 1], as `thermal` (N, 1, H, W); not normalised.
        thermal: see there.

    Returns:
        (N, 1, H, W), whole numbers in 0..255.
    """
    luma = (rgb * rgb.new_tensor([0.299, 0.587, 0.114]).view(1, 3, 1, 1)).sum(1, keepdim=True)
    grey = (255 * torch.cat([luma, thermal])).round()
    across = grey.new_tensor([[-1.0, 0.0, 1.0], [-2.0, 0.0, 2.0], [-1.0, 0.0, 1.0]])
    kernels = torch.stack([across, across.T])[:, None]
    slopes = F.conv2d(F.pad(grey, (1, 1, 1, 1), mode="reflect"), kernels).abs().clamp(max=255)
    of_rgb, of_thermal = slopes.mean(1, keepdim=True).round().chunk(2)
    return (of_rgb + of_thermal) % 256


def picked(output: Any, path: ScorePath) -> Any:
    """What a path leads to; None where it leads nowhere."""
    for number, step in enumerate(path):
        if step == "*":
            return torch.stack([picked(each, path[number + 1 :]) for each in output])
        try:
            output = output[step]
        except (TypeError, IndexError, KeyError):
            output = getattr(output, str(step), None)
    return output


def scores_at(output: Any, paths: ScorePaths, setting: str, shape: tuple[int, int]) -> Tensor:
    """The sum of the scores at some paths, (N, K, h, w).

    Args:
        output: of the network.
        paths: of the tensors that are added.
        setting: the key that has the paths, for the message.
        shape: (N, K) that is expected.

    Raises:
        InputError: a path leads nowhere or to something else than scores of K classes.
    """
    found = [picked(output, path) for path in paths]
    for path, value in zip(paths, found, strict=True):
        is_map = isinstance(value, Tensor) and value.dim() == 4 and value.is_floating_point()
        if not is_map or value.shape[:2] != shape:
            raise InputError(
                f"{setting}: expected scores ({shape[0]}, {shape[1]}, h, w) with model.num_classes="
                f"{shape[1]} at {list(path)}, got {described(value)}; the network returns "
                f"{structure(output)}."
            )
    return torch.stack(found).sum(0) if len(found) > 1 else found[0]


def structure(value: object) -> str:
    """What a network returned, in words: "tuple (Tensor (2, 9, 4, 6) float32, list of 3)"."""
    if not isinstance(value, tuple | list):
        return described(value)
    inner = [
        f"{type(each).__name__} of {len(each)}"
        if isinstance(each, tuple | list)
        else described(each)
        for each in value[:4]
    ]
    return f"{type(value).__name__} ({', '.join([*inner, *['...'] * (len(value) > 4)])})"
