"""Keep the constructor of an author's network from downloading or reading files of weights.

Constructors load ImageNet weights from the network or from a path of the author's machine. Here
they get nothing and keep their random start; weights come from `model.weights`, which is strict.
"""

from __future__ import annotations

import socket
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor, nn

LOADERS = (
    *("torch:load", "torch.hub:load_state_dict_from_url", "safetensors.torch:load_file"),
    *("timm.models._builder:load_pretrained", "timm.models.helpers:load_pretrained"),
)
"""Functions, as module:name, that return weights or set them; they return `NoWeights` instead."""


class BlockedError(OSError):
    """A constructor that tried to reach the network."""


class NoWeights(dict[Any, Any]):
    """Weights of a file that was not read: empty, and every key gives the same again."""

    def __missing__(self, key: object) -> NoWeights:
        return NoWeights()

    def pop(self, key: object, *default: Any) -> Any:  # noqa: ARG002 - as of a dictionary
        """Nothing; no error for a key that is missing."""
        return NoWeights()

    def get(self, key: object, default: Any = None) -> Any:  # noqa: ARG002 - as of a dictionary
        """Nothing, also where a default is given."""
        return NoWeights()

    def state_dict(self) -> NoWeights:
        """Of a pickled network: nothing."""
        return self


@contextmanager
def without_weights() -> Iterator[Callable[[], None]]:
    """Within it, weights are neither downloaded nor read; afterwards all is as before.

    Yields:
        a function that replaces `LOADERS` in modules that were imported since.
    """
    replaced: dict[Any, Any] = {}
    stack = {"load_state_dict": nn.Module.load_state_dict}

    def replace() -> None:
        found = filter(None, (_function(each) for each in LOADERS))
        new = {each: _Nothing() for each in found if each not in replaced}
        replaced.update(new)
        _exchange({id(old): mine for old, mine in replaced.items()})

    nn.Module.load_state_dict = _tolerant(stack["load_state_dict"])  # type: ignore[method-assign]
    try:
        replace()
        with _without_network():
            yield replace
    finally:
        nn.Module.load_state_dict = stack["load_state_dict"]  # type: ignore[method-assign]
        _exchange({id(mine): old for old, mine in replaced.items()})


def _function(named: str) -> Any:
    """The function module:name where its module is loaded; None elsewhere or where replaced."""
    module, _, name = named.partition(":")
    found = getattr(sys.modules.get(module), name, None)
    return None if isinstance(found, _Nothing) else found


class _Nothing:
    """A function that loads nothing."""

    def __call__(self, *_arguments: Any, **_keywords: Any) -> NoWeights:
        return NoWeights()


def _exchange(by_identity: Mapping[int, Any]) -> None:
    """Replace functions in every loaded module, under whatever name it carries them."""
    for module in list(sys.modules.values()):
        names = vars(module) if hasattr(module, "__dict__") else {}
        for name, value in list(names.items()):
            if id(value) in by_identity:
                names[name] = by_identity[id(value)]


def _tolerant(load: Callable[..., Any]) -> Callable[..., Any]:
    """`load_state_dict` that changes nothing where it is given no tensors."""

    def load_state_dict(self: nn.Module, state: Mapping[str, Any], *rest: Any, **named: Any) -> Any:
        if state and all(isinstance(each, Tensor) for each in state.values()):
            return load(self, state, *rest, **named)
        return torch.nn.modules.module._IncompatibleKeys([], [])

    return load_state_dict


@contextmanager
def _without_network() -> Iterator[None]:
    """Refuse to look up addresses and to connect in this thread; a tracker may use another one."""
    mine = threading.get_ident()
    connect, lookup = socket.socket.connect, socket.getaddrinfo

    def refuse(host: object) -> None:
        if threading.get_ident() == mine:
            raise BlockedError(f"it tries to download from {host}")

    def connects(self: socket.socket, address: Any) -> None:
        refuse(address[0])
        connect(self, address)

    def looks_up(host: Any, *rest: Any, **named: Any) -> Any:
        refuse(host)
        return lookup(host, *rest, **named)

    socket.socket.connect = connects  # type: ignore[method-assign, assignment]
    socket.getaddrinfo = looks_up
    try:
        yield
    finally:
        del socket.socket.connect  # inherited
        socket.getaddrinfo = lookup
