"""Read names and tensors from files of weights in all supported formats."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from torch import Tensor

from rgbt.checkpoints.torch_files import read_torch_file
from rgbt.checks import InputError, one_line

WRAPPERS = ("state_dict", "model", "module", "model_state_dict")
"""Keys under which releases put their weights."""

PREFIXES = ("module.", "_orig_mod.")
"""Prefixes that DataParallel and torch.compile add to every name."""

OURS = (
    *({"model", "others", "optimizers", "state"}, {"model", "optimizers", "state"}),
    {"model", "unaveraged", "others", "optimizers", "state"},
    {"model", "step"},
)
"""Keys of the last checkpoint of a run, now and before there were other networks beside the model;
of one with averaged weights; and of the best one."""

NOTE = "rgbt"
"""Key of the note in an export."""

PLAIN = (str, int, float, bool)


@dataclass(frozen=True)
class Contents:
    """A file of weights.

    Attributes:
        path: of the file.
        container: format, in words.
        tensors: by name, views of the file where possible; prefixes of wrappers are taken off.
        where: key that the tensors were found under; "" where they are all there is.
        prefix: that was taken off every name.
        others: names of other entries of the file.
        settings: values of configuration objects in the file, by dotted key.
        ours: written by this project, with the names of its network.
        note: the note of an export.
    """

    path: Path
    container: str
    tensors: Mapping[str, Tensor]
    where: str = ""
    prefix: str = ""
    others: tuple[str, ...] = ()
    settings: Mapping[str, Any] = field(default_factory=dict)
    ours: bool = False
    note: Mapping[str, str] = field(default_factory=dict)


def read(path: Path) -> Contents:
    """Names and tensors of a file, without executing anything in it.

    Args:
        path: of torch.save or of safetensors.

    Raises:
        InputError: missing, damaged, of another kind, or it would execute code.
    """
    if path.is_file() and path.open("rb").read(9)[8:] == b"{":  # behind the length of its header
        return _read_safetensors(path)
    return _unwrapped(path, read_torch_file(path, mapped=True), "torch.save")


def _read_safetensors(path: Path) -> Contents:
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(path, framework="pt") as file:
            note = dict(file.metadata() or {})
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except (SafetensorError, OSError) as error:
        raise InputError(f"{path} cannot be read: {one_line(error)}.") from error
    own = {key.removeprefix(f"{NOTE}."): note[key] for key in note if key.startswith(f"{NOTE}.")}
    return _without_prefixes(
        Contents(path, "safetensors", tensors, ours=bool(own), note=own), tensors
    )


def _unwrapped(path: Path, value: Any, container: str) -> Contents:
    """The tensors of a file, which are at the top level or under one known key."""
    if not isinstance(value, dict):
        kind = "one tensor" if isinstance(value, Tensor) else f"a {type(value).__name__}"
        raise InputError(
            f"{path} holds {kind}, not tensors by name; give a file that holds a state_dict()."
        )
    inner = [key for key in WRAPPERS if _is_state(value.get(key))]
    if not inner and not _is_state(value):  # a key of the author's own
        inner = [key for key in value if type(key) is str and _is_state(value[key])]
    if len(inner) > 1:
        raise InputError(
            f"{path} holds weights under {' and '.join(inner)}; keep one of them in the file."
        )
    if not inner and not _is_state(value):
        keys = ", ".join(one_line(key) for key in list(value)[:6])
        raise InputError(f"{path} holds no tensors by name; its keys are: {keys or 'none'}.")
    where = inner[0] if inner else ""
    state = value[where] if inner else value
    tensors = {name: found for name, found in state.items() if isinstance(found, Tensor)}
    outside = [key for key in value if key != where] if inner else []
    inside = [key for key in state if key not in tensors]
    # Texts by name; other values in the file are ignored.
    own = value.get(NOTE) if inner else None
    items = own.items() if isinstance(own, dict) else ()
    contents = Contents(
        path,
        container,
        tensors,
        where=where,
        others=tuple(one_line(key) for key in [*outside, *inside]),
        settings=_settings(value) if inner else {},
        ours=value.keys() in OURS,
        note={key: text for key, text in items if type(key) is str and type(text) is str},
    )
    return _without_prefixes(contents, tensors)


def _is_state(value: object) -> bool:
    """Whether a dictionary is tensors by name."""
    return (
        isinstance(value, dict)
        and any(isinstance(each, Tensor) for each in value.values())
        and all(type(key) is str for key in value)
    )


def _without_prefixes(contents: Contents, tensors: dict[str, Tensor]) -> Contents:
    prefix = ""
    while found := next((p for p in PREFIXES if all(n.startswith(p) for n in tensors)), None):
        tensors = {name.removeprefix(found): tensor for name, tensor in tensors.items()}
        prefix += found
        if not all(tensors):
            raise InputError(f"{contents.path} has empty names of tensors.")
    return replace(contents, tensors=tensors, prefix=prefix)


def _settings(value: dict[Any, Any]) -> dict[str, Any]:
    """Plain values in the configuration objects of a file, by dotted key, few levels deep."""
    found = {key: value[key] for key in ("step", "epoch") if isinstance(value.get(key), int)}
    seen: set[int] = set()  # one object in many places is read once, or reading might never end
    level = [("", value.get(key)) for key in ("hyper_parameters", "args", "config", "state")]
    for _ in range(5):
        children = []
        for path, node in level:
            if isinstance(node, dict) and id(node) not in seen:
                seen.add(id(node))
                items = {**node, **vars(node)} if isinstance(node, OrderedDict) else node
                children += [(f"{path}.{key}".lstrip("."), items[key]) for key in items]
        found |= {where: child for where, child in children if isinstance(child, PLAIN)}
        level = children
    return found
