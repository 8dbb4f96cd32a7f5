"""Containers: what is read, what is refused, and that nothing in a file ever runs."""

from __future__ import annotations

import argparse
import builtins
import functools
import io
import os
import pickle
import re
import runpy
import struct
import subprocess
import tarfile
import zipfile
from collections import Counter, OrderedDict, defaultdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from rgbt.checkpoints.read import Contents, read
from rgbt.checks import InputError
from rgbt.randomness import numpy_generator
from tests.checkpoints.files import saved, sentence
from tests.models.golden import SHARED

PROTOCOLS = range(pickle.HIGHEST_PROTOCOL + 1)


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


def written(path: Path, content: bytes) -> Path:
    path.write_bytes(content)
    return path


def check_equal(contents: Contents, expected: dict[str, Any]) -> None:
    assert contents.tensors.keys() == expected.keys()
    for name, value in expected.items():
        found, wanted = contents.tensors[name], torch.as_tensor(value)
        assert found.dtype == wanted.dtype, name
        assert torch.equal(found, wanted), name


@pytest.mark.parametrize("legacy", [False, True])
@pytest.mark.parametrize("wrapper", ["", "state_dict", "model", "module"])
def test_torch_files_give_what_torch_gives(tmp_path: Path, legacy: bool, wrapper: str) -> None:
    content = {wrapper: state(), "epoch": 3} if wrapper else state()
    contents = read(saved(tmp_path, content, legacy=legacy))
    check_equal(contents, state())
    assert contents.where == wrapper
    assert contents.others == (("epoch",) if wrapper else ())


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_plain_pickles_of_arrays_and_of_tensors(tmp_path: Path, protocol: int) -> None:
    arrays = {
        "float": np.arange(6, dtype=np.float32).reshape(2, 3),
        "fortran": np.asfortranarray(np.arange(6, dtype=np.float32).reshape(2, 3)),
        "big_endian": np.arange(3, dtype=">f8"),
        "bytes": np.array([0, 255], np.uint8),
        "none": np.zeros((0, 2), np.int64),
    }
    content = {"model": arrays, "__author__": "third_party", "matching_heuristics": True}
    expected = {k: v.astype(v.dtype.newbyteorder("=")) for k, v in arrays.items()}
    path = written(tmp_path / "arrays.pkl", pickle.dumps(content, protocol))
    check_equal(read(path), expected)
    path = written(tmp_path / "tensors.pkl", pickle.dumps({"model": state()}, protocol))
    check_equal(read(path), state())


def test_python_2_pickles(tmp_path: Path) -> None:
    """Written by hand: text is bytes there, and the class of dictionaries has another module."""
    values = np.array([1.0, -2.5], np.float32).tobytes()
    content = (
        b"\x80\x02}U\x05modelccollections\nOrderedDict\n)R(U\x01a"
        b"cnumpy.core.multiarray\n_reconstruct\ncnumpy\nndarray\nK\x00\x85U\x01b\x87R"
        b"(K\x01K\x02\x85cnumpy\ndtype\nU\x02f4K\x00K\x01\x87R"
        b"(K\x03U\x01<NNNJ\xff\xff\xff\xffJ\xff\xff\xff\xffK\x00tb\x89"
        b"U\x08" + values + b"tbus."
    )
    check_equal(read(written(tmp_path / "a.pkl", content)), {"a": torch.tensor([1.0, -2.5])})


def test_storages_that_are_views_of_others(tmp_path: Path) -> None:
    """Files from before 0.4 may name a part of a storage; made from today's form by hand."""
    path = saved(tmp_path, OrderedDict(a=torch.arange(5.0)), legacy=True)
    content = path.read_bytes()
    assert content.count(b"K\x05Ntq") == 1
    path.write_bytes(content.replace(b"K\x05Ntq", b"K\x05X\x01\0\0\0vK\x02K\x03\x87tq"))
    with pytest.raises(InputError, match="truncated"):
        read(path)  # the tensor has five numbers, the view three
    replaced = path.read_bytes().replace(b"K\x05\x85q", b"K\x03\x85q")
    path.write_bytes(replaced)
    check_equal(read(path), {"a": torch.tensor([2.0, 3.0, 4.0])})


def test_safetensors(tmp_path: Path) -> None:
    from safetensors.torch import save_file

    tensors = {"a": torch.arange(6.0).reshape(2, 3), "b": torch.tensor([1, 2])}
    save_file(tensors, tmp_path / "a.safetensors", metadata={"rgbt.family": "cmx"})
    contents = read(tmp_path / "a.safetensors")
    check_equal(contents, tensors)
    assert contents.ours
    assert contents.note == {"family": "cmx"}


