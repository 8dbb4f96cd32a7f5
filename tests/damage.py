"""Damaged copies of a file, as disks, interrupted copies and programs make them."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

BLOCK = 512
"""Largest block that is overwritten or repeated: a sector of a disk."""


def damaged(content: bytes, number: int, seed: int = 0) -> Iterator[tuple[str, bytes]]:
    """`number` damaged variants of `content`, each with its name ("17: bits"); none equals it."""
    kinds = list(DAMAGES.items())
    for index in range(number):
        name, damage = kinds[index % len(kinds)]
        rng = np.random.default_rng([seed, index])
        variant = content
        while variant == content:  # a zero that is zeroed, two equal blocks
            start = int(rng.integers(len(content)))
            end = min(len(content), start + int(rng.integers(1, BLOCK + 1)))
            variant = damage(content[:start], content[start:end], content[end:], rng)
            damage = _bits
        yield f"{index}: {name}", variant


def _bits(before: bytes, block: bytes, after: bytes, rng: np.random.Generator) -> bytes:
    """One to eight flipped bits."""
    data = bytearray(before + block + after)
    for _ in range(int(rng.integers(1, 9))):
        data[int(rng.integers(len(data)))] ^= 1 << int(rng.integers(8))
    return bytes(data)


DAMAGES: dict[str, Callable[[bytes, bytes, bytes, np.random.Generator], bytes]] = {
    "bits": _bits,
    "truncated": lambda before, block, after, rng: before,
    "zeroed": lambda before, block, after, rng: before + bytes(len(block)) + after,
    "duplicated": lambda before, block, after, rng: before + block + block + after,
    "inserted": lambda before, block, after, rng: before + rng.bytes(64) + block + after,
    "empty": lambda before, block, after, rng: b"",
    "swapped": lambda before, block, after, rng: block + after + before,
    "overwritten": lambda before, block, after, rng: before + rng.bytes(len(block)) + after,
}
