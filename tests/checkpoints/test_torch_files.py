"""Checkpoints of ours: written with a digest, read whole or refused; damaged ones never crash."""

from __future__ import annotations

import copy
import os
import random
import shutil
import struct
import zipfile
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import asdict, replace
from io import BytesIO
from pathlib import Path
from typing import Any

import pytest
import safetensors.torch
import torch

from rgbt import evaluate
from rgbt.checkpoints.files import read, save
from rgbt.checks import InputError, RunError
from rgbt.engine.checkpoint import (
    State,
    best_payload,
    commit,
    load_best,
    load_checkpoint,
    restore_optimizer,
    restore_weights,
    training_payload,
)
from rgbt.metrics.counts import Counts
from rgbt.runs.result import RunResult
from tests.commands import Call, Trained, edit_config, short
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


def test_saved_file_is_loaded_by_us_and_torch(tmp_path: Path) -> None:
    path, content = tmp_path / "last.pt", payload()
    save(path, content)
    assert same(load_checkpoint(path), content)
    assert same(torch.load(path, weights_only=True), content)
    assert path.read_bytes()[-64:].isalnum(), "a copy carries the digest"
    assert read(path).tensors.keys() == content["model"].keys()
    assert read(path).ours


def variants(content: bytes, number: int) -> Iterator[bytes]:
    """Damaged bytes, entries with exchanged contents, other comments."""
    draw = random.Random(17)
    with zipfile.ZipFile(BytesIO(content)) as archive:
        entries = {entry.filename: archive.read(entry) for entry in archive.infolist()}
        comment = archive.comment
    sizes = Counter(len(value) for name, value in entries.items() if "/data/" in name)
    alike = [name for name in entries if "/data/" in name and sizes[len(entries[name])] > 1]
    end = content.rindex(b"PK\x05\x06")
    yield from (each for _, each in damaged(content, number))
    for _ in range(number // 4):
        one = draw.choice(alike)
        other = draw.choice([n for n in alike if len(entries[n]) == len(entries[one]) and n != one])
        exchanged, made = {**entries, one: entries[other], other: entries[one]}, BytesIO()
        with zipfile.ZipFile(made, "w") as archive:  # every checksum fits
            for name, value in exchanged.items():
                archive.writestr(name, value)
            archive.comment = comment
        yield made.getvalue()
        length = draw.choice((0, 1, 75, 77, 65535, draw.randrange(65536)))
        yield content[: end + 20] + struct.pack("<H", length) + content[end + 22 :]


@pytest.mark.filterwarnings("ignore")
def test_a_damaged_file_is_refused_or_whole(tmp_path: Path) -> None:
    path, whole, number = tmp_path / "last.pt", payload(), 120
    save(path, whole)
    tried = refused = 0
    for content in variants(path.read_bytes(), number):
        (tmp_path / "copy.pt").write_bytes(content)
        tried += 1
        try:
            assert same(load_checkpoint(tmp_path / "copy.pt"), whole)
        except InputError:
            refused += 1
    assert tried == 1.5 * number
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
def test_damaged_files_of_others_raise_one_kind_of_error(tmp_path: Path) -> None:
    tensors = {"a": torch.arange(6.0).reshape(2, 3), "b": torch.tensor([1, 2])}
    path = tmp_path / "file"
    torch.save({"model": tensors}, path, _use_new_zipfile_serialization=False)
    for whole in (path.read_bytes(), safetensors.torch.save(tensors)):
        refused = 0
        for _, content in damaged(whole, 100):
            path.write_bytes(content)
            try:
                assert all(tensor.sum() is not None for tensor in read(path).tensors.values())
            except InputError:
                refused += 1
        assert 5 < refused < 100


def test_tensor_of_other_shape_or_type_is_refused(tmp_path: Path) -> None:
    model, weights = trained()[0], payload()["model"]
    name = "0.weight"
    for wrong in (weights[name].double(), weights[name].mT[:, :3], weights[name].to_sparse(), "x"):
        with pytest.raises(InputError, match=f"{name} is .* instead of 8x4x3x3 float32"):
            restore_weights(model, {**weights, name: wrong}, tmp_path / "best.pt")


def test_checkpoints_and_counts_of_another_run_are_refused(
    trained: Trained, call: Call, tmp_path: Path
) -> None:
    words = ("+experiment=mfnet", "masker.patch_size=null", *short(1))
    first, other = trained(*words, "seed=1"), trained(*words, "seed=2")
    folder = Path(shutil.copytree(first, tmp_path / "runs" / first.name))
    evaluated = (f"run={folder}", f"out={tmp_path / 'counts.npz'}")
    code, _, err = call(evaluate.entry, *evaluated)
    assert code == 0, err
    counts = Counts.load(tmp_path / "counts.npz"), RunResult(folder).counts()
    assert [of_split.measurement.run for of_split in counts] == [first.name] * 2
    (tmp_path / "counts.npz").unlink()
    config = folder / "config.yaml"
    stored = config.read_text()
    config.write_text(stored.replace("seed: 1\n", "seed: 3\n", 1))
    code, _, err = call(evaluate.entry, *evaluated)
    assert (code, "config.yaml cannot be read" in err, "checksum" in err) == (2, True, True)
    config.write_text(stored)
    edit_config(folder, "seed: 1\n", "seed: 3\n")
    code, _, err = call(evaluate.entry, *evaluated)
    assert (code, "config.yaml was changed after training" in err) == (2, True)
    config.write_text(stored)
    shutil.copy(other / "best.pt", folder)
    code, _, err = call(evaluate.entry, *evaluated)
    assert (code, f"belongs to the run {other.name}" in err) == (2, True)
    shutil.copy(other / "counts_test.npz", folder)
    with pytest.raises(InputError, match=f"counts of the run {other.name}"):
        RunResult(folder).counts()
    state = State(seed=3, step=7, best_step=7, key="a", settings="b")
    best = best_payload(payload()["model"], state), lambda _: None
    commit(tmp_path / "a", payload() | {"state": asdict(state)}, best)
    assert load_best(tmp_path / "a", state).keys() == payload()["model"].keys()
    with pytest.raises(RunError, match="belongs to the run a, not to c"):
        load_best(tmp_path / "a", replace(state, key="c"))


def test_failed_write_leaves_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "last.pt"
    save(path, {"model": {}})
    before = path.read_bytes()

    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space"):
        save(path, payload())
    assert path.read_bytes() == before
    assert [file.name for file in tmp_path.iterdir()] == ["last.pt"]


def exchanged(node: dict[str, Any], key: Any, value: Any = None) -> None:
    """Another value for an entry; None: it is removed."""
    del node[key]
    if value is not None:
        node[key] = value


OTHER_STATES: dict[str, Callable[[dict[str, Any]], Any]] = {
    "exp_avg of parameter 0": lambda s: exchanged(s["state"][0], "exp_avg", torch.zeros(7)),
    "exp_avg of parameter 1": lambda s: exchanged(s["state"][1], "exp_avg", torch.zeros(8).long()),
    "differ in kind": lambda s: exchanged(s["state"][0], "exp_avg_sq"),
    "betas is 0.9": lambda s: exchanged(s["param_groups"][0], "betas", "0.9"),
    "argument 2 is": lambda s: exchanged(s, "param_groups", 2 * s["param_groups"]),
    "99": lambda s: s["state"].update({99: s["state"][0]}),
}


@pytest.mark.parametrize("said", OTHER_STATES)
def test_optimizer_state_of_other_shape_or_type_is_refused(said: str) -> None:
    """A moment of another shape would end the next step by SIGSEGV."""
    stored = copy.deepcopy(payload()["optimizers"]["main"])
    restore_optimizer(trained()[1], stored, Path("last.pt"))
    OTHER_STATES[said](stored)
    with pytest.raises(InputError, match=rf"last\.pt holds the state of a different .*{said}"):
        restore_optimizer(trained()[1], stored, Path("last.pt"))


def test_state_of_other_types_is_refused() -> None:
    stored = payload()
    assert State.of(stored).unlogged == {}
    for wrong in (
        *({"step": -1}, {"step": 1.5}, {"seed": "3"}, {"best_score": None}, {"skipped": "a"}),
        *({"skipped": [3]}, {"unlogged": [1.0]}, {"unlogged": {"loss": "1"}}),
    ):
        with pytest.raises(TypeError):
            State.of({"state": stored["state"] | wrong})