def test_wrappers_of_names_are_taken_off(tmp_path: Path) -> None:
    content = {"module._orig_mod.a": torch.zeros(1), "module._orig_mod.module.b": torch.ones(1)}
    contents = read(saved(tmp_path, content))
    assert set(contents.tensors) == {"a", "module.b"}
    assert contents.prefix == "module._orig_mod."


def test_writing_to_a_tensor_leaves_the_file_alone(tmp_path: Path) -> None:
    path = saved(tmp_path, {"a": torch.zeros(4)})
    before = path.read_bytes()
    read(path).tensors["a"].fill_(1)
    assert path.read_bytes() == before


OTHER_VALUES = [
    *(np.float64(0.5), {1, 2}, frozenset({"a"}), b"", b"\xff", bytearray(b"x"), 2**70, -1.5),
    *(Counter({30: 1}), defaultdict(list, a=[1]), torch.Size([2, 3]), torch.device("cpu")),
    *(torch.float16, (1, (2, None)), True, Path("a/b"), np.array([1, 2])),
]
"""What else trainings put beside their weights."""


class CfgNode(dict):  # type: ignore[type-arg]
    """Stands for a configuration class that is not installed here."""


@pytest.mark.parametrize("legacy", [False, True])
def test_configuration_objects_are_read_as_values(
    tmp_path: Path, legacy: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    import sys
    from types import ModuleType

    module = ModuleType("detectron2.config.config")
    module.CfgNode = CfgNode  # type: ignore[attr-defined]
    for name in ("detectron2", "detectron2.config", "detectron2.config.config"):
        monkeypatch.setitem(sys.modules, name, module)
    monkeypatch.setattr(CfgNode, "__module__", "detectron2.config.config")
    inner = CfgNode(FUSION=CfgNode(AGGREGATION="ADD"), DEPTHS=[2, 2])
    inner.__dict__["__immutable__"] = True
    hyper = {"cfg": CfgNode(MODEL=inner), "args": argparse.Namespace(lr=0.1)}
    path = saved(
        tmp_path,
        {"state_dict": state(), "hyper_parameters": hyper, "epoch": 1, "others": OTHER_VALUES},
        legacy=legacy,
    )
    for name in ("detectron2", "detectron2.config", "detectron2.config.config"):
        monkeypatch.delitem(sys.modules, name)
    contents = read(path)
    check_equal(contents, state())
    assert contents.settings["cfg.MODEL.FUSION.AGGREGATION"] == "ADD"
    assert contents.settings["args.lr"] == 0.1


def test_released_file_of_torch_0_4_gives_what_torch_gives() -> None:
    path = SHARED / "realdata/mfnet_weights/final.pth"
    if not path.exists():
        pytest.skip("reference material is not here")
    expected = torch.load(path, map_location="cpu", weights_only=True)
    check_equal(read(path), expected)


class Calls:
    """Pickled as a call of something."""

    def __init__(self, function: Any, *arguments: Any) -> None:
        self.call = function, arguments

    def __reduce__(self) -> Any:
        return self.call


def attacks(marker: Path) -> dict[str, tuple[Any, str]]:
    """Objects whose unpickling would write the marker file, and what is refused of each."""
    opening = f"open({str(marker)!r}, 'w').close()"
    return {
        "system": (Calls(os.system, f"touch {marker}"), ".system"),
        "eval": (Calls(eval, opening), ".eval"),
        "exec": (Calls(exec, opening), ".exec"),
        "open": (Calls(builtins.open, str(marker), "w"), ".open"),
        "process": (Calls(subprocess.check_output, ["touch", str(marker)]), ".check_output"),
        "module": (Calls(runpy.run_path, str(marker)), ".run_path"),
        "chain": (Calls(getattr, Calls(__import__, "os"), "system"), ".getattr"),
        "numpy": (Calls(np.testing._private.utils.runstring, opening, {}), ".runstring"),
        "torch": (Calls(torch.load, str(marker)), ".load"),
        "partial": (functools.partial(os.system, f"touch {marker}"), ".partial"),
    }


WAYS = [*attacks(Path("unused"))]


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize(
    "container", ["zip", "legacy", "pickle", "nested", "hyper_parameters", "key", "array"]
)
def test_nothing_in_a_file_runs(tmp_path: Path, way: str, container: str) -> None:
    marker = tmp_path / "marker"
    evil, name = attacks(marker)[way]
    path = _with(evil, container, tmp_path)
    with pytest.raises(InputError) as error:
        read(path)
    if container == "array":
        assert "an array whose elements are not plain numbers" in sentence(error)
    else:
        assert re.search(rf"refers to \w+(\.\w+)*{name}, which would execute code", sentence(error))
    assert not marker.exists()


def _with(evil: object, container: str, folder: Path) -> Path:
    tensors = {"a": torch.zeros(2)}
    if container == "pickle":
        content = pickle.dumps({"model": {**tensors, "b": evil}})
        return written(folder / "file.pkl", content)
    if container == "nested":  # in the file that a plain pickle holds for a tensor's numbers
        inner = io.BytesIO()
        torch.save(evil, inner, _use_new_zipfile_serialization=False)
        content = pickle.dumps(
            {"model": {"b": Calls(torch.storage._load_from_bytes, inner.getvalue())}}
        )
        return written(folder / "file.pkl", content)
    if container == "array":
        array = np.empty(1, object)
        array[0] = evil
        return written(folder / "file.pkl", pickle.dumps({"model": {"b": array}}))
    if container == "hyper_parameters":
        whole = {"state_dict": tensors, "hyper_parameters": argparse.Namespace(cfg=[evil])}
        return saved(folder, whole)
    if container == "key":
        return saved(folder, {"model": tensors, ("x", evil): 1})
    return saved(folder, {"model": tensors, "optimizer": [evil]}, legacy=container == "legacy")


MARKER = b"touch MARKER"
RAW = {
    "a stand-in that is given a method": (
        b"\x80\x02cargparse\nNamespace\n)\x81}U\x0a__reduce__cposix\nsystem\nsb.",
        "posix.system",
    ),
    "the state of a stand-in's class": (
        b"\x80\x02cargparse\nNamespace\nN}U\x01xU\x01ys\x86b.",
        "truncated",
    ),
    "a call of a stand-in's object": (
        b"\x80\x02cargparse\nNamespace\n)\x81U\x01x\x85R.",
        "truncated",
    ),
    "a call of text": (b"\x80\x02U\x02os)R.", "truncated"),
    "system looked up and called": (
        b"\x80\x02c__builtin__\ngetattr\ncos\n__dict__\nU\x06system\x86RU\x0ctouch MARKER\x85R.",
        "__builtin__.getattr",
    ),
    "instance of protocol 0": (b"(S'touch MARKER'\nios\nsystem\n.", "os.system"),
    "object of protocol 1": (b"\x80\x01(cos\nsystem\nU\x0ctouch MARKERo.", "os.system"),
    "new object": (b"\x80\x02cos\nsystem\nU\x0ctouch MARKER\x85\x81.", "os.system"),
    "name in two parts": (
        b"\x80\x04\x8c\x02os\x8c\x06system\x93\x8c\x0ctouch MARKER\x85R.",
        "os.system",
    ),
    "path behind a known module": (
        b"\x80\x04\x8c\x05torch\x8c\x17serialization.os.system\x93\x8c\x0ctouch MARKER\x85R.",
        "torch.serialization.os.system",
    ),
    "a name that is no text": (b"\x80\x04]\x8c\x06system\x93.", "truncated"),
    "registered class": (b"\x80\x02\x82\xf1U\x0ctouch MARKER\x85R.", "truncated"),
    "state of a function": (
        b"\x80\x02ctorch._utils\n_rebuild_tensor_v2\nN}U\x08__code__U\x01xs\x86b.",
        "truncated",
    ),
    "state of a list": (b"\x80\x02]}U\x01xU\x01ysb.", "truncated"),
    "known name that may not be called": (
        b"\x80\x02ctorch\nFloatStorage\nK\x05\x85R.",
        "FloatStorage",
    ),
    "something outside": (b"\x80\x02U\x01xQ.", "truncated"),
    "buffer outside": (b"\x80\x05\x97.", "truncated"),
    "memory without end": (b"\x80\x04\x8e\xff\xff\xff\xff\xff\xff\xff\x7fx.", "truncated"),
    "memo far away": (b"\x80\x02Nr\xff\xff\xff\x7f.", "holds a NoneType"),
    "many bytes": (b"\x80\x02cbuiltins\nbytearray\nJ\xff\xff\xff\x7f\x85R.", "truncated"),
    "call with keywords": (b"\x80\x04cargparse\nNamespace\n)}\x92.", "truncated"),
    "state of a storage's class": (b"\x80\x02ctorch\nFloatStorage\n}b.", "truncated"),
    "element of a tensor": (
        b"\x80\x02cnumpy.core.multiarray\n_reconstruct\n)RK\x00K\x01s.",
        "truncated",
    ),
    "bytes without end": (b"\x80\x05\x96" + b"\xff" * 7 + b"\x00.", "truncated"),
    "unhashable key": (b"\x80\x02}]U\x01xs.", "truncated"),
}


@pytest.mark.parametrize("way", RAW)
def test_handwritten_attacks(tmp_path: Path, way: str, monkeypatch: pytest.MonkeyPatch) -> None:
    import copyreg

    monkeypatch.chdir(tmp_path)
    content, said = RAW[way]
    path = written(tmp_path / "file.pkl", content)
    copyreg.add_extension("os", "system", 241)
    try:
        with pytest.raises(InputError) as error:
            read(path)
    finally:
        copyreg.remove_extension("os", "system", 241)
    assert said in sentence(error)
    assert not (tmp_path / "MARKER").exists()


DEEP = b"K\x00\x85" + b"2\x86" * 60
"""t = (t, t), sixty times: 2^60 steps to hash, and as many to print."""

KEYS = {
    "SETITEM": b"}" + DEEP + b"Ns.",
    "SETITEMS": b"}(" + DEEP + b"Nu.",
    "DICT": b"(" + DEEP + b"Nd.",
    "ADDITEMS": b"\x8f(" + DEEP + b"\x90.",
    "FROZENSET": b"(" + DEEP + b"\x91.",
    "set": b"c__builtin__\nset\n]" + DEEP + b"a\x85R.",
    "ordered": b"ccollections\nOrderedDict\n]" + DEEP + b"N\x86a\x85R.",
}


@pytest.mark.parametrize("way", KEYS)
def test_a_key_whose_hash_would_take_for_ever(tmp_path: Path, way: str) -> None:
    with pytest.raises(InputError, match="truncated"):
        read(written(tmp_path / "file.pkl", b"\x80\x04" + KEYS[way]))


def copies(times: int) -> bytes:
    """A pickle of one list of 10,000 numbers that is made a torch.Size again and again."""
    start = b"\x80\x02]q\x00(" + b"K\x01" * 10_000 + b"ectorch\nSize\nq\x01"
    return start + b"h\x01h\x00\x85R0" * times + b"."


def test_a_small_file_that_would_take_much_memory(tmp_path: Path) -> None:
    path = written(tmp_path / "greedy.pkl", copies(2000))
    with pytest.raises(InputError, match="far more memory than its size") as refused:
        read(path)
    sentence(refused)
    nested: Any = "x"
    for _ in range(40):
        nested = [nested, nested]
    path = saved(tmp_path, {"model": {"a": torch.zeros(1)}, "rgbt": {"note": nested}})
    assert read(path).note == {}


def test_an_array_of_many_names_is_copied_once(tmp_path: Path) -> None:
    array = np.ones(1000, np.float32)
    path = written(tmp_path / "many.pkl", pickle.dumps({"a": array, "b": array}))
    tensors = read(path).tensors
    assert tensors["a"].data_ptr() == tensors["b"].data_ptr()


OTHERS = {
    "empty": (b"", "is empty"),
    "text": (b"weights are on the shared drive\n", "not a file of weights"),
    "web page": (b"\n<!DOCTYPE html><html>quota exceeded</html>", "web page"),
    "LFS pointer": (b"version https://git-lfs.github.com/spec/v1\noid sha256:0\n", "Git LFS"),
    "gzip": (b"\x1f\x8b\x08\x00" + bytes(20), "compressed"),
    "zeros": (bytes(1000), "not a file of weights"),
}


@pytest.mark.parametrize("kind", OTHERS)
def test_other_files_are_named(tmp_path: Path, kind: str) -> None:
    content, said = OTHERS[kind]
    with pytest.raises(InputError) as error:
        read(written(tmp_path / "file.pth", content))
    assert said in sentence(error)
    assert "file.pth" in sentence(error)


@pytest.mark.filterwarnings("ignore")
def test_missing_files_folders_and_archives(tmp_path: Path) -> None:
    with tarfile.open(tmp_path / "tar.pth", "w", format=tarfile.USTAR_FORMAT) as archive:
        archive.addfile(tarfile.TarInfo("storages"))
    with zipfile.ZipFile(tmp_path / "zip.pth", "w") as other:
        other.writestr("readme.txt", "hello")
    path = saved(tmp_path, {"a": torch.zeros(1000)})
    with zipfile.ZipFile(path) as source, zipfile.ZipFile(tmp_path / "again.pth", "w") as copy:
        for entry in source.infolist():
            copy.writestr(entry.filename, source.read(entry), zipfile.ZIP_DEFLATED)
    torch.jit.save(torch.jit.script(torch.nn.Linear(1, 1)), str(tmp_path / "program.pt"))
    said = {
        **{"none.pth": "does not exist", ".": "is a folder", "tar.pth": "tar archive"},
        **{"zip.pth": "zip archive", "again.pth": "compression", "program.pt": "TorchScript"},
    }
    for name, word in said.items():
        with pytest.raises(InputError, match=word):
            read(tmp_path / name)


def test_what_holds_no_tensors_by_name(tmp_path: Path) -> None:
    cases = {
        "one tensor": torch.zeros(1),
        "a list": [torch.zeros(1)],
        "its keys are: epoch": {"epoch": 3},
        "its keys are: none": {},
        "under state_dict and model": {"model": state(), "state_dict": state()},
        "refers to torch.nn.modules.linear.Linear": torch.nn.Linear(1, 1),
    }
    for said, content in cases.items():
        with pytest.raises(InputError) as error:
            read(saved(tmp_path, content))
        assert said in sentence(error)


def containers(folder: Path) -> dict[str, Path]:
    """The same small tensors in every container."""
    from safetensors.torch import save_file

    tensors = {"a": torch.arange(6.0).reshape(2, 3), "b": torch.tensor([1, 2])}
    save_file(tensors, folder / "f.safetensors")
    arrays = {name: value.numpy() for name, value in tensors.items()}
    return {
        "zip": saved(folder, {"model": tensors}, name="zip.pth"),
        "legacy": saved(folder, {"model": tensors}, name="legacy.pth", legacy=True),
        "arrays": written(folder / "arrays.pkl", pickle.dumps({"model": arrays})),
        "tensors": written(folder / "tensors.pkl", pickle.dumps({"model": tensors})),
        "safetensors": folder / "f.safetensors",
    }


@pytest.mark.parametrize("kind", ["zip", "legacy", "arrays", "tensors", "safetensors"])
def test_damaged_bytes_are_read_or_refused(tmp_path: Path, kind: str) -> None:
    """Whatever stands in a file, only the one kind of error comes out of it."""
    path = containers(tmp_path)[kind]
    content = path.read_bytes()
    for share in (0.02, 0.1, 0.3, 0.5, 0.7, 0.9, 0.99):
        path.write_bytes(content[: int(share * len(content))])
        with pytest.raises(InputError) as error:
            read(path)
        sentence(error)
    rng = numpy_generator(0, kind)
    refused = 0
    for _ in range(200):
        damaged = bytearray(content)
        for place in rng.integers(0, len(content), rng.integers(1, 4)):
            damaged[place] = rng.integers(0, 256)
        path.write_bytes(damaged)
        try:
            for tensor in read(path).tensors.values():
                tensor.sum()
        except InputError:
            refused += 1
    assert 20 < refused <= 200


def test_tensors_outside_their_storage(tmp_path: Path) -> None:
    """Sizes that promise more than there is are refused, not read."""
    path = saved(tmp_path, {"a": torch.arange(5.0)}, legacy=True)
    content = path.read_bytes()
    for before, after in [
        (b"K\x05\x85q", b"K\x06\x85q"),  # six numbers of five
        (struct.pack("<q", 5), struct.pack("<q", 4)),  # another length in front of the numbers
        (b"K\x05Ntq", b"J\xff\xff\xff\x7fNtq"),  # 2^31 numbers
    ]:
        assert content.count(before) == 1
        path.write_bytes(content.replace(before, after))
        with pytest.raises(InputError, match="truncated"):
            read(path)


@pytest.mark.parametrize("count", [6, 2**31 - 1])
def test_storages_longer_than_their_entry(tmp_path: Path, count: int) -> None:
    path = saved(tmp_path, OrderedDict(a=torch.arange(5.0)))
    with zipfile.ZipFile(path) as archive:
        entries = {name: archive.read(name) for name in archive.namelist()}
    number = b"J" + struct.pack("<i", count)
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in entries.items():
            longer = content.replace(b"K\x05tq", number + b"tq").replace(
                b"K\x05\x85q", number + b"\x85q"
            )
            archive.writestr(name, longer if name.endswith("data.pkl") else content)
    with pytest.raises(InputError, match="truncated"):
        read(path)
