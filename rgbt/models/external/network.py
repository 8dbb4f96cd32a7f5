"""A network of another author as a network of this project.

It is built from its author's checkout and fed as its author feeds it; its class scores are found in
what it returns.
"""

from __future__ import annotations

import importlib
import importlib.util
import sys
import traceback
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, redirect_stdout
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import torch
from annotated_types import Interval, Len
from torch import Tensor, nn
from torch.nn import functional as F

from rgbt.checks import InputError, described, one_line
from rgbt.files.adapters import adapter_of
from rgbt.models.inputs import Inputs, luma_of, only_view, padded
from rgbt.processes import rank
from rgbt.ranges import NumClasses, Size, Text
from rgbt.requirements import NetworkRecord, Requirement
from rgbt.types import MaskPair, Output, View

OWN = "network."  # before every name of the author's network in `state_dict`

Feed = Literal["stacked", "pair", "pair_and_edges", "list", "dicts", "thermal"]

# Form -> arguments of the call: of normalised images and, for one of them, of an edge map.
FEEDS: Mapping[Feed, Callable[..., tuple[Any, ...]]] = {
    "stacked": lambda rgb, thermal: (torch.cat([rgb, thermal], 1),),
    "pair": lambda rgb, thermal: (rgb, thermal),
    "pair_and_edges": lambda rgb, thermal, edges: (rgb, thermal, edges[:, 0]),
    "list": lambda rgb, thermal: ([rgb, thermal],),
    "dicts": lambda rgb, thermal: ([{"image": both} for both in torch.cat([rgb, thermal], 1)],),
    "thermal": lambda _, thermal: (thermal,),
}

Index = Annotated[int, Interval(ge=-1000, le=1000)]
# Indices, keys and attributes that lead to scores; "*" stacks what follows of every element.
ScorePath = Annotated[tuple[Index | Text, ...], Len(0, 16)]

ScorePaths = Annotated[tuple[ScorePath, ...], Len(1, 16)]

_held: set[Path] = set()  # the folder whose modules this process has imported

_python = importlib.import_module("random")
_numpy = np.random.mtrand._rand  # NumPy's global generator


class Namespace(dict[str, Any]):
    """Holds settings that can be read as attributes and as keys, as many configurations are."""

    def __init__(self, values: Mapping[str, Any]) -> None:
        nested = {k: Namespace(v) if isinstance(v, Mapping) else v for k, v in values.items()}
        super().__init__(nested)

    def __getattr__(self, key: str) -> Any:
        if key not in self:
            raise AttributeError(f"the namespace has no value '{key}'")
        return self[key]


