"""Files of weights as names and tensors, whatever container they come in."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from torch import Tensor

from rgbt.checks import InputError
from rgbt.weights.records import Array, DamagedError, Inert, RefusedError, Strided, printable
from rgbt.weights.torch_files import mapped, read_pickles, read_zip

WRAPPERS = ("state_dict", "model", "module")
"""Keys under which releases put their weights."""

PREFIXES = ("module.", "_orig_mod.")
"""What DataParallel and torch.compile put before every name."""

OURS = (
    *({"model", "others", "optimizers", "state"}, {"model", "optimizers", "state"}),
    {"model", "step"},
)
"""Keys of the last checkpoint of a run, now and before there were other networks beside the model,
and of the best one."""

NOTE = "rgbt"
"""Key of what an export says about itself."""

PLAIN = (str, int, float, bool)

DAMAGE = (
    DamagedError,
    LookupError,
    TypeError,
    ValueError,
    ArithmeticError,
    RuntimeError,
    MemoryError,
)
"""What overwritten or invented bytes lead to, wherever they are made sense of."""


@dataclass(frozen=True)
class Contents:
    """A file of weights.

    Attributes:
        path: of the file.
        container: format, in words.
        tensors: by name, views of the file where possible; prefixes of wrappers are taken off.
        where: key that the tensors were found under; "" where they are all there is.
        prefix: that was taken off every name.
        others: names of what else lies beside the tensors.
        settings: values of configuration objects in the file, by dotted key.
        ours: written by this project, with the names of its network.
        note: what an export says about itself.
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
        path: torch.save (zip, or before 1.6), a pickle of arrays or tensors, or safetensors.

    Raises:
        InputError: missing, empty, cut short, of another kind, or asking for code.
    """
    beginning = _beginning(path)
    try:
        if _is_safetensors(beginning):
            return _read_safetensors(path)
        if beginning.startswith(b"PK\x03\x04"):
            return _unwrapped(path, read_zip(path), "torch.save")
        _refuse_others(beginning)
        value, container = read_pickles(mapped(path))
        return _unwrapped(path, value, container)
    except RefusedError as refusal:
        raise InputError(f"{path} {refusal}") from refusal
    except DAMAGE as damage:
        raise InputError(
            f"{path} cannot be read as a file of weights: it is cut short, damaged, or of another "
            "kind; copy or download it again."
        ) from damage


def _beginning(path: Path) -> bytes:
    if path.is_dir():
        raise InputError(f"{path} is a folder; name a file of weights in it.")
    if not path.is_file():
        raise InputError(f"{path}: there is no such file of weights.")
    with path.open("rb") as file:
        beginning = file.read(512)
    if not beginning:
        raise InputError(f"{path} is empty; copy or download it again.")
    return beginning


def _refuse_others(beginning: bytes) -> None:
    """Name what is often saved or downloaded in the place of weights."""
    text = beginning.lstrip().lower()
    if text.startswith(b"version https://git-lfs"):
        raise RefusedError(
            "is a Git LFS pointer, not the file it points to; fetch that (git lfs pull)."
        )
    if text.startswith((b"<!doctype", b"<html", b"<?xml", b"<head")):
        raise RefusedError(
            "is a web page, probably of the host's download button; download it again."
        )
    if beginning[257:262] == b"ustar":
        raise RefusedError("is a tar archive; unpack it, or save it anew with torch 1.6 or later.")
    if beginning.startswith((b"\x1f\x8b", b"BZh", b"\xfd7zXZ", b"7z\xbc\xaf", b"Rar!")):
        raise RefusedError("is a compressed archive; unpack it and name the file of weights.")
    if not beginning.startswith((b"\x80", b"(", b"}", b"c", b"]")):
        raise RefusedError(
            "is no file of weights; read are torch.save, pickles of arrays or tensors, safetensors."
        )


def _is_safetensors(beginning: bytes) -> bool:
    """Whether a header of at most 100 MB follows, the limit of the format; pickles say more."""
    length = int.from_bytes(beginning[:8], "little")
    return beginning[8:9] == b"{" and length <= 100_000_000


def _read_safetensors(path: Path) -> Contents:
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(path, framework="pt") as file:
            note = dict(file.metadata() or {})
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except (SafetensorError, OSError) as error:
        raise DamagedError from error
    own = {key.removeprefix(f"{NOTE}."): note[key] for key in note if key.startswith(f"{NOTE}.")}
    return _without_prefixes(
        Contents(path, "safetensors", tensors, ours=bool(own), note=own), tensors
    )


def _unwrapped(path: Path, value: Any, container: str) -> Contents:
    """The tensors in what a file holds: they lie at the top, or under one known key."""
    if not isinstance(value, dict):
        raise RefusedError(
            f"holds {_kind(value)}, not tensors by name; give a file that holds a state_dict()."
        )
    inner = [key for key in WRAPPERS if _is_state(value.get(key))]
    if len(inner) > 1:
        raise RefusedError(
            f"holds weights under {' and '.join(inner)}; keep one of them in the file."
        )
    if not inner and not _is_state(value):
        keys = ", ".join(printable(str(key), 30) for key in list(value)[:6])
        raise RefusedError(f"holds no tensors by name; its keys are: {keys or 'none'}.")
    where = inner[0] if inner else ""
    state = value[where] if inner else value
    tensors = {name: found.tensor() for name, found in state.items() if _is_tensor(found)}
    outside = [key for key in value if key != where] if inner else []
    inside = [key for key, found in state.items() if not _is_tensor(found)]
    note = value.get(NOTE) if inner else None
    contents = Contents(
        path,
        container,
        tensors,
        where=where,
        others=tuple(printable(str(key), 40) for key in [*outside, *inside]),
        settings=_settings(value) if inner else {},
        ours=value.keys() in OURS,
        note=_texts(note),
    )
    return _without_prefixes(contents, tensors)


def _texts(note: object) -> dict[str, str]:
    """Texts by name; anything else a stranger's file may hold there is left alone."""
    items = note.items() if isinstance(note, dict) else ()
    return {k: v for k, v in items if type(k) is str and type(v) is str}


