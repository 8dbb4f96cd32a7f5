"""A network that onnxruntime computes from an ONNX file of `rgbt export`.

An ONNX file is data: a graph of named operators with their constants, and no code. It is read
within a budget, and a graph whose constants are in other files is refused.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NoReturn

import torch
from torch import Tensor, nn

import rgbt
from rgbt.checks import InputError, one_line
from rgbt.exported.description import Description, require_packages
from rgbt.exported.graph import OPSET, ScoresOfImages, onnx_bytes, traced
from rgbt.exported.seal import is_damaged
from rgbt.files.plain_files import read_bytes
from rgbt.requirements import Record, record_of
from rgbt.types import Output, View

INPUTS = {"rgb": 3, "thermal": 1}
"""Inputs of the graph, with their channels."""

AGAIN = "export the network again with rgbt export"


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
        _check_content(content, path)
        self._graph = _session(content, path)
        with _explained(path):
            metadata = self._graph.get_modelmeta().custom_metadata_map
        self.description = Description.from_metadata(path, metadata)
        _check_graph(self._graph, self.description, path)

    @classmethod
    def read(cls, path: Path) -> ExportedNetwork:
        """The network of a file.

        Raises:
            InputError: as the class; no such file.
        """
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
        made = self.description
        self._check_request(views, head)
        if tuple(rgb.shape[-2:]) != made.image_hw:
            own, got = (" x ".join(map(str, hw)) for hw in (made.image_hw, rgb.shape[-2:]))
            height, width = rgb.shape[-2:]
            self._refuse(
                f"takes images of {own} pixels, but got {got}; export the network with "
                f"image_hw={height},{width}, or change the size of the images"
            )
        images = {"rgb": rgb, "thermal": thermal}
        arrays = {name: image.float().cpu().numpy() for name, image in images.items()}
        with _explained(self._path):
            (scores,) = self._graph.run(["scores"], arrays)
        return Output(torch.from_numpy(scores).to(rgb.device), {})

    def _check_request(self, views: tuple[View, ...], head: str | None) -> None:
        made = self.description
        if views not in ((), (made.view,)):
            self._refuse(f"predicts from {made.view} alone; omit modality=, or export another view")
        if head not in (None, made.head):
            self._refuse(
                f"has the head '{made.head}', but '{head}' is requested; name its head with "
                "head=source or head=target, or export the other head"
            )

    def _refuse(self, reason: str) -> NoReturn:
        raise InputError(f"{self._path} {reason}.")


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
    graph = ScoresOfImages(network, view=view, head=None)
    program = traced(graph, image_hw)
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


def _check_content(content: bytes, path: Path) -> None:
    """Refuse a damaged graph, and constants in other files: onnxruntime would open any path."""
    import onnx
    from google.protobuf.message import DecodeError

    if is_damaged(content):
        raise InputError(f"{path} is damaged: it does not match its checksum; {AGAIN}.")
    try:
        graph = onnx.load_model_from_string(content)
    except DecodeError as error:
        raise InputError(f"{path} is damaged or is not an ONNX file; {AGAIN}.") from error
    bodies = [graph.graph, *graph.functions]
    if any(each.data_location == onnx.TensorProto.EXTERNAL for each in _constants(bodies)):
        raise InputError(f"{path} keeps constants in another file, which is not read; {AGAIN}.")


def _constants(bodies: Iterable[Any]) -> Iterator[Any]:
    """The tensors of graphs and functions, and of the graphs inside their nodes."""
    for body in bodies:
        yield from getattr(body, "initializer", ())  # a function has none
        for attribute in (each for node in body.node for each in node.attribute):
            yield from (attribute.t, *attribute.tensors)
            inner = [attribute.g] if attribute.HasField("g") else []
            yield from _constants([*inner, *attribute.graphs])


def _session(content: bytes, path: Path) -> Any:
    """The graph, ready to compute."""
    import onnxruntime

    settings = onnxruntime.SessionOptions()
    settings.intra_op_num_threads = torch.get_num_threads()
    settings.inter_op_num_threads = 1
    settings.log_severity_level = 4  # errors are raised
    with _explained(path):
        return onnxruntime.InferenceSession(
            content,
            settings,
            providers=["CPUExecutionProvider"],
            enable_fallback=0,  # it prints, and tries the same again
        )


@contextmanager
def _explained(path: Path) -> Iterator[None]:
    """Turn what onnxruntime raises into an InputError."""
    from onnxruntime.capi import onnxruntime_pybind11_state as state

    kinds = [each for each in vars(state).values() if isinstance(each, type)]
    errors = tuple(each for each in kinds if issubclass(each, Exception))
    raised: tuple[type[Exception], ...] = (*errors, UnicodeDecodeError)
    try:
        yield
    except raised as error:
        raise InputError(
            f"{path} cannot be used by onnxruntime ({one_line(error)}); {AGAIN}."
        ) from error


def _check_graph(graph: Any, description: Description, path: Path) -> None:
    """Refuse other inputs, outputs or classes than the description states."""
    shapes = {each.name: (each.type, tuple(each.shape)[1:]) for each in graph.get_inputs()}
    found = {each.name: (each.type, tuple(each.shape)[1:]) for each in graph.get_outputs()}
    kind, hw = "tensor(float)", description.image_hw
    wanted = {name: (kind, (channels, *hw)) for name, channels in INPUTS.items()}
    if shapes != wanted:
        raise InputError(f"{path} has the inputs {shapes}, expected {wanted}; {AGAIN}.")
    scores = {"scores": (kind, (len(description.classes), *hw))}
    if found != scores:
        raise InputError(
            f"{path} has the outputs {found}, but its {len(description.classes)} classes require "
            f"{scores}; {AGAIN}."
        )