class ExternalNetwork(nn.Module):
    """Calls a network that is built from its author's checkout, whose code is executed.

    What it draws at random comes from the generator of the step, in evaluation from a fixed seed.
    The arguments are the keys of ``conf/model/external.yaml``.
    """

    def __init__(  # noqa: PLR0913 - each is a key of conf/model/external.yaml
        self,
        *,
        num_classes: NumClasses,
        checkout: Text,
        root: Text,
        constructor: Annotated[str, Len(3, 4096)],
        arguments: dict[str, Any],
        namespaces: dict[str, dict[str, Any]],
        feed: Feed,
        inputs: Inputs,
        multiple: Annotated[int, Interval(ge=1, le=1024)],
        size_hw: Size | None,
        scores: ScorePaths,
        train_scores: ScorePaths | None,
        auxiliary: ScorePath | None,
        resize: bool,
        one_by_one: bool,
        weights_prefix: Annotated[str, Len(0, 4096)],
    ) -> None:
        super().__init__()
        reads = Requirement("loss", "reads_auxiliary", True, "model.auxiliary")
        self.record = NetworkRecord(
            views=("thermal",) if feed == "thermal" else ("rgbt",),
            auxiliary=auxiliary is not None,
            requires=(reads,) if auxiliary is not None else (),
            author_names=(OWN, weights_prefix),
        )
        self.num_classes, self.constructor = num_classes, constructor
        self.feed, self.multiple, self.size_hw = feed, multiple, size_hw
        self.scores, self.train_scores = scores, train_scores or scores
        self.auxiliary, self.resize, self.one_by_one = auxiliary, resize, one_by_one
        self.inputs = inputs
        whole = Path(checkout).expanduser().resolve()
        folder = (whole / root).resolve()
        if not folder.is_relative_to(whole):  # the user trusts `checkout`
            raise InputError(f"model.root={root} leads out of model.checkout={checkout}.")
        spaces = {key: Namespace(values) for key, values in namespaces.items()}
        self.network = build(folder, constructor, arguments | spaces)

    def forward(
        self,
        rgb: Tensor,
        thermal: Tensor,
        masks: MaskPair | None = None,
        *,
        views: tuple[View, ...] = (),
        generator: torch.Generator | None = None,
    ) -> Output:
        """Predict scores as `rgbt.models` says; in training `aux["aux_logits"]` if `auxiliary`."""
        only_view(views, self.record.views, self.constructor)
        maps = [*self.inputs(rgb, thermal, masks, multiple=self.multiple)]
        if self.feed == "pair_and_edges":
            maps.append(padded(edge_map(rgb, thermal), self.multiple))
        if self.size_hw is not None:
            maps = [_resized(image, self.size_hw) for image in maps]
        seed = 0  # two evaluations agree
        if self.training:
            assert generator is not None, "a network in training gets the generator of the step"
            drawn = torch.randint(2**31, (), generator=generator, device=generator.device)
            seed = int(drawn) ^ rank()
        calls: list[list[Tensor]] = [maps]
        if self.one_by_one:
            calls = [[image[n : n + 1] for image in maps] for n in range(len(rgb))]
        with seeded(seed, rgb.device):
            parts = [self._called(*call) for call in calls]
        found = [torch.cat(scores) for scores in zip(*parts, strict=True)]
        logits, *auxiliary = [self._at_input(scores, maps[0], rgb) for scores in found]
        return Output(logits, {"aux_logits": auxiliary[0]} if auxiliary else {})

    def _called(self, *maps: Tensor) -> list[Tensor]:
        """Return scores, and in training auxiliary ones, at the size that the network returns."""
        output = self.network(*FEEDS[self.feed](*maps))
        shape = maps[0].shape[0], self.num_classes
        name = "train_scores" if self.training else "scores"
        found = [scores_at(output, getattr(self, name), f"model.{name}", shape)]
        if self.training and self.auxiliary is not None:
            found.append(scores_at(output, (self.auxiliary,), "model.auxiliary", shape))
        return found

    def _at_input(self, scores: Tensor, called: Tensor, images: Tensor) -> Tensor:
        """Resize scores to the images, as float32."""
        scores = scores.float()
        called_hw, hw = called.shape[2:], images.shape[2:]
        if scores.shape[2:] != called_hw and not self.resize:
            raise InputError(
                f"model.scores: the network returns scores of {tuple(scores.shape[2:])} for "
                f"images of {tuple(called_hw)} pixels; set model.resize=true to enlarge them, or "
                "model.multiple if its output is rounded."
            )
        if self.size_hw is not None:
            return _resized(scores, hw)
        scores = scores if scores.shape[2:] == called_hw else _resized(scores, called_hw)
        return scores[..., : hw[0], : hw[1]]


def _resized(maps: Tensor, hw: tuple[int, ...]) -> Tensor:
    """Resize (N, C, H, W), bilinear."""
    return F.interpolate(maps, size=tuple(hw), mode="bilinear", align_corners=False)


# ---- how it is built ----------------------------------------------------------------------------


@contextmanager
def seeded(seed: int, device: torch.device) -> Iterator[None]:
    """Begin the global generators at `seed` in a context; then they are as before.

    Those of Python, NumPy, torch on the CPU and torch on `device`; `seed` from 0 to 2^32 - 1.
    """
    states = _python.getstate(), _numpy.get_state()
    try:
        with torch.random.fork_rng([device] if device.type == "cuda" else []):
            torch.random.manual_seed(seed)
            _python.seed(seed)
            _numpy.seed(seed)
            yield
    finally:
        _python.setstate(states[0])
        _numpy.set_state(states[1])


def build(folder: Path, constructor: str, arguments: Mapping[str, Any]) -> nn.Module:
    """Build the network on the CPU, with weights drawn from the global generator of torch.

    `folder` is put on the path of modules; the constructor is "module:name" of the checkout, or
    "file.py:name" of an adapter. InputError: it cannot be imported or built.
    """
    if not folder.is_dir():
        raise InputError(f"model.checkout: no such folder: {folder}")
    if _held - {folder}:
        raise InputError(
            f"model.checkout={folder}: this process has imported modules of {next(iter(_held))}, "
            "which may have the same names; use another process."
        )
    _held.add(folder)
    setting = f"model.constructor={constructor}"
    seed = int(torch.randint(2**31, (), generator=torch.default_generator, device="cpu"))
    sys.path.insert(0, str(folder))
    try:
        # Sizes of stages are read from tensors, which have none on the device "meta".
        with redirect_stdout(sys.stderr), seeded(seed, cpu := torch.device("cpu")), cpu:
            network = _function(folder, constructor)(**arguments)
    except InputError:
        raise
    except (Exception, SystemExit) as error:
        said = f"{type(error).__name__}: {one_line(error)}{author_line(error)}"
        raise InputError(f"{setting}: {said}.") from error
    finally:
        # Networks may import when they are called, but nothing of ours finds modules there first.
        sys.path.remove(str(folder))
        sys.path.append(str(folder))
    if not isinstance(network, nn.Module):
        raise InputError(f"{setting} returned {described(network)}; expected a torch.nn.Module.")
    return network


