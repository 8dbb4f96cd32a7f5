"""A checksum at the end of an ONNX file, which detects damaged constants.

An ONNX file is one Protocol Buffers message, whose fields may be in any order. The last field is
the text `doc_string` with the checksum of all bytes before it. Programs that change a file, for
example to quantise it, write this field before the graph; such a file has no checksum.
"""

from __future__ import annotations

import hashlib

KEY = "rgbt.sha256 "
"""Before the checksum."""


def sealed(content: bytes) -> bytes:
    """The content of an ONNX file, followed by its checksum."""
    return content + _end(content)


def is_damaged(content: bytes) -> bool:
    """Whether a file ends with a checksum, and it is not that of the bytes before it."""
    empty = _end(b"")
    body, end = content[: -len(empty)], content[-len(empty) :]
    beginning = empty[: -2 * hashlib.sha256().digest_size]
    return end.startswith(beginning) and end != _end(body)


def _end(content: bytes) -> bytes:
    """The field, which always has the same length."""
    import onnx

    message = onnx.ModelProto(doc_string=KEY + hashlib.sha256(content).hexdigest())
    end: bytes = message.SerializeToString()
    return end
