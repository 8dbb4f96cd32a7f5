"""A network as one ONNX graph: traced, written, and computed by onnxruntime.

An ONNX file is data: a graph of named operators with their constants, and no code. A graph whose
constants are in other files is refused.
"""

from __future__ import annotations

import importlib.util
import json
import logging
import os
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

import rgbt
from rgbt.checks import InputError, one_line
from rgbt.files.plain_files import disguise, parse_json, read_bytes
from rgbt.requirements import NetworkRecord, Outputs, record_of
from rgbt.types import Output, View

# Prefix of every name in the metadata of a file.
PREFIX = "rgbt."

# The packages that the optional extra `export` installs.
PACKAGES = ("onnx", "onnxruntime", "onnxscript")

# Version of the ONNX operators: the one that PyTorch's exporter is written for. grid_sample of
# deformable attention requires 16.
OPSET = 18

# Inputs of the graph, with their channels.
INPUTS = {"rgb": 3, "thermal": 1}


@dataclass(frozen=True, kw_only=True)
class GraphDescription:
    """The metadata of an exported network.

    Attributes:
        network: its class.
        run: key of the run, or name of the file of weights.
        step: optimiser step of the weights; 0 where it is not known.
        fingerprint: of the files of the data set.
        classes: names, in the order of the scores.
        view: input images that the graph uses; the other image is an input too and is ignored.
        head: of a network with one head per domain; None: it has one for all images.
        outputs: whether the scores are of classes, or sums over masks of queries.
        image_hw: size of its images, or of most where it is `dynamic`.
        dynamic: whether it takes images of any size.
        settings: configuration of the run, without tracking: how images are read and predicted.
    """

    version: str = rgbt.__version__
    network: str
    run: str = ""
    step: int = 0
    dataset: str = ""
    fingerprint: str = ""
    classes: tuple[str, ...]
    view: View
    head: str | None = None
    outputs: Outputs
    image_hw: tuple[int, int]
    dynamic: bool = False
    settings: dict[str, Any]
    rgb: str = "float32, (batch, 3, height, width), R, G, B in [0, 1]"
    thermal: str = "float32, (batch, 1, height, width), grey level in [0, 1]"

    @classmethod
    def from_metadata(cls, path: Path, metadata: Mapping[str, str]) -> GraphDescription:
        """Read the description in the metadata of the file `path`; InputError if there is none."""
        own = {k.removeprefix(PREFIX): v for k, v in metadata.items() if k.startswith(PREFIX)}
        try:
            text = json.dumps({key: json.loads(value) for key, value in own.items()})
            found: GraphDescription = parse_json(text, cls)
        except (ValueError, RecursionError) as error:
            raise InputError(
                f"{path} has no description of rgbt ({one_line(error)}); write the file with rgbt "
                "export run=... out=..."
            ) from error
        return found


class ScoresOfImages(nn.Module):
    """RGB (B, 3, H, W) and thermal (B, 1, H, W) in [0, 1] to class scores (B, K, H, W)."""

    def __init__(self, network: nn.Module, *, view: View, head: str | None) -> None:
        super().__init__()
        self.network = network
        self._options: dict[str, Any] = {"views": (view,)} | ({"head": head} if head else {})

    def forward(self, rgb: Tensor, thermal: Tensor) -> Tensor:
        """Compute (B, K, H, W) scores at the size of the images."""
        scores: Tensor = self.network(rgb, thermal, **self._options).logits
        return scores


class ExportedNetwork(nn.Module):
    """An ONNX graph as a network that predicts; it has no parameters and cannot be trained.

    onnxruntime computes on the CPU, with as many threads as PyTorch has.

    Raises:
        InputError: the packages of the extra are missing, or the file is damaged, of another
            program, or of other inputs or classes than its `description` states.
    """

    def __init__(self, content: bytes, path: Path) -> None:
        super().__init__()
        require_packages()
        import onnxruntime

        self._path = path
        settings = onnxruntime.SessionOptions()
        settings.intra_op_num_threads = torch.get_num_threads()
        settings.inter_op_num_threads = 1
        settings.log_severity_level = 4  # errors are raised
        # The fallback would print, and try the same again.
        cpu = {"providers": ["CPUExecutionProvider"], "enable_fallback": 0}
        with _explained(f"{path} cannot be used by onnxruntime", "Export the network again."):
            _check_constants(content)
            self._graph = onnxruntime.InferenceSession(content, settings, **cpu)
            metadata = self._graph.get_modelmeta().custom_metadata_map
        self.description = made = GraphDescription.from_metadata(path, metadata)
        kind, hw = "tensor(float)", ("open", "open") if made.dynamic else made.image_hw
        wanted = {name: (kind, (channels, *hw)) for name, channels in INPUTS.items()}
        wanted["scores"] = (kind, (len(made.classes), *hw))
        values = (*self._graph.get_inputs(), *self._graph.get_outputs())
        found = {}
        for entry in values:
            sizes = ("open" if isinstance(size, str) else size for size in entry.shape[1:])
            found[entry.name] = entry.type, tuple(sizes)
        if found != wanted:
            raise InputError(f"{path} has the inputs and outputs {found}, but states {wanted}.")

    @classmethod
    def read(cls, path: Path) -> ExportedNetwork:
        """Read the network of a file; InputError as of the class, or if there is none."""
        if not path.is_file():
            raise InputError(f"exported={path}: there is no such file.")
        if said := disguise(path):
            raise InputError(f"exported={path}: {said}.")
        return cls(read_bytes(path), path)

    @property
    def record(self) -> NetworkRecord:
        """Return the one view, and the one head, that the graph was made for."""
        made = self.description
        heads = (made.head,) if made.head else ()
        return NetworkRecord(outputs=made.outputs, views=(made.view,), heads=heads)

    def forward(
        self, rgb: Tensor, thermal: Tensor, *, views: tuple[View, ...] = (), head: str | None = None
    ) -> Output:
        """Compute class scores, for arguments as `rgbt.models` says.

        InputError: images of another size, or another view or head than those of the file.
        """
        made = self.description
        if views not in ((), (made.view,)):
            raise InputError(f"modality: {self._path} predicts from {made.view} alone.")
        if head not in (None, made.head):
            raise InputError(f"head={head}: {self._path} has the head '{made.head}'.")
        found = rgb.shape[-2], rgb.shape[-1]
        if not made.dynamic and found != made.image_hw:
            (height, width), wanted = found, "x".join(map(str, made.image_hw))
            raise InputError(
                f"{self._path} takes images of {wanted}, got {height}x{width}; export the network "
                f"with image_hw=dynamic or image_hw={height},{width}."
            )
        images = {"rgb": rgb.float().cpu().numpy(), "thermal": thermal.float().cpu().numpy()}
        with _explained(f"{self._path} cannot be computed"):
            (scores,) = self._graph.run(["scores"], images)
        return Output(torch.from_numpy(scores).to(rgb.device), {})


