"""Files of weights: what is read, what is refused, and that nothing in a file ever runs."""

from __future__ import annotations

import argparse
import builtins
import copyreg
import functools
import os
import pickle
import runpy
import subprocess
import sys
import zipfile
from collections import Counter, OrderedDict, defaultdict
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch

from rgbt.checkpoints.read import Contents, read
from rgbt.checks import InputError
from tests.checkpoints.files import saved
from tests.models.golden import SHARED


def state() -> OrderedDict[str, Any]:
    """Tensors of every kind that checkpoints hold."""
    base = torch.arange(24, dtype=torch.float32)
    return OrderedDict(
        whole=base.reshape(4, 6),
        part=base[3:7],
        turned=base.reshape(4, 6).t(),
        repeated=torch.tensor([2.5]).expand(3, 2),
        half=torch.tensor([1.5, -2.0]).half(),
        brain=torch.tensor([1.5, -2.0]).bfloat16(),
        double=torch.tensor([0.1], dtype=torch.float64),
        whole_numbers=torch.tensor([[1, -2]]),
        flags=torch.tensor([True, False]),
        scalar=torch.tensor(7),
        empty=torch.empty(0, 3),
        parameter=torch.nn.Parameter(torch.tensor([3.0])),
    )


def check_equal(contents: Contents, expected: dict[str, Any]) -> None:
    assert contents.tensors.keys() == expected.keys()
    for name, value in expected.items():
        found, wanted = contents.tensors[name], torch.as_tensor(value)
        assert found.dtype == wanted.dtype, name
        assert torch.equal(found, wanted), name


def refusal(path: Path) -> str:
    """The message of a refusal, which is one line."""
    with pytest.raises(InputError) as error:
        read(path)
    assert str(error.value).isprintable()
    assert "weights_only=False" not in str(error.value), "torch's advice executes the file"
    return str(error.value)


@pytest.mark.parametrize("legacy", [False, True])
@pytest.mark.parametrize("wrapper", ["", "state_dict", "model", "own"])
def test_torch_files_give_what_was_saved(tmp_path: Path, legacy: bool, wrapper: str) -> None:
    content = {wrapper: state(), "epoch": 3} if wrapper else state()
    path = saved(tmp_path, content, legacy=legacy)
    before, contents = path.read_bytes(), read(path)
    check_equal(contents, state())
    contents.tensors["double"].fill_(1)
    assert path.read_bytes() == before, "writing to a tensor leaves the file alone"


def test_safetensors(tmp_path: Path) -> None:
    from safetensors.torch import save_file

    tensors = {"a": torch.arange(6.0).reshape(2, 3), "b": torch.tensor([1, 2])}
    save_file(tensors, tmp_path / "a.pth", metadata={"rgbt.family": "cmx"})
    contents = read(tmp_path / "a.pth")
    check_equal(contents, tensors)
    assert (contents.ours, contents.note) == (True, {"family": "cmx"})


def test_wrappers_of_names_are_taken_off(tmp_path: Path) -> None:
    content = {"module._orig_mod.a": torch.zeros(1), "module._orig_mod.module.b": torch.ones(1)}
    assert set(read(saved(tmp_path, content)).tensors) == {"a", "module.b"}


OTHER_VALUES = [
    *(np.float64(0.5), np.int64(3), {1, 2}, frozenset({"a"}), b"", b"\xff", bytearray(b"x")),
    *(Counter({30: 1}), defaultdict(list, a=[1]), torch.Size([2, 3]), torch.device("cpu")),
    *(torch.float16, (1, (2, None)), True, Path("a/b"), np.array([1, 2]), 2**70, -1.5),
]
"""What else trainings put beside their weights."""


class CfgNode(dict):  # type: ignore[type-arg]
    """Stands for a configuration class that is not installed here."""