def _is_tensor(value: object) -> bool:
    return isinstance(value, Strided | Array)


def _is_state(value: object) -> bool:
    """Whether a dictionary is tensors by name."""
    return (
        isinstance(value, dict)
        and any(map(_is_tensor, value.values()))
        and all(type(key) is str for key in value)
    )


def _kind(value: object) -> str:
    return "one tensor" if _is_tensor(value) else f"a {type(value).__name__}"


def _without_prefixes(contents: Contents, tensors: dict[str, Tensor]) -> Contents:
    prefix = ""
    while found := next((p for p in PREFIXES if all(n.startswith(p) for n in tensors)), None):
        tensors = {name.removeprefix(found): tensor for name, tensor in tensors.items()}
        prefix += found
        if not all(tensors):
            raise RefusedError("has names without a word in them.")
    return replace(contents, tensors=tensors, prefix=prefix)


def _settings(value: dict[Any, Any]) -> dict[str, Any]:
    """Plain values in the configuration objects of a file, by dotted key, few levels deep."""
    found = {key: value[key] for key in ("step", "epoch") if isinstance(value.get(key), int)}
    seen: set[int] = set()  # one object in many places is read once, or reading might never end
    level = [("", value.get(key)) for key in ("hyper_parameters", "args", "config", "state")]
    for _ in range(5):
        children = []
        for path, node in level:
            items = node.items if isinstance(node, Inert) else node
            if isinstance(items, dict) and id(items) not in seen:
                seen.add(id(items))
                children += [(f"{path}.{key}".lstrip("."), items[key]) for key in items]
        found |= {where: child for where, child in children if isinstance(child, PLAIN)}
        level = children
    return found
