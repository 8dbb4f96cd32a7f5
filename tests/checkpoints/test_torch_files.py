"""Checkpoints of ours: written with a digest, read whole or refused; damaged ones never crash."""

from __future__ import annotations

import os
import random
import shutil
import struct
import zipfile
from collections.abc import Iterator
from dataclasses import asdict, replace
from io import BytesIO
from pathlib import Path
from typing import Any

import pytest
import torch

from rgbt import evaluate
from rgbt.checkpoints.read import read
from rgbt.checkpoints.torch_files import save
from rgbt.checks import InputError, RunError
from rgbt.engine.checkpoint import (
    Checkpoints,
    State,
    load_checkpoint,
    restore_optimizer,
    restore_weights,
    training_payload,
)
from rgbt.metrics.counts import Counts
from rgbt.runs.result import RunResult
from tests.checkpoints.test_read import Calls
from tests.commands import Call, Trained, short
from tests.damage import damaged


def trained() -> tuple[torch.nn.Module, torch.optim.Optimizer]:
    """A small network after three steps of AdamW."""
    torch.manual_seed(0)
    layers = torch.nn.Conv2d(4, 8, 3), torch.nn.BatchNorm2d(8), torch.nn.Conv2d(8, 9, 1)
    model = torch.nn.Sequential(*layers)
    optimizer = torch.optim.AdamW(model.parameters(), lr=0.1)
    for _ in range(3):
        step(model, optimizer)
    return model, optimizer


def step(model: torch.nn.Module, optimizer: torch.optim.Optimizer) -> None:
    optimizer.zero_grad()
    model(torch.ones(2, 4, 8, 8)).square().sum().backward()
    optimizer.step()


def payload() -> dict[str, Any]:
    model, optimizer = trained()
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
    assert path.read_bytes()[-64:].isalnum(), "a copy carries the digest"
    assert read(path).tensors.keys() == content["model"].keys()
    assert read(path).ours


