"""True second frames: where points were, and what a folder of them must hold."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pytest

from rgbt.checks import InputError
from rgbt.data.mfnet import MFNet, NextFrames
from tests.conftest import write_data

HW = (6, 8)
NAMES = ("00001D", "00002N")


def reader(root: Path) -> MFNet:
    return MFNet(str(root), name="mf", splits={"test": "test.txt"})


def still() -> np.ndarray:
    return np.zeros((*HW, 2), np.float32)


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """Two frames that stand still."""
    for folder in (tmp_path / "mf", tmp_path / "mf" / "next"):
        write_data(folder, {"test": list(NAMES)}, HW)
    (tmp_path / "mf" / "next" / "flow").mkdir()
    for name in NAMES:
        save(tmp_path / "mf", name, still())
    return tmp_path / "mf"


def save(root: Path, name: str, flow: np.ndarray) -> None:
    np.save(root / "next" / "flow" / f"{name}.npy", flow)


def test_second_frames_are_read_like_first(root: Path) -> None:
    first = reader(root)
    after = NextFrames(first)
    assert after.dataset.root == root / "next"
    assert after.dataset.names("test") == first.names("test") == NAMES
    assert after.dataset.classes == first.classes
    assert after.dataset.read(NAMES[0]).label.shape == HW


def test_flow_without_motion_is_identity(root: Path) -> None:
    rows, columns = NextFrames(reader(root)).source(NAMES[0], HW)
    assert rows.dtype == columns.dtype == np.int64
    expected = np.mgrid[:6, :8]
    assert np.array_equal(rows, expected[0])
    assert np.array_equal(columns, expected[1])


def test_flow_is_rows_columns_to_nearest_pixel(root: Path) -> None:
    flow = still()
    flow[2, 3] = (1.4, -2.6)  # (3.4, 0.4): row 3, column 0
    flow[5, 7] = (0.4, 0.4)
    flow[0, 0] = np.nan  # hidden
    flow[0, 1] = (np.nan, 0)
    flow[0, 2] = (0, np.inf)
    save(root, NAMES[0], flow)
    rows, columns = NextFrames(reader(root)).source(NAMES[0], HW)
    assert (rows[2, 3], columns[2, 3]) == (3, 0)
    assert (rows[5, 7], columns[5, 7]) == (5, 7)
    assert rows[0, :3].tolist() == columns[0, :3].tolist() == [-1] * 3
    assert (rows == -1).sum() == 3


def saved(flow: np.ndarray) -> bytes:
    file = io.BytesIO()
    np.save(file, flow)
    return file.getvalue()


def moved(place: tuple[int, int], by: tuple[float, float]) -> bytes:
    flow = still()
    flow[place] = by
    return saved(flow)


INVALID: dict[str, tuple[bytes, str]] = {
    "too small": (saved(still()[:, :7]), r"shape \(6, 8, 2\) .* got float32 of shape \(6, 7, 2\)"),
    "above the image": (moved((0, 0), (-1, 0)), "points outside the first frame of 6x8"),
    "below the image": (moved((5, 7), (0.6, 0)), "points outside the first frame"),
    "truncated": (saved(still())[:100], "cannot be read"),
    "pickled": (saved(np.array([{}], object)), "cannot be read"),
    "words": (saved(np.full((*HW, 2), "far")), "expected real numbers"),
}


@pytest.mark.parametrize("what", INVALID)
def test_invalid_flow_is_refused(root: Path, what: str) -> None:
    content, sentence = INVALID[what]
    path = root / "next" / "flow" / f"{NAMES[0]}.npy"
    path.write_bytes(content)
    after = NextFrames(reader(root))
    with pytest.raises(InputError, match=sentence) as raised:
        after.source(NAMES[0], HW)
    assert path.name in str(raised.value)
    assert after.source(NAMES[1], HW)[0].min() == 0


def test_data_set_of_single_frames_is_refused(tmp_path: Path) -> None:
    write_data(tmp_path / "mf", {"test": list(NAMES)}, HW)
    with pytest.raises(InputError, match="mf .* has no second frames: expected MFNet's layout"):
        NextFrames(reader(tmp_path / "mf"))
