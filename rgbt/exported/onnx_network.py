"""A network that onnxruntime computes from an ONNX file of `rgbt export`.

An ONNX file is data: a graph of named operators with their constants, and no code. A graph whose
constants are in other files is refused.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

import rgbt
from rgbt.checks import InputError, one_line
from rgbt.exported.graph import (
    OPSET,
    Description,
    ScoresOfImages,
    onnx_bytes,
    require_packages,
    traced,
)
from rgbt.files.plain_files import read_bytes
from rgbt.requirements import Record, record_of
from rgbt.types import Output, View

INPUTS = {"rgb": 3, "thermal": 1}
"""Inputs of the graph, with their channels."""


class ExportedNetwork(nn.Module):
    """An ONNX graph as a network that predicts; it has no parameters and cannot be trained.

    onnxruntime computes on the CPU, with as many threads as PyTorch has.

    Attributes:
        description: the metadata of the file.

    Raises:
        InputError: the packages of the extra are missing, or the file is damaged, of another
            program, or of other inputs or classes than it states.
    """

    def __init__(self, content: bytes, path: Path) -> None:
        super().__init__()
        require_packages()
        self._path = path
        with _explained(path):
            _check_constants(content)
            self._graph = _session(content)
            metadata = self._graph.get_modelmeta().custom_metadata_map
        self.description = made = Description.from_metadata(path, metadata)
        kind, hw = "tensor(float)", made.image_hw
        wanted = {name: (kind, (channels, *hw)) for name, channels in INPUTS.items()}
        wanted["scores"] = (kind, (len(made.classes), *hw))
        values = (*self._graph.get_inputs(), *self._graph.get_outputs())
        found = {each.name: (each.type, tuple(each.shape)[1:]) for each in values}
        if found != wanted:
            raise InputError(f"{path} has the inputs and outputs {found}, but states {wanted}.")

    @classmethod
    def read(cls, path: Path) -> ExportedNetwork:
        """The network of a file; InputError as of the class, or if there is none."""
        if not path.is_file():
            raise InputError(f"exported={path}: there is no such file.")
        return cls(read_bytes(path), path)

    @property
    def record(self) -> Record:
        """The one view, and the one head, that the graph was made for."""
        made = self.description
        heads = (made.head,) if made.head else ()
        return Record(outputs=made.outputs, views=(made.view,), heads=heads)

    def forward(
        self, rgb: Tensor, thermal: Tensor, *, views: tuple[View, ...] = (), head: str | None = None
    ) -> Output:
        """Class scores; arguments as `rgbt.models` says.

        Raises:
            InputError: images of another size, or another view or head than those of the file.
        """
        made, got = self.description, tuple(rgb.shape[-2:])
        if views not in ((), (made.view,)):
            raise InputError(f"modality: {self._path} predicts from {made.view} alone.")
        if head not in (None, made.head):
            raise InputError(f"head={head}: {self._path} has the head '{made.head}'.")
        if got != made.image_hw:
            own, other = (" x ".join(map(str, hw)) for hw in (made.image_hw, got))
            raise InputError(
                f"{self._path} takes images of {own} pixels, but got {other}; export the network "
                f"with image_hw={got[0]},{got[1]}, or change the size of the images."
            )
        images = {"rgb": rgb, "thermal": thermal}
        arrays = {name: image.float().cpu().numpy() for name, image in images.items()}
        with _explained(self._path):
            (scores,) = self._graph.run(["scores"], arrays)
        return Output(torch.from_numpy(scores).to(rgb.device), {})


def exported_network(
    network: nn.Module, view: View, image_hw: tuple[int, int], name: str
) -> ExportedNetwork:
    """A network that is not of a run, in onnxruntime; nothing is written.

    Args:
        network: in evaluation mode, on the CPU.
        view: input images of the prediction.
        image_hw: height and width of the images.
        name: for messages.

    Raises:
        InputError: it cannot be exported.
    """
    program = traced(ScoresOfImages(network, view=view, head=None), image_hw)
    num_classes = program.graph.output_node().args[0][0].meta["val"].shape[1]
    made = Description(
        version=rgbt.__version__,
        network=type(network).__name__,
        run="",
        step=0,
        dataset="",
        fingerprint="",
        classes=tuple(map(str, range(num_classes))),
        view=view,
        head=None,
        outputs=record_of(network).outputs,
        image_hw=image_hw,
        opset=OPSET,
        settings={},
    )
    return ExportedNetwork(onnx_bytes(program, made), Path(name))


def _check_constants(content: bytes) -> None:
    """Refuse constants in other files: onnxruntime would open any path."""
    import onnx

    graph = onnx.load_model_from_string(content)
    bodies = [graph.graph, *graph.functions]
    if any(each.data_location == onnx.TensorProto.EXTERNAL for each in _constants(bodies)):
        raise ValueError("it keeps constants in another file, which is not read")


def _constants(bodies: Iterable[Any]) -> Iterator[Any]:
    """The tensors of graphs and functions, and of the graphs inside their nodes."""
    for body in bodies:
        yield from getattr(body, "initializer", ())  # a function has none
        for attribute in (each for node in body.node for each in node.attribute):
            yield from (attribute.t, *attribute.tensors)
            inner = [attribute.g] if attribute.HasField("g") else []
            yield from _constants([*inner, *attribute.graphs])


def _session(content: bytes) -> Any:
    """The graph, ready to compute."""
    import onnxruntime

    settings = onnxruntime.SessionOptions()
    settings.intra_op_num_threads = torch.get_num_threads()
    settings.inter_op_num_threads = 1
    settings.log_severity_level = 4  # errors are raised
    return onnxruntime.InferenceSession(
        content,
        settings,
        providers=["CPUExecutionProvider"],
        enable_fallback=0,  # it prints, and tries the same again
    )


@contextmanager
def _explained(path: Path) -> Iterator[None]:
    """Turn what onnx and onnxruntime raise, errors of many kinds, into an InputError."""
    try:
        yield
    except Exception as error:
        raise InputError(
            f"{path} cannot be used by onnxruntime ({one_line(error)}); export the network again "
            "with rgbt export."
        ) from error