def variants(content: bytes, number: int) -> Iterator[bytes]:
    """Damaged bytes, headers, entries with exchanged names or contents, other comments."""
    draw = random.Random(17)
    with zipfile.ZipFile(BytesIO(content)) as archive:
        entries = {each.filename: archive.read(each) for each in archive.infolist()}
        comment = archive.comment
    tensors = [name for name in entries if "/data/" in name]
    sizes = [len(entries[name]) for name in tensors]
    alike = [name for name in tensors if sizes.count(len(entries[name])) > 1]
    table, end = content.index(b"PK\x01\x02"), content.rindex(b"PK\x05\x06")
    yield from (each for _, each in damaged(content, number))
    for _ in range(number // 4):
        mark = draw.choice([b"PK\x03\x04", b"PK\x01\x02", b"PK\x05\x06"])
        places = [n for n in range(len(content)) if content.startswith(mark, n)]
        header = bytearray(content)
        header[(draw.choice(places) + draw.randrange(46)) % len(header)] = draw.randrange(256)
        yield bytes(header)
        one = draw.choice(alike)
        other = draw.choice([n for n in alike if len(entries[n]) == len(entries[one]) and n != one])
        if len(one) == len(other):  # two entries that have changed their names, checksums and all
            names = content[table:].replace(one.encode(), b"?" * len(one), 1)
            names = names.replace(other.encode(), one.encode(), 1)
            yield content[:table] + names.replace(b"?" * len(one), other.encode(), 1)
        exchanged, made = {**entries, one: entries[other], other: entries[one]}, BytesIO()
        with zipfile.ZipFile(made, "w") as archive:  # every checksum fits
            for name, value in exchanged.items():
                archive.writestr(name, value)
            archive.comment = comment
        yield made.getvalue()
        length = draw.choice((0, 1, 75, 77, 65535, draw.randrange(65536)))
        yield content[: end + 20] + struct.pack("<H", length) + content[end + 22 :]


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("number", [72, pytest.param(720, marks=pytest.mark.slow)])
def test_a_damaged_file_is_refused_or_whole(tmp_path: Path, number: int) -> None:
    path, whole = tmp_path / "last.pt", payload()
    save(path, whole)
    tried = refused = 0
    for content in variants(path.read_bytes(), number):
        (tmp_path / "copy.pt").write_bytes(content)
        tried += 1
        try:
            assert same(load_checkpoint(tmp_path / "copy.pt"), whole)
        except InputError:
            refused += 1
    assert tried >= 1.7 * number
    assert refused > 0.8 * tried


def test_files_without_a_digest_are_held_against_their_checksums(tmp_path: Path) -> None:
    path, content = tmp_path / "last.pt", payload()
    torch.save(content, path)
    assert same(load_checkpoint(path), content)
    whole = path.read_bytes()
    changed = content["model"]["0.weight"].numpy().tobytes()
    for offset in range(0, len(changed), 97):
        flipped = bytearray(whole)
        flipped[whole.index(changed) + offset] ^= 4
        path.write_bytes(flipped)
        for reader in (load_checkpoint, read):
            with pytest.raises(InputError, match="does not match its checksum"):
                reader(path)


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("kind", ["legacy", "safetensors"])
def test_damaged_files_of_others_raise_one_kind_of_error(tmp_path: Path, kind: str) -> None:
    from safetensors.torch import save_file

    tensors = {"a": torch.arange(6.0).reshape(2, 3), "b": torch.tensor([1, 2])}
    path, refused = tmp_path / "file", 0
    if kind == "legacy":
        torch.save({"model": tensors}, path, _use_new_zipfile_serialization=False)
    else:
        save_file(tensors, path)
    for _, content in damaged(path.read_bytes(), 200):
        path.write_bytes(content)
        try:
            assert all(tensor.sum() is not None for tensor in read(path).tensors.values())
        except InputError:
            refused += 1
    assert 10 < refused < 200


def test_a_tensor_of_another_shape_or_type_than_its_place_is_refused(tmp_path: Path) -> None:
    model, weights = trained()[0], payload()["model"]
    name = "0.weight"
    for wrong in (weights[name].double(), weights[name].mT[:, :3], weights[name].to_sparse(), "x"):
        with pytest.raises(InputError, match=f"{name} is .* instead of 8x4x3x3 float32"):
            restore_weights(model, {**weights, name: wrong}, tmp_path / "best.pt")


WRONG: list[Any] = [
    *(None, True, -1, 1.5, "x", b"x", [], [1], {}, {"a": 1}, ("a", "b"), torch.zeros(7)),
    *(torch.zeros(8, 4, 3, 3, dtype=torch.int64), torch.zeros(8, 4, 3, 3).double()),
    *(torch.eye(3).to_sparse(), torch.zeros(8, 4, 3, 3, device="meta"), torch.tensor("a" == "b")),
]


def places(node: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """The path of every value inside dictionaries and lists."""
    if path:
        yield path
    for key in (
        node if isinstance(node, dict) else range(len(node) if isinstance(node, list) else 0)
    ):
        yield from places(node[key], (*path, key))


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("every", [40, pytest.param(3, marks=pytest.mark.slow)])
def test_values_of_other_types_and_shapes_are_refused_or_trained_with(
    tmp_path: Path, every: int
) -> None:
    """Every value in a checkpoint, replaced by others, removed or doubled; then a step is made."""
    path, refused, tried = tmp_path / "last.pt", 0, 0
    base = payload()
    for index, place in enumerate(places(base)):
        for number, wrong in enumerate([*WRONG, "removed"]):
            if (index * len(WRONG) + number) % every:
                continue
            content = payload_with(base, place, wrong)
            save(path, content)
            model, optimizer = trained()
            tried += 1
            try:
                loaded = load_checkpoint(path)
                State.of(loaded)
                restore_weights(model, loaded["model"], path)
                if loaded.get("optimizers", {}).keys() == {"main"}:
                    restore_optimizer(optimizer, loaded["optimizers"]["main"], path)
            except (InputError, TypeError, ValueError):
                refused += 1
                continue
            step(model, optimizer)
    assert refused > tried / 2


def payload_with(base: dict[str, Any], place: tuple[Any, ...], wrong: Any) -> dict[str, Any]:
    """A copy in which one value is another one."""

    def copied(node: Any) -> Any:
        if isinstance(node, dict):
            return {key: copied(each) for key, each in node.items()}
        return [copied(each) for each in node] if isinstance(node, list) else node

    changed = copied(base)
    parent = changed
    for key in place[:-1]:
        parent = parent[key]
    if isinstance(wrong, str) and wrong == "removed":
        del parent[place[-1]]
    else:
        parent[place[-1]] = wrong
    return changed  # type: ignore[no-any-return]


def test_nothing_in_a_checkpoint_runs(tmp_path: Path) -> None:
    marker = tmp_path / "marker"
    content = payload() | {"step": Calls(os.system, f"touch {marker}")}
    save(tmp_path / "last.pt", content)  # a digest says that a file is whole, not that it is ours
    with pytest.raises(InputError, match=r"posix\.system"):
        load_checkpoint(tmp_path / "last.pt")
    with pytest.raises(RunError, match=r"posix\.system.*remove .* and rerun"):
        Checkpoints(tmp_path).load()
    assert not marker.exists()


def test_checkpoints_and_counts_of_another_run_are_refused(
    trained: Trained, call: Call, tmp_path: Path
) -> None:
    words = ("+experiment=mfnet", "masker.patch_size=null", *short(1))
    first, other = trained(*words, "seed=1"), trained(*words, "seed=2")
    folder = Path(shutil.copytree(first, tmp_path / "runs" / first.name))
    evaluated = (f"run={folder}", f"out={tmp_path / 'counts.npz'}")
    code, _, err = call(evaluate.entry, *evaluated)
    assert code == 0, err
    assert Counts.load(tmp_path / "counts.npz").run == RunResult(folder).counts().run == first.name
    (tmp_path / "counts.npz").unlink()
    config = folder / "config.yaml"
    stored = config.read_text()
    config.write_text(stored.replace("seed: 1\n", "seed: 3\n", 1))
    code, _, err = call(evaluate.entry, *evaluated)
    assert (code, "config.yaml was changed after training" in err) == (2, True)
    config.write_text(stored)
    shutil.copy(other / "best.pt", folder)
    code, _, err = call(evaluate.entry, *evaluated)
    assert (code, f"belongs to the run {other.name}" in err) == (2, True)
    shutil.copy(other / "counts_test.npz", folder)
    with pytest.raises(InputError, match=f"counts of the run {other.name}"):
        RunResult(folder).counts()
    # A state of another run is not resumed.
    state = State(seed=3, step=7, best_step=7, key="a", settings="b")
    run = Checkpoints(tmp_path / "a")
    run.commit(payload() | {"state": asdict(state)}, state)
    assert run.load_best(state).keys() == payload()["model"].keys()
    with pytest.raises(RunError, match="belongs to the run a, not to c"):
        run.load_best(replace(state, key="c"))


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