def require_packages() -> None:
    """Call before onnxruntime is imported; InputError names missing packages of the extra."""
    # Without this, importing it stores an identifier in the home folder and sends usage data.
    os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")
    missing = [name for name in PACKAGES if importlib.util.find_spec(name) is None]
    if missing:
        what = ", ".join(missing)
        raise InputError(f"ONNX files require {what}; install them: pip install 'rgbt[export]'.")


def onnx_bytes(graph: ScoresOfImages, made: GraphDescription) -> bytes:
    """Make the content of an ONNX file; the size of the batch stays open, with `dynamic` all.

    Whether the graph is right at other sizes than that of `made` has to be compared: what a network
    makes of its size in Python is as for that one.

    Raises:
        InputError: the network depends on values of the images or of the batch in Python, or has
            an operator that ONNX does not have.
    """
    # Two images: PyTorch would take a batch of one for a constant.
    images = tuple(torch.full((2, channels, *made.image_hw), 0.5) for channels in INPUTS.values())
    batch, side = torch.export.Dim("batch", min=1), torch.export.Dim.DYNAMIC
    sizes = {0: batch, 2: side, 3: side} if made.dynamic else {0: batch}
    advice = "Its forward must not depend on values in Python; use x.shape[0] instead of len(x)."
    with torch.no_grad():
        # What networks keep per image size is made before: in the trace it would have no values.
        graph.eval()(*images)
        if made.dynamic:
            advice = "Omit image_hw=dynamic: this network cannot leave its size open."
        with _explained(f"{made.network} cannot be exported", advice):
            # Sizes that a network compares, such as those of two padded maps, need no proof.
            program = torch.export.export(
                graph,
                images,
                dynamic_shapes=(sizes, sizes),
                strict=False,
                prefer_deferred_runtime_asserts_over_guards=made.dynamic,
            )
            written = torch.onnx.export(
                program,
                (),
                dynamo=True,
                opset_version=OPSET,
                input_names=[*INPUTS],
                output_names=["scores"],
                external_data=False,
                verbose=False,
            )
    assert written is not None, "dynamo=True returns the program"
    proto = written.model_proto
    body = proto.graph
    noted = (body, *body.node, *body.input, *body.output, *body.value_info, *body.initializer)
    for part in noted:
        del part.metadata_props[:]  # notes of the exporter, with paths of this machine
    for name, value in asdict(made).items():
        proto.metadata_props.add(key=f"{PREFIX}{name}", value=json.dumps(value))
    content: bytes = proto.SerializeToString()
    return content


def exported_network(
    network: nn.Module, view: View, image_hw: tuple[int, int], name: str
) -> ExportedNetwork:
    """Put a network in evaluation mode on the CPU into onnxruntime; nothing is written.

    InputError: it cannot be exported; `name` is for messages.
    """
    graph = ScoresOfImages(network, view=view, head=None)
    with torch.no_grad():
        scores = graph(*(torch.zeros(1, channels, *image_hw) for channels in INPUTS.values()))
    made = GraphDescription(
        network=type(network).__name__,
        classes=tuple(map(str, range(scores.shape[1]))),
        view=view,
        outputs=record_of(network, NetworkRecord).outputs,
        image_hw=image_hw,
        settings={},
    )
    return ExportedNetwork(onnx_bytes(graph, made), Path(name))


def _check_constants(content: bytes) -> None:
    """Refuse constants in other files, wherever they are: onnxruntime would open any path."""
    import onnx

    def tensors(message: Any) -> Iterator[Any]:
        yield from [message] if isinstance(message, onnx.TensorProto) else []
        for field, value in message.ListFields():
            if field.message_type is not None:
                for inner in [value] if hasattr(value, "ListFields") else value:
                    yield from tensors(inner)

    model = onnx.load_model_from_string(content)
    if any(found.data_location == onnx.TensorProto.EXTERNAL for found in tensors(model)):
        raise ValueError("it keeps constants in another file, which is not read")


@contextmanager
def _explained(what: str, advice: str = "") -> Iterator[None]:
    """Turn what the packages raise, errors of many kinds, into an InputError; no reports."""
    logging.disable(logging.WARNING)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    except Exception as error:
        raise InputError(f"{what} ({one_line(error)}). {advice}".rstrip()) from error
    finally:
        logging.disable(logging.NOTSET)