def author_line(error: BaseException) -> str:
    """Say where code of the checkout raised an error, ", /code/net.py line 3"; "": elsewhere."""
    for frame in reversed(traceback.extract_tb(error.__traceback__)):
        if any(Path(frame.filename).is_relative_to(folder) for folder in _held):
            return f", {frame.filename} line {frame.lineno}"
    return ""


def _function(folder: Path, constructor: str) -> Callable[..., Any]:
    """Import the class or function that builds the network."""
    name, _, attribute = constructor.partition(":")
    adapter = adapter_of(constructor)
    if adapter is not None:
        spec = importlib.util.spec_from_file_location(f"adapter_{adapter.stem}", adapter)
        assert spec is not None, "of a file that ends in .py"
        assert spec.loader is not None, "as above"
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
    else:
        module = importlib.import_module(name)
        file = getattr(module, "__file__", None)
        if file is None or not Path(file).resolve().is_relative_to(folder):
            raise InputError(
                f"model.constructor={constructor}: {name} is not a module of {folder}, but {file}."
            )
    return getattr(module, attribute)


# ---- how it is fed, and where its scores are ----------------------------------------------------


def edge_map(rgb: Tensor, thermal: Tensor) -> Tensor:
    """Compute edges of both images, as EGFNet writes them to files: (N, 1, H, W), whole, 0..255.

        E = (e(Y) + e(T)) mod 256, e(X) = round((|dx X| + |dy X|) / 2), slopes at most 255

    Y is the luma of RGB (N, 3, H, W) and T thermal (N, 1, H, W), in [0, 1], in whole grey levels;
    dx and dy are 3 x 3 Sobel operators. Source: ShaohuaDong2021/EGFNet, sobel.py, whose conversion
    to bytes wraps sums above 255.
    """
    grey = (255 * torch.cat([luma_of(rgb), thermal])).round()
    across = grey.new_tensor([[-1.0, 0.0, 1.0], [-2.0, 0.0, 2.0], [-1.0, 0.0, 1.0]])
    kernels = torch.stack([across, across.T])[:, None]
    slopes = F.conv2d(F.pad(grey, (1, 1, 1, 1), mode="reflect"), kernels).abs().clamp(max=255)
    of_rgb, of_thermal = slopes.mean(1, keepdim=True).round().chunk(2)
    return (of_rgb + of_thermal) % 256


def picked(output: Any, path: ScorePath) -> Any:
    """Return what a path leads to; None where it leads nowhere."""
    for number, step in enumerate(path):
        if step == "*":
            return torch.stack([picked(element, path[number + 1 :]) for element in output])
        try:
            output = output[step]
        except (TypeError, IndexError, KeyError):
            output = getattr(output, str(step), None)
    return output


def scores_at(output: Any, paths: ScorePaths, setting: str, shape: tuple[int, int]) -> Tensor:
    """Add the scores at some paths, (N, K, h, w), of the expected `shape` (N, K).

    InputError, with the key that has the paths: one leads to something else than such scores.
    """
    found = [picked(output, path) for path in paths]
    for path, value in zip(paths, found, strict=True):
        is_map = isinstance(value, Tensor) and value.dim() == 4 and value.is_floating_point()
        if not is_map or value.shape[:2] != shape:
            raise InputError(
                f"{setting}: expected scores ({shape[0]}, {shape[1]}, h, w) with model.num_classes="
                f"{shape[1]} at {list(path)}, got {described(value)}; the network returns "
                f"{one_line(structure(output))}."
            )
    return torch.stack(found).sum(0) if len(found) > 1 else found[0]


def structure(value: object) -> str:
    """Describe what a network returned: "tuple (Tensor (2, 9, 4, 6) float32, list (int 1))"."""
    if not isinstance(value, tuple | list):
        return described(value)
    return f"{type(value).__name__} ({', '.join(map(structure, value))})"
