"""Read files of others: regular, inside their folder, as JSON of the expected type."""

from __future__ import annotations

import hashlib
import json
import os
import re
import stat
import zlib
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from rgbt.checks import InputError, one_line
from rgbt.files.atomic import write_atomic

if TYPE_CHECKING:
    from pydantic import TypeAdapter


# Beginnings of files that are no weights or arrays, and what to do.
DISGUISES = {
    "<!doctype html": "a web page; download the file itself",
    "<html": "a web page; download the file itself",
    "<?xml": "a message of a server in XML; download the file itself",
    "{": "a text in JSON; download the file itself",
    "version https://git-lfs": "a pointer of Git LFS; get the file with git lfs pull",
    "\x1f\ufffd": "packed with gzip; unpack it",
}

# Beginning of the comment that seals a text, and the reason of a refusal.
SEAL, UNLIKE_SEAL = b"# crc32 ", "it does not match its checksum"


def check_links(folder: Path) -> None:
    """Refuse a folder with a link that leads out of it, or with a pipe or device as a file.

    Everything that is read, written or removed below the folder afterwards lies in it.
    """
    for place, folders, files in os.walk(folder):
        for path in (Path(place, name) for name in (*folders, *files)):
            if path.is_symlink():
                inside(path, folder)
            elif _is_special(path):
                raise InputError(f"{path} is not a regular file; remove it.")


def _is_special(path: Path) -> bool:
    """Ask once whether it is a pipe or device: another process may remove it meanwhile."""
    try:
        mode = path.stat().st_mode
    except FileNotFoundError:
        return False
    return not (stat.S_ISREG(mode) or stat.S_ISDIR(mode))


def inside(path: Path, folder: Path) -> Path:
    """Return `path`, if it is in `folder` after links and ".." are resolved; else InputError."""
    # `os.path`: `Path.resolve` raises for a circle of links.
    found, root = os.path.realpath(path), os.path.realpath(folder)
    if not Path(found).is_relative_to(root):
        raise InputError(f"{path} is a link that leads out of {folder}, or has a name that does.")
    return path


def read_bytes(path: Path) -> bytes:
    """Read every byte of a regular file; InputError for a pipe, which would be waited for."""
    if path.exists() and not path.is_file():
        raise InputError(f"{path} is not a regular file.")
    return path.read_bytes()


def file_digest(path: Path) -> str:
    """Return the SHA-256 of a file, in hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def disguise(path: Path) -> str:
    """Say what a file is that its reader refused: "it is a web page"; "" for an unknown one.

    Servers and git put such files in the place of weights and arrays.
    """
    start = path.open("rb").read(512) if path.is_file() else b"\0"
    text = re.sub(rb"\s+", b" ", start).strip().decode("ascii", errors="replace").lower()
    for beginning, what in DISGUISES.items():
        if text.startswith(beginning):
            return f"it is {what}"
    if text.isprintable() and "\ufffd" not in text:
        return f"it is a text that begins with '{text[:40]}'" if text else "it is empty"
    return ""


def sealed(value: Mapping[str, Any]) -> dict[str, Any]:
    """Return `value` as JSON, with the checksum of all other entries as its last one, "crc32"."""
    plain = json.loads(json.dumps(value))
    plain.pop("crc32", None)
    return {**plain, "crc32": f"{zlib.crc32(json.dumps(plain, sort_keys=True).encode()):08x}"}


def sealed_text(text: bytes) -> bytes:
    """Put the checksum of a YAML text before and behind it, as a comment.

    Damage to one of the lines does not make it a text without a checksum.
    """
    line = SEAL + f"{zlib.crc32(text):08x}\n".encode()
    return line + text + line


def check_seal(content: bytes) -> None:
    """ValueError: a `sealed_text` was changed. Texts of others have no such comment."""
    text = content.partition(b"\n")[2].rpartition(SEAL)[0]
    if SEAL in content and content != sealed_text(text):
        raise ValueError(UNLIKE_SEAL)


def write_json(path: Path, value: Mapping[str, Any]) -> None:
    """Write a JSON file that is `sealed`."""
    write_atomic(path, (json.dumps(sealed(value), indent=1) + "\n").encode())


def read_json(path: Path, form: Any, advice: str) -> Any:
    """Read a sealed JSON file (`parse_json`); a link out of its folder is refused.

    Args:
        path: of the file, which exists.
        form: such as ``list[str]``, a TypedDict or a dataclass, of which an object is returned.
        advice: what to do with a damaged file, at the end of the InputError.
    """
    try:
        return parse_json(read_bytes(inside(path, path.parent)), form, is_sealed=True)
    except InputError:
        raise
    except (ValueError, OSError) as error:
        reason = (isinstance(error, OSError) and error.strerror) or error
        raise InputError(f"{path} is damaged ({one_line(reason)}); {advice}.") from error


def parse_json(text: bytes | str, form: Any, *, is_sealed: bool = False) -> Any:
    """Read a JSON text as the type `form`, of which a sealed mapping may have more keys.

    ValueError: no JSON in UTF-8, another type than `form`, or a mapping with another checksum or
    none, which is removed.
    """
    import pydantic

    try:
        plain = json.loads(text)
        is_mapping = is_sealed and isinstance(plain, dict)
        if is_mapping and sealed(plain)["crc32"] != plain.pop("crc32", None):
            raise ValueError(UNLIKE_SEAL)
        extra: Literal["allow", "forbid"] = "allow" if is_sealed else "forbid"
        return _adapter(form).validate_json(json.dumps(plain), strict=True, extra=extra)
    except RecursionError as error:
        raise ValueError("it is nested too deeply") from error
    except pydantic.ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        where = ".".join(map(str, first["loc"]))
        raise ValueError(f"{where}: {first['msg']}".removeprefix(": ")) from error


@cache
def _adapter(form: Any) -> TypeAdapter[Any]:
    from pydantic import TypeAdapter

    return TypeAdapter(form)
