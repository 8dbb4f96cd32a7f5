"""Damaged variants of a zip archive, the same ones every time."""

from __future__ import annotations

import random
import struct
import zipfile
from collections.abc import Callable, Iterator
from io import BytesIO

Damage = Callable[[random.Random, bytes], bytes]


def flipped(draw: random.Random, content: bytes) -> bytes:
    changed = bytearray(content)
    for _ in range(draw.choice((1, 1, 1, 2, 8))):
        changed[draw.randrange(len(changed))] ^= 1 << draw.randrange(8)
    return bytes(changed)


def cut(draw: random.Random, content: bytes) -> bytes:
    return content[: draw.randrange(1, len(content))]


def zeroed(draw: random.Random, content: bytes) -> bytes:
    length = draw.choice((1, 16, 512, 4096))
    start = draw.randrange(len(content))
    return content[:start] + bytes(len(content[start : start + length])) + content[start + length :]


def doubled(draw: random.Random, content: bytes) -> bytes:
    """A block that is there twice: written over what follows, or put before it."""
    length = draw.choice((16, 64, 512))
    start = draw.randrange(len(content) - length)
    after = start + length * draw.choice((1, 2))
    return content[: start + length] + content[start : start + length] + content[after:]


def moved(draw: random.Random, content: bytes) -> bytes:
    """Two blocks of one length that have changed places."""
    length = draw.choice((4, 64, 512))
    first = draw.randrange(len(content) - 2 * length)
    second = draw.randrange(first + length, len(content) - length + 1)
    one, two = content[first : first + length], content[second : second + length]
    between = content[first + length : second]
    return content[:first] + two + between + one + content[second + length :]


def headers(draw: random.Random, content: bytes) -> bytes:
    """A byte of a local header, of the table of contents or of the end."""
    changed = bytearray(content)
    marks = [b"PK\x03\x04", b"PK\x01\x02", b"PK\x05\x06"]
    mark = draw.choice(marks)
    places = [n for n in range(len(content)) if content.startswith(mark, n)]
    changed[(draw.choice(places) + draw.randrange(46)) % len(changed)] = draw.randrange(256)
    return bytes(changed)


def swapped(draw: random.Random, content: bytes) -> bytes:
    """Two entries of one length that have changed their names, checksums and all."""
    changed = bytearray(content)
    with zipfile.ZipFile(BytesIO(content)) as archive:
        entries = [entry for entry in archive.infolist() if "/data/" in entry.filename]
    one = draw.choice(entries)
    like = [
        e for e in entries if (e.file_size, len(e.filename)) == (one.file_size, len(one.filename))
    ]
    other = draw.choice([entry for entry in like if entry is not one] or [one])
    table = content.index(b"PK\x01\x02")
    for entry, name in ((one, other.filename), (other, one.filename)):
        listed = content.index(entry.filename.encode(), table)
        changed[listed : listed + len(name)] = name.encode()
    return bytes(changed)


def repacked(draw: random.Random, content: bytes) -> bytes:
    """Written anew by zipfile with two entries' contents swapped: every checksum fits."""
    with zipfile.ZipFile(BytesIO(content)) as archive:
        entries = {name: archive.read(name) for name in archive.namelist()}
        comment = archive.comment
    names = [name for name in entries if "/data/" in name]
    one = draw.choice(names)
    like = [name for name in names if len(entries[name]) == len(entries[one]) and name != one]
    other = draw.choice(like or [one])
    entries[one], entries[other] = entries[other], entries[one]
    made = BytesIO()
    with zipfile.ZipFile(made, "w") as archive:
        for name, value in entries.items():
            archive.writestr(name, value)
        archive.comment = comment
    return made.getvalue()


def commented(draw: random.Random, content: bytes) -> bytes:
    """Another length of the comment at the end."""
    place = content.rindex(b"PK\x05\x06") + 20
    length = draw.choice((0, 1, 75, 77, 65535, draw.randrange(65536)))
    return content[:place] + struct.pack("<H", length) + content[place + 2 :]


KINDS: tuple[Damage, ...] = (
    *(flipped, cut, zeroed, doubled, moved),
    *(headers, swapped, repacked, commented),
)


def damaged(content: bytes, count: int) -> Iterator[tuple[str, bytes]]:
    """(kind, content) of `count` variants that differ from the original."""
    draw = random.Random(17)
    made = 0
    while made < count:
        kind = KINDS[made % len(KINDS)]
        variant = kind(draw, content)
        if variant != content:
            made += 1
            yield kind.__name__, variant
