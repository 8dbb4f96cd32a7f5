"""Files of weights: what is read, what is refused, and that nothing in a file ever runs."""

from __future__ import annotations

import argparse
import builtins
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
from safetensors.torch import save_file

from rgbt.checkpoints.files import Contents, read
from rgbt.checks import InputError
from tests.checkpoints.files import saved


def state() -> OrderedDict[str, Any]:
    """Tensors of every kind that checkpoints hold."""
    base = torch.arange(24, dtype=torch.float32)
    return OrderedDict(
        whole=base.reshape(4, 6),
        part=base[3:7],
        turned=base.reshape(4, 6).t(),
        repeated=torch.tensor([2.5]).expand(3, 2),
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
@pytest.mark.parametrize("wrapper", ["", "state_dict", "own"])
def test_torch_files_give_what_was_saved(tmp_path: Path, legacy: bool, wrapper: str) -> None:
    content = {wrapper: state(), "epoch": 3} if wrapper else state()
    path = saved(tmp_path, content, legacy=legacy)
    before, contents = path.read_bytes(), read(path)
    check_equal(contents, state())
    contents.tensors["double"].fill_(1)
    assert path.read_bytes() == before, "writing to a tensor leaves the file alone"


def test_safetensors_and_wrappers_of_names(tmp_path: Path) -> None:
    tensors = {"a": torch.arange(6.0).reshape(2, 3), "b": torch.tensor([1, 2])}
    save_file(tensors, tmp_path / "a.pth", metadata={"rgbt.family": "cmx"})
    contents = read(tmp_path / "a.pth")
    check_equal(contents, tensors)
    assert (contents.ours, contents.note) == (True, {"family": "cmx"})
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


def test_configuration_objects_are_read_as_values(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
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
    paths = [saved(tmp_path, whole, name=f"{old}", legacy=old) for old in (False, True)]
    for name in names:
        monkeypatch.delitem(sys.modules, name)
    for contents in map(read, paths):
        check_equal(contents, state())
        assert contents.settings["cfg.MODEL.FUSION.AGGREGATION"] == "ADD"
        assert contents.settings["args.lr"] == 0.1
    assert not set(names) & set(sys.modules)


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
        "path": Calls(Path.touch, marker),
        "spawn": Calls(os.spawnlp, os.P_WAIT, "touch", "touch", str(marker)),
        "class": Calls(type, "Named", (), {"marker": str(marker)}),
    }


@pytest.mark.parametrize("way", [*attacks(Path("unused"))])
def test_nothing_in_a_file_runs(tmp_path: Path, way: str) -> None:
    """In each of seven places: 105 files."""
    marker, tensors = tmp_path / "marker", {"a": torch.zeros(2)}
    evil = attacks(marker)[way]
    array = np.empty(1, object)
    array[0] = evil
    last = {"model": tensors, "others": {}, "optimizers": {}}
    plain = {"model": tensors, "optimizer": [evil]}
    pickled = tmp_path / "file.pkl"
    pickled.write_bytes(pickle.dumps(plain, 2))
    assert "cannot be read as weights" in refusal(pickled)
    for content, legacy in (
        (plain, False),
        (plain, True),
        ({"state_dict": tensors, "hyper_parameters": argparse.Namespace(cfg=[evil])}, False),
        ({"model": tensors, ("x", evil): 1}, False),
        ({"model": tensors, "b": array}, False),
        ({**last, "state": {"step": evil}}, False),
    ):
        assert "cannot be read as weights" in refusal(saved(tmp_path, content, legacy=legacy))
        assert not marker.exists()


@pytest.mark.filterwarnings("ignore")
def test_other_files_and_archives_are_refused(tmp_path: Path) -> None:
    path = saved(tmp_path, {"a": torch.zeros(1000)})
    with zipfile.ZipFile(tmp_path / "zip.pth", "w") as other:
        other.writestr("readme.txt", "hello")
    with zipfile.ZipFile(path) as source, zipfile.ZipFile(tmp_path / "again.pth", "w") as copy:
        for entry in source.infolist():
            copy.writestr(entry.filename, source.read(entry), zipfile.ZIP_DEFLATED)
    said = {"none.pth": "no such file", ".": "no such file", "again.pth": "compressed"}
    for name, word in {**said, "zip.pth": "cannot be read"}.items():
        assert word in refusal(tmp_path / name)
    for content in (b"", b"text\n", b"version https://git-lfs", bytes(1000)):
        path.write_bytes(content)
        assert "file.pth cannot be read" in refusal(path)


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(
    ("content", "said"),
    [
        ([torch.zeros(1)], "a list"),
        ({"epoch\x1b": 3}, r"its keys are: ['epoch\x1b']"),
        ({"model": state(), "state_dict": state()}, "under ['state_dict', 'model']"),
        (torch.nn.Linear(1, 1), "torch.nn.modules.linear.Linear"),
        ({"a": torch.eye(2).to_sparse()}, "'a' is 2x2 float32"),
        ({"a": torch.zeros(2, device="meta")}, "'a' is 2 float32"),
        ({"a": torch.zeros(2).to(torch.float8_e4m3fn)}, "'a' is 2 float8_e4m3fn"),
    ],
)
def test_what_holds_no_usual_tensors_by_name(tmp_path: Path, content: Any, said: str) -> None:
    assert said in refusal(saved(tmp_path, content))
