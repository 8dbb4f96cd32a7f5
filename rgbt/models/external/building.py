"""Find the class of an author's network in a checkout and call it with plain arguments."""

from __future__ import annotations

import importlib
import inspect
import traceback
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import nn

from rgbt.checks import InputError, described, nearest, one_line
from rgbt.models.external.checkout import Checkout
from rgbt.models.external.cuda_calls import cuda_calls_to
from rgbt.models.external.draws import seeded
from rgbt.models.external.guard import without_weights
from rgbt.models.external.settings import kept_settings


class Namespace(dict[str, Any]):
    """Settings that can be read as attributes and as keys, as many configurations are."""

    def __getattr__(self, key: str) -> Any:
        if key not in self:
            raise AttributeError(f"the namespace has no value '{key}'")
        return self[key]


def namespace(values: Mapping[str, Any]) -> Namespace:
    """The mapping and all mappings in it as namespaces."""
    return Namespace(
        {
            key: namespace(each) if isinstance(each, Mapping) else each
            for key, each in values.items()
        }
    )


@dataclass(frozen=True)
class Builder:
    """What builds a network: a class or function of a checkout, and whether CUDA calls are moved.

    Attributes:
        checkout: where it is imported from.
        constructor: "module:name".
        moves_cuda: whether ``.cuda()`` leaves a tensor on the CPU.
    """

    checkout: Checkout
    constructor: str
    moves_cuda: bool

    def build(self, arguments: Mapping[str, Any]) -> nn.Module:
        """The network on the CPU, with the random weights that the generator of torch gives.

        Raises:
            InputError: it cannot be imported or built with these arguments.
        """
        seed = int(torch.randint(2**31, (), generator=torch.default_generator, device="cpu"))
        with (
            kept_settings(),
            self.checkout.imported(),
            without_weights() as replace,
            cuda_calls_to("cpu" if self.moves_cuda else None),
            seeded(seed, torch.device("cpu")),
            torch.device("cpu"),  # sizes of stages are read from tensors, which have none on "meta"
        ):
            function = self._function()
            replace()
            self._check_arguments(function, arguments)
            network = self._attempt(lambda: function(**arguments), "cannot be built")
        if not isinstance(network, nn.Module):
            raise InputError(
                f"model.constructor={self.constructor} returned {described(network)}; expected a "
                "torch.nn.Module."
            )
        if any(each.is_meta for each in (*network.parameters(), *network.buffers())):
            raise InputError(
                f"model.constructor={self.constructor} builds parameters without values (device "
                "meta); remove torch.set_default_device from the checkout."
            )
        return network

    def _function(self) -> Callable[..., Any]:
        """The class or function.

        Raises:
            InputError: its module is not in the checkout or cannot be imported, or lacks the name.
        """
        name, _, attribute = self.constructor.partition(":")
        module = None
        if self.checkout.holds(name):
            module = self._attempt(lambda: importlib.import_module(name), "cannot be imported")
        if module is None or not self.checkout.has(module):
            raise InputError(
                f"model.constructor={self.constructor}: the module {name} is not in the checkout "
                f"{self.checkout.folder}; name a module of the checkout, or the right folder with "
                "model.checkout=... and model.root=..."
            )
        found: Callable[..., Any] | None = vars(module).get(attribute)
        if found is None or not callable(found):
            own = [key for key, each in vars(module).items() if _is_defined_in(each, name)]
            raise InputError(
                f"model.constructor={self.constructor}: {module.__file__} has no class or function "
                f"'{attribute}'; {nearest(attribute, own)}."
            )
        return found

    def _check_arguments(self, function: Callable[..., Any], arguments: Mapping[str, Any]) -> None:
        try:
            signature = inspect.signature(function)
            signature.bind(**arguments)
        except TypeError as error:
            raise InputError(
                f"model.arguments: {self.constructor} takes {signature}, but got "
                f"{', '.join(arguments) or 'nothing'} ({error})."
            ) from error

    def _attempt(self, call: Callable[[], Any], what: str) -> Any:
        """The result of foreign code; any error of it in one sentence."""
        try:
            return call()
        except KeyboardInterrupt:
            raise
        except BaseException as error:  # SystemExit too, which modules of scripts raise
            place = line_of(error, self.checkout.folder)
            raise InputError(
                f"model.constructor={self.constructor} {what}: {reason(error)}{place}."
                f"{advice(error)}"
            ) from error


def reason(error: BaseException) -> str:
    """An error of foreign code in words."""
    if isinstance(error, ModuleNotFoundError) and error.name is not None:
        return f"it imports '{error.name}', which is neither installed nor in the checkout"
    text = one_line(error) or "without a message"
    return text if isinstance(error, OSError) else f"{type(error).__name__}: {text}"


def advice(error: BaseException) -> str:
    """What to do about an error of foreign code; begins with a space, or is empty."""
    if isinstance(error, ModuleNotFoundError) and "cuda" in str(error.name):
        return (
            " It is an operator compiled for CUDA: choose a machine with a GPU, and compile the "
            "operator from its sources, often in the checkout."
        )
    if isinstance(error, ModuleNotFoundError):
        return (
            " Install the package; or, where the network does not use it, name it in model.stubs, "
            "or the package of the checkout that imports it in model.empty_packages."
        )
    if "cuda" in str(error).lower() or "nvidia" in str(error).lower():
        return (
            " It requires CUDA: choose a machine with a GPU, or set model.moves_cuda=true if it "
            "only calls .cuda()."
        )
    return ""


def line_of(error: BaseException, folder: Path) -> str:
    """The innermost line of the checkout that an error passed: " (models/x.py, line 3)"."""
    frames = reversed(traceback.extract_tb(error.__traceback__))
    inside = (frame for frame in frames if Path(frame.filename).is_relative_to(folder))
    frame = next(inside, None)
    if frame is None:
        return ""
    return f" ({Path(frame.filename).relative_to(folder)}, line {frame.lineno})"


def _is_defined_in(value: object, module: str) -> bool:
    return callable(value) and getattr(value, "__module__", None) == module
