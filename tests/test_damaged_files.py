"""Damaged files of every kind that is read: the same value or one sentence, never another value."""

from __future__ import annotations

import re
import resource
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import fields
from pathlib import Path
from typing import Any
from zipfile import ZipFile

import cv2
import numpy as np
import psutil
import pytest

from rgbt.checks import InputError, RunError
from rgbt.config.stored_config import read_settings
from rgbt.data.files import decode, read_names
from rgbt.data.labels import indices
from rgbt.data.pseudo_labels import FORMAT, PseudoLabels
from rgbt.files.plain_files import write_json
from rgbt.metrics.counts import Counts, read_measurement
from rgbt.runs.folder import (
    Description,
    RunFolder,
    read_description,
    read_marker,
    read_provenance,
    read_result,
    read_tables,
)
from rgbt.tables import ClassTable, RegionTable, ResultTables
from tests.damage import damaged
from tests.measured import measurement

HEADROOM = 2**30
"""Bytes that reading a small damaged file may ask for at most."""

RNG = np.random.default_rng(0)
CLASSES = ("background", "car", "person", "bike", "curve")

MEASUREMENT = measurement(
    partition="ring3",
    dataset="0123456789abcdef",
    severity=0.5,
    settings=(("corruption.seed", "1"), ("transform.test_short_edge", "48")),
    changed=("severity",),
    corruption="noise",
    title="Noise",
)


def counts(path: Path) -> None:
    Counts(
        counts=RNG.integers(0, 99, (4, 3, 5, 5)),
        names=tuple("abcd"),
        night=(True, False, True, False),
        classes=CLASSES,
        measurement=MEASUREMENT,
        unscored=("curve",),
    ).save(path)


def picture(channels: int, dtype: str = "uint8") -> np.ndarray:
    """Smooth, as photographs are, with a little noise."""
    rows, columns = np.indices((40, 56))
    waves = (np.sin(rows / 7) + np.cos(columns / 9) + 2)[..., None] / 4
    content = waves * 0.9 + RNG.random((40, 56, channels)) / 20
    return (content * np.iinfo(dtype).max).astype(dtype).squeeze()


def image(channels: int, dtype: str = "uint8") -> Callable[[Path], None]:
    def make(path: Path) -> None:
        assert cv2.imwrite(str(path), picture(channels, dtype))

    return make