@pytest.mark.parametrize("legacy", [False, True])
def test_configuration_objects_are_read_as_values(
    tmp_path: Path, legacy: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    names = ("detectron2", "detectron2.config", "detectron2.config.config")
    module = ModuleType(names[-1])
    module.CfgNode = CfgNode  # type: ignore[attr-defined]
    for name in names:
        monkeypatch.setitem(sys.modules, name, module)
    monkeypatch.setattr(CfgNode, "__module__", names[-1])
    inner = CfgNode(FUSION=CfgNode(AGGREGATION="ADD"), DEPTHS=[2, 2])
    inner.__dict__["__immutable__"] = True
    hyper = {"cfg": CfgNode(MODEL=inner), "args": argparse.Namespace(lr=0.1)}
    whole = {"state_dict": state(), "hyper_parameters": hyper, "epoch": 1, "others": OTHER_VALUES}
    path = saved(tmp_path, whole, legacy=legacy)
    for name in names:
        monkeypatch.delitem(sys.modules, name)
    contents = read(path)
    check_equal(contents, state())
    assert contents.settings["cfg.MODEL.FUSION.AGGREGATION"] == "ADD"
    assert contents.settings["args.lr"] == 0.1
    assert not set(names) & set(sys.modules)


def test_released_file_of_torch_0_4() -> None:
    path = SHARED / "realdata/mfnet_weights/final.pth"
    if not path.exists():
        pytest.skip("reference material is not here")
    check_equal(read(path), torch.load(path, map_location="cpu", weights_only=True))


class Calls:
    """Pickled as a call of something."""

    def __init__(self, function: Any, *arguments: Any) -> None:
        self.call = function, arguments

    def __reduce__(self) -> Any:
        return self.call


def attacks(marker: Path) -> dict[str, Any]:
    """Objects whose unpickling would write the marker file."""
    opening = f"open({str(marker)!r}, 'w').close()"
    return {
        "system": Calls(os.system, f"touch {marker}"),
        "eval": Calls(eval, opening),
        "exec": Calls(exec, opening),
        "open": Calls(builtins.open, str(marker), "w"),
        "process": Calls(subprocess.check_output, ["touch", str(marker)]),
        "module": Calls(runpy.run_path, str(marker)),
        "chain": Calls(getattr, Calls(__import__, "os"), "system"),
        "numpy": Calls(np.testing._private.utils.runstring, opening, {}),
        "torch": Calls(torch.load, str(marker)),
        "partial": functools.partial(os.system, f"touch {marker}"),
        "popen": Calls(os.popen, f"touch {marker}"),
        "dill": Calls(Calls, os.system),
    }


PLACES = ("zip", "legacy", "pickle", "settings", "key", "array", "state")


@pytest.mark.parametrize("way", [*attacks(Path("unused"))])
def test_nothing_in_a_file_runs(tmp_path: Path, way: str) -> None:
    """In each of seven places: 84 files; 28 more are written by hand below."""
    marker, tensors = tmp_path / "marker", {"a": torch.zeros(2)}
    evil = attacks(marker)[way]
    array = np.empty(1, object)
    array[0] = evil
    last = {"model": tensors, "others": {}, "optimizers": {}}
    contents: dict[str, Any] = {
        "settings": {"state_dict": tensors, "hyper_parameters": argparse.Namespace(cfg=[evil])},
        "key": {"model": tensors, ("x", evil): 1},
        "array": {"model": tensors, "b": array},
        "state": {**last, "state": {"step": evil}},
    }
    for place in PLACES:
        content = contents.get(place, {"model": tensors, "optimizer": [evil]})
        if place == "pickle":
            path = tmp_path / "file.pkl"
            path.write_bytes(pickle.dumps(content, 2))
        else:
            path = saved(tmp_path, content, legacy=place == "legacy")
        assert "cannot be read as weights" in refusal(path)
        assert not marker.exists(), place


RAW = {
    "a stand-in with a method": b"cargparse\nNamespace\n)\x81}U\x0a__reduce__cposix\nsystem\nsb",
    "a call of a stand-in's object": b"cargparse\nNamespace\n)\x81U\x01x\x85R",
    "a call of text": b"U\x02os)R",
    "a stand-in's class as the state": b"cargparse\nNamespace\nN}U\x01xU\x01ys\x86b",
    "system looked up": b"c__builtin__\ngetattr\ncos\n__dict__\nU\x06system\x86RU\x06touch x\x85R",
    "new object": b"cos\nsystem\nU\x0ctouch MARKER\x85\x81",
    "path behind a known module": b"ctorch\nserialization.os.system\nU\x0ctouch MARKER\x85R",
    "registered class": b"\x82\xf1U\x0ctouch MARKER\x85R",
    "state of a function": b"ctorch._utils\n_rebuild_tensor_v2\nN}U\x08__code__U\x01xs\x86b",
    "state of an ignored function": b"cpathlib\nPosixPath\n}U\x08__code__U\x01xsb",
    "state of a list": b"]}U\x01xU\x01ysb",
    "something outside": b"U\x01xQ",
    "unhashable key": b"}]U\x01xs",
    "control characters": b"c\x1b[2Jposix\nsystem\n)R",
}
"""Pickles written by hand."""


@pytest.mark.parametrize("way", RAW)
def test_handwritten_attacks(tmp_path: Path, way: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    pickled = b"\x80\x02" + RAW[way] + b"."
    bare, path = tmp_path / "bare.pkl", saved(tmp_path, {"a": torch.zeros(1)})
    bare.write_bytes(pickled)
    with zipfile.ZipFile(path) as source:
        entries = {name: source.read(name) for name in source.namelist()}
    with zipfile.ZipFile(path, "w") as target:
        for name, content in entries.items():
            target.writestr(name, pickled if name.endswith("data.pkl") else content)
    copyreg.add_extension("os", "system", 241)
    try:
        assert refusal(bare)
        assert refusal(path)
    finally:
        copyreg.remove_extension("os", "system", 241)
    assert not (tmp_path / "MARKER").exists()


@pytest.mark.filterwarnings("ignore")
def test_other_files_and_archives_are_refused(tmp_path: Path) -> None:
    path = saved(tmp_path, {"a": torch.zeros(1000)})
    with zipfile.ZipFile(tmp_path / "zip.pth", "w") as other:
        other.writestr("readme.txt", "hello")
    with zipfile.ZipFile(path) as source, zipfile.ZipFile(tmp_path / "again.pth", "w") as copy:
        for entry in source.infolist():
            copy.writestr(entry.filename, source.read(entry), zipfile.ZIP_DEFLATED)
    said = {
        "none.pth": "no such file",
        ".": "no such file",
        "again.pth": "compressed",
        "zip.pth": "",
    }
    for name, word in said.items():
        assert word in refusal(tmp_path / name)
    for content in (b"", b"text\n", b"<!DOCTYPE html>", b"version https://git-lfs", bytes(1000)):
        path.write_bytes(content)
        assert "file.pth cannot be read" in refusal(path)


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(
    ("content", "said"),
    [
        (torch.zeros(1), "a Tensor"),
        ([torch.zeros(1)], "a list"),
        ({"epoch": 3}, "its keys are: epoch"),
        ({}, "its keys are: none"),
        ({"model": state(), "state_dict": state()}, "under state_dict and model"),
        (torch.nn.Linear(1, 1), "torch.nn.modules.linear.Linear"),
        ({"a": torch.eye(2).to_sparse()}, "'a' is 2x2 float32"),
        ({"a": torch.zeros(2, device="meta")}, "'a' is 2 float32"),
        ({"a": torch.zeros(2).to(torch.float8_e4m3fn)}, "'a' is 2 float8_e4m3fn"),
    ],
)
def test_what_holds_no_usual_tensors_by_name(tmp_path: Path, content: Any, said: str) -> None:
    assert said in refusal(saved(tmp_path, content))
