"""Checkpoints of ours: written with a digest, read whole or refused in one sentence."""

from __future__ import annotations

import os
import random
import shutil
import struct
import zipfile
from copy import copy
from io import BytesIO
from pathlib import Path
from typing import Any

import pytest
import torch

from rgbt.checkpoints import stored
from rgbt.checkpoints.read import read
from rgbt.checks import InputError, RunError
from rgbt.engine.checkpoint import State, load_checkpoint, training_payload
from rgbt.engine.committed import Checkpoints
from tests.checkpoints.test_read import Calls
from tests.damage import damaged


def payload() -> dict[str, Any]:
    """Of a small network after three steps of AdamW."""
    torch.manual_seed(0)
    layers = torch.nn.Conv2d(4, 8, 3), torch.nn.BatchNorm2d(8), torch.nn.Conv2d(8, 9, 1)
    model = torch.nn.Sequential(*layers)
    optimizer = torch.optim.AdamW(model.parameters(), lr=0.1)
    for _ in range(3):
        optimizer.zero_grad()
        model(torch.rand(2, 4, 8, 8)).square().sum().backward()
        optimizer.step()
    state = State(seed=3, step=7, best_score=0.25, best_step=4, skipped=["a"])
    return training_payload(model.state_dict(), None, {}, {"main": optimizer}, state)


def same(one: object, other: object) -> bool:
    """Equal in types, shapes and bits."""
    if isinstance(one, torch.Tensor) and isinstance(other, torch.Tensor):
        return one.dtype == other.dtype and torch.equal(one, other)
    if isinstance(one, dict) and isinstance(other, dict):
        return list(one) == list(other) and all(same(one[key], other[key]) for key in one)
    if isinstance(one, list | tuple) and isinstance(other, list | tuple):
        return len(one) == len(other) and all(map(same, one, other))
    return type(one) is type(other) and one == other


def sentence(refused: pytest.ExceptionInfo[Exception]) -> str:
    text = str(refused.value)
    assert text.isprintable(), "one line without control characters"
    assert "weights_only" not in text
    return text


def test_what_is_saved_is_loaded_by_us_and_by_torch(tmp_path: Path) -> None:
    path, content = tmp_path / "last.pt", payload()
    stored.save(path, content)
    assert same(load_checkpoint(path), content)
    assert same(torch.load(path, weights_only=True), content)
    shutil.copy(path, tmp_path / "copy.pt")
    assert (tmp_path / "copy.pt").read_bytes()[-64:].isalnum(), "a copy carries the digest"
    assert read(tmp_path / "copy.pt").tensors.keys() == content["model"].keys()


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


@pytest.mark.parametrize("count", [8, pytest.param(80, marks=pytest.mark.slow)])
def test_a_damaged_file_is_refused_in_one_sentence(tmp_path: Path, count: int) -> None:
    path, draw = tmp_path / "last.pt", random.Random(17)
    stored.save(path, payload())
    whole = path.read_bytes()
    kinds = (headers, swapped, repacked, commented)
    variants = [(kind.__name__, kind(draw, whole)) for kind in kinds for _ in range(count)]
    for kind, content in [*damaged(whole, 9 * count), *variants]:
        if content == whole:
            continue
        path.write_bytes(content)
        with pytest.raises(InputError) as refused:
            pytest.fail(f"{kind}: {load_checkpoint(path)}")
        sentence(refused)


def test_an_old_file_is_held_against_its_checksums(tmp_path: Path) -> None:
    path, content = tmp_path / "last.pt", payload()
    torch.save(content, path)
    assert same(load_checkpoint(path), content)
    whole = path.read_bytes()
    changed = content["model"]["0.weight"].numpy().tobytes()
    place = whole.index(changed)
    for offset in range(0, len(changed), 97):
        flipped = bytearray(whole)
        flipped[place + offset] ^= 4
        path.write_bytes(flipped)
        with pytest.raises(InputError, match="truncated, damaged"):
            load_checkpoint(path)
        with pytest.raises(InputError, match="truncated, damaged"):
            read(path)


@pytest.mark.parametrize("name", ["last.pt", "best.pt"])
def test_nothing_in_a_checkpoint_runs(tmp_path: Path, name: str) -> None:
    marker = tmp_path / "marker"
    content = payload() | {"step": Calls(os.system, f"touch {marker}")}
    stored.save(tmp_path / name, content)  # a digest says that a file is whole, not that it is ours
    with pytest.raises(
        InputError, match=r"refers to posix\.system, which would execute"
    ) as refused:
        load_checkpoint(tmp_path / name)
    sentence(refused)
    if name == "last.pt":
        with pytest.raises(RunError, match=r"refers to posix\.system.*remove .* and rerun"):
            Checkpoints(tmp_path).load()
    assert not marker.exists()


def test_what_would_grow_is_refused_before_it_does(tmp_path: Path) -> None:
    packed, repeated = tmp_path / "packed.pt", tmp_path / "repeated.pt"
    made = BytesIO()
    torch.save({"model": {"a": torch.zeros(10_000_000)}}, made)
    with zipfile.ZipFile(made) as source, zipfile.ZipFile(packed, "w") as target:
        for entry in source.infolist():
            target.writestr(entry.filename, source.read(entry), zipfile.ZIP_DEFLATED)
    assert packed.stat().st_size < 100_000
    with pytest.raises(InputError, match="compression"):
        load_checkpoint(packed)
    torch.save({"model": {"a": torch.zeros(1).expand(2**20, 2**14)}}, repeated)
    with pytest.raises(InputError, match="far more memory than its size"):
        load_checkpoint(repeated)


def test_entries_that_share_their_bytes_are_refused(tmp_path: Path) -> None:
    """A table of contents may name one place a thousand times; summing each up takes for ever."""
    path = tmp_path / "shared.pt"
    torch.save({"model": {"a": torch.zeros(1000)}}, path)
    with zipfile.ZipFile(path, "a") as archive:
        (numbers,) = (each for each in archive.infolist() if each.filename.endswith("data/0"))
        for number in range(100):
            again = copy(numbers)
            again.filename = f"{number}"
            archive.filelist.append(again)
        archive.writestr("last", b"")  # writes the table anew
    with pytest.raises(InputError, match="far more memory than its size"):
        load_checkpoint(path)


def test_a_name_in_a_file_cannot_write_to_the_terminal(tmp_path: Path) -> None:
    path = tmp_path / "last.pt"
    pickled = b"\x80\x02c\x1b[2Jposix\nsystem\n)R."
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("archive/data.pkl", pickled)
    with pytest.raises(InputError, match=r"refers to \\x1b\[2Jposix\.system") as refused:
        load_checkpoint(path)
    sentence(refused)


def test_a_file_that_cannot_be_written_leaves_the_old_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "last.pt"
    stored.save(path, {"model": {}})
    before = path.read_bytes()

    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space"):
        stored.save(path, payload())
    assert path.read_bytes() == before
    assert [each.name for each in tmp_path.iterdir()] == ["last.pt"]
