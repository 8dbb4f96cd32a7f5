"""Checkpoints of ours: written with a digest, read whole or refused in one sentence."""

from __future__ import annotations

import os
import random
import shutil
import struct
import zipfile
from io import BytesIO
from pathlib import Path
from typing import Any

import pytest
import torch

from rgbt.checkpoints.read import read
from rgbt.checkpoints.torch_files import save
from rgbt.checks import InputError, RunError
from rgbt.engine.checkpoint import (
    Checkpoints,
    State,
    load_checkpoint,
    restore_optimizer,
    training_payload,
)
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
    return training_payload({"model": model.state_dict()}, {}, {"main": optimizer}, state)


def same(one: object, other: object) -> bool:
    """Equal in types, shapes and bits."""
    if isinstance(one, torch.Tensor) and isinstance(other, torch.Tensor):
        return one.dtype == other.dtype and torch.equal(one, other)
    if isinstance(one, dict) and isinstance(other, dict):
        return list(one) == list(other) and all(same(one[key], other[key]) for key in one)
    if isinstance(one, list | tuple) and isinstance(other, list | tuple):
        return len(one) == len(other) and all(map(same, one, other))
    return type(one) is type(other) and one == other


def test_what_is_saved_is_loaded_by_us_and_by_torch(tmp_path: Path) -> None:
    path, content = tmp_path / "last.pt", payload()
    save(path, content)
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
def test_a_damaged_file_is_refused_or_whole(tmp_path: Path, count: int) -> None:
    path, draw = tmp_path / "last.pt", random.Random(17)
    save(path, payload())
    whole = path.read_bytes()
    kinds = (headers, swapped, repacked, commented)
    variants = [(kind.__name__, kind(draw, whole)) for kind in kinds for _ in range(count)]
    for kind, content in [*damaged(whole, 9 * count), *variants]:
        if content == whole:
            continue
        path.write_bytes(content)
        try:
            found = load_checkpoint(path)
        except InputError:
            continue
        assert same(found, payload()), f"{kind}: a byte of a header that nobody reads"


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
        with pytest.raises(InputError, match="does not match its checksum"):
            load_checkpoint(path)
        with pytest.raises(InputError, match="does not match its checksum"):
            read(path)


@pytest.mark.parametrize("name", ["last.pt", "best.pt"])
def test_nothing_in_a_checkpoint_runs(tmp_path: Path, name: str) -> None:
    marker = tmp_path / "marker"
    content = payload() | {"step": Calls(os.system, f"touch {marker}")}
    save(tmp_path / name, content)  # a digest says that a file is whole, not that it is ours
    with pytest.raises(InputError, match=r"refers to posix\.system, which would execute"):
        load_checkpoint(tmp_path / name)
    if name == "last.pt":
        with pytest.raises(RunError, match=r"refers to posix\.system.*remove .* and rerun"):
            Checkpoints(tmp_path).load()
    assert not marker.exists()


def test_a_file_that_cannot_be_written_leaves_the_old_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "last.pt"
    save(path, {"model": {}})
    before = path.read_bytes()

    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space"):
        save(path, payload())
    assert path.read_bytes() == before
    assert [each.name for each in tmp_path.iterdir()] == ["last.pt"]


def moment(stored: dict[str, Any]) -> None:
    stored["state"][0]["exp_avg"] = torch.zeros(7)


def whole_numbers(stored: dict[str, Any]) -> None:
    stored["state"][0]["exp_avg"] = torch.zeros_like(
        stored["state"][0]["exp_avg"], dtype=torch.int64
    )


def betas(stored: dict[str, Any]) -> None:
    stored["param_groups"][0]["betas"] = "0.9"


def groups(stored: dict[str, Any]) -> None:
    stored["param_groups"] *= 2


def another_parameter(stored: dict[str, Any]) -> None:
    stored["state"][99] = stored["state"][0]


@pytest.mark.parametrize("change", [moment, whole_numbers, betas, groups, another_parameter])
def test_optimizer_state_of_other_shape_or_type_is_refused(change: Any) -> None:
    parameter = torch.nn.Parameter(torch.zeros(2, 3))
    optimizer = torch.optim.AdamW([parameter], lr=0.1)
    parameter.grad = torch.ones(2, 3)
    optimizer.step()
    stored = optimizer.state_dict()
    restore_optimizer(optimizer, stored, Path("last.pt"))
    change(stored)
    with pytest.raises(InputError, match=r"last\.pt holds the state of a different optimizer"):
        restore_optimizer(optimizer, stored, Path("last.pt"))


@pytest.mark.parametrize(
    "wrong",
    [
        *({"step": -1}, {"step": 1.5}, {"seed": "3"}, {"best_score": None}, {"skipped": "a"}),
        *(
            {"skipped": [3]},
            {"unlogged": [1.0]},
            {"unlogged": {"loss": "1"}},
        ),
    ],
)
def test_state_of_other_types_is_refused(wrong: dict[str, Any]) -> None:
    stored = payload()
    assert State.of(stored).unlogged == {}
    with pytest.raises(TypeError):
        State.of({"state": stored["state"] | wrong})
