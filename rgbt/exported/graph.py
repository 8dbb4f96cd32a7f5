"""Describe a network, trace it to one graph with fixed image size, and write it as an ONNX file."""

from __future__ import annotations

import importlib.util
import json
import logging
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from rgbt.checks import InputError, one_line
from rgbt.files.plain_files import parse_json
from rgbt.requirements import Outputs
from rgbt.types import View

PREFIX = "rgbt."
"""Of every name in the metadata of a file."""

PACKAGES = ("onnx", "onnxruntime", "onnxscript")
"""What the optional extra `export` installs."""

OPSET = 18
"""Version of the ONNX operators: the one that PyTorch's exporter is written for. grid_sample of
deformable attention requires 16."""

NOISY = ("torch.onnx", "onnxscript", "onnx_ir")
"""Loggers of packages that report each step of an export."""


@dataclass(frozen=True, kw_only=True)
class Description:
    """The metadata of an exported network.

    Attributes:
        version: of rgbt.
        network: class of the network.
        run: key of the run, or name of the file of weights.
        step: optimiser step of the weights; 0 where it is not known.
        dataset: name of the data set.
        fingerprint: of its files.
        classes: names, in the order of the scores.
        view: input images that the graph uses; the other image is an input too and is ignored.
        head: of a network with one head per domain; None: it has one for all images.
        outputs: whether the scores are of classes, or sums over masks of queries.
        image_hw: height and width of the images.
        opset: version of the ONNX operators.
        settings: configuration of the run, without tracking: how images are read and predicted.
        rgb: what the first input is.
        thermal: what the second input is.
    """

    version: str
    network: str
    run: str
    step: int
    dataset: str
    fingerprint: str
    classes: tuple[str, ...]
    view: View
    head: str | None
    outputs: Outputs
    image_hw: tuple[int, int]
    opset: int
    settings: dict[str, Any]
    rgb: str = "float32, (batch, 3, height, width), R, G, B in [0, 1]"
    thermal: str = "float32, (batch, 1, height, width), grey level in [0, 1]"

    def to_metadata(self) -> dict[str, str]:
        """Name -> text as JSON, in the form that ONNX files hold."""
        return {f"{PREFIX}{key}": json.dumps(value) for key, value in asdict(self).items()}

    @classmethod
    def from_metadata(cls, path: Path, metadata: Mapping[str, str]) -> Description:
        """The description in the metadata of the file `path`; InputError if there is none."""
        own = {k.removeprefix(PREFIX): v for k, v in metadata.items() if k.startswith(PREFIX)}
        try:
            text = json.dumps({key: json.loads(value) for key, value in own.items()})
            found: Description = parse_json(text, cls)
        except (ValueError, RecursionError) as error:
            raise InputError(
                f"{path} has no description of rgbt ({one_line(error)}); write the file with rgbt "
                "export run=... out=..."
            ) from error
        return found


def require_packages() -> None:
    """Refuse where packages of the extra are missing; InputError names them."""
    missing = [name for name in PACKAGES if importlib.util.find_spec(name) is None]
    if missing:
        raise InputError(
            f"ONNX files require the package{'s' * (len(missing) > 1)} {', '.join(missing)}; "
            "install the extra: pip install 'rgbt[export]'."
        )


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
    with torch.no_grad():
        # What networks keep per image size is made before: in the trace it would have no values.
        graph.eval()(*images)
    with torch.no_grad(), _quiet(f"{type(graph.network).__name__} cannot be traced"):
        return torch.export.export(
            graph, images, dynamic_shapes=({0: batch}, {0: batch}), strict=False
        )


def onnx_bytes(program: torch.export.ExportedProgram, description: Description) -> bytes:
    """The content of an ONNX file with the description as its metadata.

    Raises:
        InputError: the network has an operator that ONNX does not have.
    """
    with _quiet(f"{description.network} cannot be written as ONNX"):
        made = torch.onnx.export(
            program,
            (),
            dynamo=True,
            opset_version=description.opset,
            input_names=["rgb", "thermal"],
            output_names=["scores"],
            external_data=False,
            verbose=False,
        )
    assert made is not None, "dynamo=True returns the program"
    proto = made.model_proto
    body = proto.graph
    values = (*body.input, *body.output, *body.value_info, *body.initializer)
    for each in (body, *body.node, *values):
        del each.metadata_props[:]  # notes of the exporter, with paths of this machine
    for name, value in description.to_metadata().items():
        proto.metadata_props.add(key=name, value=value)
    content: bytes = proto.SerializeToString()
    return content


@contextmanager
def _quiet(what: str) -> Iterator[None]:
    """No reports of the exporter; its errors, of many kinds, become an InputError."""
    levels = {name: logging.getLogger(name).level for name in NOISY}
    for name in NOISY:
        logging.getLogger(name).setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    except Exception as error:
        raise InputError(
            f"{what} by torch.export ({one_line(error)}). Its forward must not depend on values "
            "of tensors in Python; use x.shape[0] instead of len(x)."
        ) from error
    finally:
        for name, level in levels.items():
            logging.getLogger(name).setLevel(level)
