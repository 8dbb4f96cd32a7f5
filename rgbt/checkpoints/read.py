"""Read names and tensors from files of weights in all supported formats."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from torch import Tensor

from rgbt.checkpoints.torch_files import in_words, is_plain, read_torch_file
from rgbt.checks import InputError, one_line

WRAPPERS = ("state_dict", "model", "module", "model_state_dict")
"""Keys under which releases put their weights."""

PREFIXES = ("module.", "_orig_mod.")
"""Prefixes that DataParallel and torch.compile add to every name."""

NOTE = "rgbt"
"""Key of the note in an export, and of the run that a checkpoint belongs to."""

LAST = {"model", "others", "optimizers", "state"}
OURS = (LAST, LAST | {"unaveraged"}, {"model", "step"})
"""Other keys of the last checkpoint of a run, of one with averaged weights, and of the best."""


@dataclass(frozen=True)
class Contents:
    """A file of weights.

    Attributes:
        path: of the file.
        tensors: by name, views of the file where possible; prefixes of wrappers are taken off.
        settings: values of configuration objects in the file, by dotted key.
        ours: written by this project, with the names of its network.
        note: the note of an export.
    """

    path: Path
    tensors: Mapping[str, Tensor]
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
        contents = _read_safetensors(path)
    else:
        contents = _unwrapped(path, read_torch_file(path, mapped=True))
    for name, tensor in contents.tensors.items():
        if not is_plain(tensor):
            raise InputError(
                f"{path}: '{one_line(name)}' is {in_words(tensor)}, which is not read."
            )
    return contents


def _read_safetensors(path: Path) -> Contents:
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(path, framework="pt") as file:
            metadata = dict(file.metadata() or {})
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except (SafetensorError, OSError, ValueError, RuntimeError) as error:
        raise InputError(f"{path} cannot be read as weights ({one_line(error)}).") from error
    start = f"{NOTE}."
    note = {k.removeprefix(start): v for k, v in metadata.items() if k.startswith(start)}
    return Contents(path, _without_prefixes(tensors), ours=bool(note), note=note)


def _unwrapped(path: Path, value: Any) -> Contents:
    """The tensors of a file, which are at the top level or under one known key."""
    if not isinstance(value, dict):
        raise InputError(f"{path} holds a {type(value).__name__}; give a saved state_dict().")
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
    state = value[inner[0]] if inner else value
    note = value.get(NOTE) if inner else None
    texts = note.items() if isinstance(note, dict) else ()
    return Contents(
        path,
        _without_prefixes({name: each for name, each in state.items() if isinstance(each, Tensor)}),
        settings=dict(_settings(value)) if inner else {},
        ours=value.keys() - {NOTE} in OURS,
        note={key: text for key, text in texts if type(key) is str and type(text) is str},
    )


def _is_state(value: object) -> bool:
    """Whether a dictionary is tensors by name."""
    return (
        isinstance(value, dict)
        and any(isinstance(each, Tensor) for each in value.values())
        and all(type(key) is str for key in value)
    )


def _without_prefixes(tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    while found := next((p for p in PREFIXES if all(n.startswith(p) for n in tensors)), None):
        if not tensors or found in tensors:
            break
        tensors = {name.removeprefix(found): tensor for name, tensor in tensors.items()}
    return tensors


def _settings(value: dict[Any, Any]) -> Iterator[tuple[str, Any]]:
    """Dotted key and value of plain values in the configuration of a file, few levels deep."""
    yield from ((key, value[key]) for key in ("step", "epoch") if isinstance(value.get(key), int))
    seen: set[int] = set()  # one object in many places is read once, or reading might never end
    level = [("", value.get(key)) for key in ("hyper_parameters", "args", "config", "state")]
    for _ in range(5):
        children = []
        for path, node in level:
            if isinstance(node, dict) and id(node) not in seen:
                seen.add(id(node))
                items = {**node, **vars(node)} if isinstance(node, OrderedDict) else node
                children += [(f"{path}.{key}".lstrip("."), items[key]) for key in items]
        yield from ((key, child) for key, child in children if isinstance(child, str | int | float))
        level = children
