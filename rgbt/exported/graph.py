"""Trace a network to one graph with fixed image size, and write the graph as bytes."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor, nn

from rgbt.checks import InputError, one_line
from rgbt.exported.description import Description
from rgbt.exported.seal import sealed
from rgbt.types import View

OPSET = 18
"""Version of the ONNX operators: the one that PyTorch's exporter is written for. grid_sample of
deformable attention requires 16."""

NAMES = ("rgb", "thermal")
SCORES = "scores"
"""Inputs and output of the graph."""

NOISY = ("torch.onnx", "onnxscript", "onnx_ir")
"""Loggers of packages that report each step of an export."""


class ScoresOfImages(nn.Module):
    """RGB (B, 3, H, W) and thermal (B, 1, H, W) in [0, 1] to class scores (B, K, H, W).

    Args:
        network: in evaluation mode; its `Inputs` normalise the images.
        view: input images of the prediction.
        head: of a network with one head per domain.
    """

    def __init__(self, network: nn.Module, *, view: View, head: str | None) -> None:
        super().__init__()
        self.network = network
        self._options: dict[str, Any] = {"views": (view,)} | ({"head": head} if head else {})

    def forward(self, rgb: Tensor, thermal: Tensor) -> Tensor:
        """(B, K, H, W) scores at the size of the images."""
        scores: Tensor = self.network(rgb, thermal, **self._options).logits
        return scores


def traced(graph: ScoresOfImages, image_hw: tuple[int, int]) -> torch.export.ExportedProgram:
    """The graph of a network for images of one size; the size of the batch stays open.

    Raises:
        InputError: the network depends on values of the images or of the batch in Python.
    """
    # Two images: PyTorch would take a batch of one for a constant.
    images = tuple(torch.full((2, channels, *image_hw), 0.5) for channels in (3, 1))
    batch = torch.export.Dim("batch", min=1)
    with torch.no_grad(), _quiet():
        # What networks keep per image size is made before: in the trace it would have no values.
        graph(*images)
        try:
            return torch.export.export(
                graph.eval(), images, dynamic_shapes=({0: batch}, {0: batch}), strict=False
            )
        except Exception as error:  # the tracer raises errors of many kinds
            raise InputError(
                f"{type(graph.network).__name__} cannot be traced by torch.export "
                f"({one_line(error)}). Its forward must not depend on values of tensors in Python; "
                "use x.shape[0] instead of len(x)."
            ) from error


def onnx_bytes(program: torch.export.ExportedProgram, description: Description) -> bytes:
    """The content of an ONNX file with the description as its metadata, and a checksum.

    Raises:
        InputError: the network has an operator that ONNX does not have.
    """
    with _quiet():
        try:
            made = torch.onnx.export(
                program,
                (),
                dynamo=True,
                opset_version=description.opset,
                input_names=list(NAMES),
                output_names=[SCORES],
                external_data=False,
                verbose=False,
            )
        except Exception as error:  # the exporter raises errors of many kinds
            raise InputError(
                f"{description.network} cannot be written as ONNX ({one_line(error)})."
            ) from error
    assert made is not None, "dynamo=True returns the program"
    proto = made.model_proto
    body = proto.graph
    values = (*body.input, *body.output, *body.value_info, *body.initializer)
    for each in (body, *body.node, *values):
        del each.metadata_props[:]  # notes of the exporter, with paths of this machine
    for name, value in description.to_metadata().items():
        proto.metadata_props.add(key=name, value=value)
    return sealed(proto.SerializeToString())


@contextmanager
def _quiet() -> Iterator[None]:
    """No reports of the exporter, which a user cannot act on."""
    levels = {name: logging.getLogger(name).level for name in NOISY}
    for name in NOISY:
        logging.getLogger(name).setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        for name, level in levels.items():
            logging.getLogger(name).setLevel(level)
