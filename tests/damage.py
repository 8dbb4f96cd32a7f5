"""Damaged copies of a file, as disks, interrupted copies and programs make them.

Every variant follows from (seed, number) alone, so that one that fails can be made again.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

Damage = Callable[[bytes, np.random.Generator], bytes]

BLOCK = 512
"""Largest block that is overwritten or repeated: a sector of a disk."""


def damaged(content: bytes, number: int, seed: int = 0) -> Iterator[tuple[str, bytes]]:
    """`number` damaged variants of `content`, each with its name ("17: bits"); none equals it.

    Example:
        >>> [name for name, _ in damaged(b"abc", 2)]
        ['0: bits', '1: truncated']

    Args:
        content: a whole file, not empty.
        number: how many; the kinds of damage take turns.
        seed: another seed gives other variants.
    """
    kinds = list(DAMAGES.items())
    for index in range(number):
        name, damage = kinds[index % len(kinds)]
        rng = np.random.default_rng([seed, index])
        variant = content
        while variant == content:  # a zero that is zeroed, two equal blocks
            variant = damage(content, rng)
            damage = _bits
        yield f"{index}: {name}", variant


def _bits(content: bytes, rng: np.random.Generator) -> bytes:
    """One to eight flipped bits."""
    data = bytearray(content)
    for _ in range(int(rng.integers(1, 9))):
        data[int(rng.integers(len(data)))] ^= 1 << int(rng.integers(8))
    return bytes(data)


def _truncated(content: bytes, rng: np.random.Generator) -> bytes:
    return content[: int(rng.integers(len(content)))]


def _zeroed(content: bytes, rng: np.random.Generator) -> bytes:
    start, end = _block(content, rng)
    return content[:start] + bytes(end - start) + content[end:]


def _duplicated(content: bytes, rng: np.random.Generator) -> bytes:
    start, end = _block(content, rng)
    return content[:end] + content[start:end] + content[end:]


def _inserted(content: bytes, rng: np.random.Generator) -> bytes:
    place = int(rng.integers(len(content) + 1))
    return content[:place] + rng.bytes(int(rng.integers(1, 65))) + content[place:]


def _empty(content: bytes, rng: np.random.Generator) -> bytes:
    del content, rng
    return b""


def _swapped(content: bytes, rng: np.random.Generator) -> bytes:
    """The halves change places, cut somewhere in the middle third."""
    third = len(content) // 3
    place = third + int(rng.integers(third + 1))
    return content[place:] + content[:place]


def _overwritten(content: bytes, rng: np.random.Generator) -> bytes:
    """A block of noise in the place of a block."""
    start, end = _block(content, rng)
    return content[:start] + rng.bytes(end - start) + content[end:]


def _block(content: bytes, rng: np.random.Generator) -> tuple[int, int]:
    start = int(rng.integers(len(content)))
    return start, min(len(content), start + int(rng.integers(1, BLOCK + 1)))


DAMAGES: dict[str, Damage] = {
    "bits": _bits,
    "truncated": _truncated,
    "zeroed": _zeroed,
    "duplicated": _duplicated,
    "inserted": _inserted,
    "empty": _empty,
    "swapped": _swapped,
    "overwritten": _overwritten,
}