def label(path: Path) -> None:
    assert cv2.imwrite(str(path), (np.indices((40, 56)).sum(0) // 8 % 5).astype(np.uint8))


def run_file(path: Path) -> None:
    run = RunFolder(path.parent)
    run.describe(Description("grbm seed=0", {"rgbt.seed": "0"}, {"seed": "0", "scale": "demo"}))
    for step in range(10, 60, 10):
        run.append(step, "train", {"loss": 1 / step, "class/bump": float("nan")})
    classes = ClassTable(("a",), (0.5,), (0.5,), ((0.5,),), {})
    regions = RegionTable("grbm", (0.5,), 0.5, 0.0)
    run.write_tables(ResultTables("test", 50, ("ring_1",), regions, classes))
    run.add_provenance({"command": "a", "git_commit": "0123456789", "diff": "", "cpu_usable": 2})
    run.mark({"names": "0123456789abcdef", "files": "fedcba9876543210"})
    scores = {"val": {"mIoU": 0.25}, "test": {"mIoU": 0.5, "Var": None}}
    run.finish(
        {"name": "grbm", "key": "abc", "dataset": "0123456789abcdef", "best_step": 50, **scores}
    )
    run.write_config("name: grbm\nseed: 0\nmodel:\n  _target_: rgbt.models.mfnet.MFNet\n")


def pseudo(path: Path) -> None:
    folder = path.parent if path.suffix == ".json" else path.parents[1]
    for name, make in {"labels": label, "confidence": image(1, "uint16")}.items():
        (folder / name).mkdir(exist_ok=True)
        make(folder / name / "a.png")
    manifest = {
        "format": FORMAT,
        "teacher": "0123",
        "weights": "ab",
        "network": "cd",
        "view": None,
        "head": None,
        "label_map": None,
        "threshold": 0.9,
        "dataset": "mfnet",
        "fingerprint": "0123",
        "split": "train",
        "classes": list("abcde"),
        "images": 1,
        "skipped": [],
        "kept": 0.5,
        "mean_confidence": 0.7,
        "digest": "ef" * 32,
        "by_class": {name: {"share": 0.2, "mean_confidence": 0.7} for name in "abcde"},
    }
    write_json(folder / "pseudo_labels.json", manifest)


def read_pseudo(path: Path) -> Any:
    labels = PseudoLabels(path.parent if path.suffix == ".json" else path.parents[1])
    return labels.classes, labels.digest, *labels.read("a")


def names(path: Path) -> None:
    path.write_text("".join(f"{n:05d}D\n" for n in range(100)))


KINDS: dict[str, tuple[Callable[[Path], Any], Callable[[Path], Any]]] = {
    # file: what writes it, what reads it
    "counts_test.npz": (counts, Counts.load),
    "measurement.npz": (counts, read_measurement),
    "rgbt.png": (image(4), decode),
    "16_bits.png": (image(1, "uint16"), decode),
    "rgb.jpg": (image(3), decode),
    "label.png": (label, indices(5).read),
    "config.yaml": (run_file, read_settings),
    "metrics.jsonl": (run_file, lambda path: RunFolder(path.parent).lines()),
    "result.json": (run_file, lambda path: read_result(path.parent)),
    "run.json": (run_file, lambda path: read_description(path.parent)),
    "tables.json": (run_file, lambda path: read_tables(path.parent)),
    "dataset.json": (run_file, lambda path: read_marker(path.parent)),
    "provenance.json": (run_file, read_provenance),
    "pseudo_labels.json": (pseudo, read_pseudo),
    "labels/a.png": (pseudo, read_pseudo),
    "confidence/a.png": (pseudo, read_pseudo),
    "train.txt": (names, lambda path: read_names(path, "dataset.splits")),
}
UNSEALED = {"rgb.jpg", "train.txt"}
"""Files without checksums: values may be others of the same form."""
OWN = [name for name in KINDS if name.endswith(("json", "jsonl", "yaml", "npz"))]


def plain(value: Any) -> Any:
    """A value that can be compared: arrays as type, shape and bytes, NaN equal to itself."""
    if isinstance(value, np.ndarray):
        return (value.dtype.str, value.shape, value.tobytes())
    if hasattr(value, "__dataclass_fields__"):
        return {field.name: plain(getattr(value, field.name)) for field in fields(value)}
    if isinstance(value, dict):
        return {key: plain(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [plain(each) for each in value]
    return repr(value)


@contextmanager
def limited(headroom: int) -> Iterator[None]:
    """Fail to allocate more than `headroom` bytes beyond what the process has."""
    before = resource.getrlimit(resource.RLIMIT_AS)
    most = psutil.Process().memory_info().vms + headroom
    resource.setrlimit(resource.RLIMIT_AS, (most, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, before)


def outcome(name: str, path: Path, expected: Any) -> str:
    try:
        value = plain(KINDS[name][1](path))
    except (InputError, RunError) as error:
        return "refused" if str(error).isprintable() else f"unreadable sentence {str(error)!r}"
    except Exception as error:
        return f"{type(error).__name__}: {re.sub(r'[0-9]+', 'N', str(error))[:60]!r}"
    # What follows a cut is gone: a process may be killed while it writes a line.
    is_cut = name == "metrics.jsonl" and value == expected[: len(value)]
    return "fits" if name in UNSEALED or value == expected or is_cut else "other value"


@pytest.mark.parametrize("name", KINDS)
def test_damaged_files_are_refused_or_read_right(name: str, tmp_path: Path) -> None:
    make, read = KINDS[name]
    path = tmp_path / name
    path.parent.mkdir(exist_ok=True)
    make(path)
    content, expected = path.read_bytes(), plain(read(path))
    wrong: dict[str, str] = {}
    with limited(HEADROOM):
        for variant, changed in damaged(content, 50):
            path.write_bytes(changed)
            wrong.setdefault(outcome(name, path, expected), variant)
    assert set(wrong) <= {"fits", "refused"}, wrong


def bytes_read(path: Path) -> tuple[int, int]:
    """The first and the last byte of what is read of a file."""
    if path.name != "measurement.npz":
        return 0, path.stat().st_size - 1
    with ZipFile(path) as archive:
        member = archive.getinfo("measurement.npy")
    return member.header_offset, member.header_offset + member.compress_size


@pytest.mark.parametrize("name", OWN)
def test_one_changed_byte_of_an_own_file_never_gives_another_value(
    name: str, tmp_path: Path
) -> None:
    make, read = KINDS[name]
    path = tmp_path / name
    make(path)
    content, expected = path.read_bytes(), plain(read(path))
    wrong, refused = [], 0
    for place in np.linspace(*bytes_read(path), 200).astype(int):
        for byte in {content[place] ^ 1, content[place] ^ 32, ord("\n"), ord("?")}:
            path.write_bytes(content[:place] + bytes([byte]) + content[place + 1 :])
            try:
                found = plain(read(path))
            except InputError:
                refused += 1
            else:
                wrong += [(place, chr(byte))] if found != expected else []
    assert (wrong, refused > 200) == ([], True)
