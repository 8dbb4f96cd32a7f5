"""True second frames: where points were, and what a folder of them must hold."""

from __future__ import annotations

import io
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from rgbt.checks import InputError
from rgbt.data.mfnet import MFNet
from rgbt.data.next_frames import NextFrames
from rgbt.synth.datasets import synth
from tests.conftest import write_data

HW = (6, 8)
NAMES = ("00001D", "00002N")
CLASSES = ("unlabeled", "car", "person", "bike", "curve", "stop", "rail", "cone", "bump")


def reader(root: Path) -> MFNet:
    return MFNet(
        str(root),
        name="mf",
        num_classes=9,
        classes=CLASSES,
        palette=tuple((n, n, n) for n in range(9)),
        splits={"test": "test.txt"},
        layout="auto",
    )


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


def test_flow_of_synth_leads_to_same_class(tmp_path: Path) -> None:
    sizes = {"num_train": 1, "num_val": 1, "num_test": 3, "height": 48, "width": 64}
    first = synth(cache_dir=str(tmp_path), **sizes, ego_forward_m=0.5, ego_yaw_deg=2.0)
    after = NextFrames(first)
    same = seen = 0
    for name in first.names("test"):
        rows, columns = after.source(name, (48, 64))
        shown = rows >= 0
        before, now = first.read(name).label, after.dataset.read(name).label
        same += (before[rows[shown], columns[shown]] == now[shown]).sum()
        seen += shown.sum()
    assert 0.6 * 3 * 48 * 64 < seen < 3 * 48 * 64
    assert same / seen > 0.97  # the rest lies on outlines, half a pixel away


# ---- what is refused ------------------------------------------------------------------------


def test_data_set_of_single_frames_is_refused(tmp_path: Path) -> None:
    write_data(tmp_path / "mf", {"test": list(NAMES)}, HW)
    with pytest.raises(InputError, match="mf .* has no second frames: expected the folder next/"):
        NextFrames(reader(tmp_path / "mf"))
    (tmp_path / "mf" / "next").mkdir()
    with pytest.raises(InputError, match="has no second frames"):
        NextFrames(reader(tmp_path / "mf"))


def moved(place: tuple[int, int], by: tuple[float, float]) -> np.ndarray:
    flow = still()
    flow[place] = by
    return flow


def saved(flow: np.ndarray, write: Callable[..., None] = np.save) -> bytes:
    file = io.BytesIO()
    write(file, flow)
    return file.getvalue()


SPOILED: dict[str, tuple[bytes | None, str]] = {
    "too small": (saved(still()[:, :7]), "must be an array of 6 x 8 x 2 .* got 6 x 7 x 2"),
    "one channel": (saved(still()[..., 0]), "must be an array of 6 x 8 x 2"),
    "above the image": (saved(moved((0, 0), (-1, 0))), "points outside the first frame of 6x8"),
    "below the image": (saved(moved((5, 7), (0.6, 0))), "points outside the first frame"),
    "missing": (None, "is missing"),
    "truncated": (saved(still())[:100], "cannot be read"),
    "empty": (b"", "cannot be read"),
    "pickled": (saved(np.array([{}], object)), "cannot be read"),
    "archive": (saved(still(), np.savez), "flow"),
    "broken archive": (b"PK\x03\x04" + b"0" * 40, "flow"),
    "words": (saved(np.full((*HW, 2), "far")), "flow"),
}


@pytest.mark.parametrize("what", SPOILED)
def test_invalid_flow_is_refused(root: Path, what: str) -> None:
    content, sentence = SPOILED[what]
    path = root / "next" / "flow" / f"{NAMES[0]}.npy"
    path.unlink()
    if content is not None:
        path.write_bytes(content)
    after = NextFrames(reader(root))
    with pytest.raises(InputError, match=sentence) as raised:
        after.source(NAMES[0], HW)
    assert path.name in str(raised.value)
    assert after.source(NAMES[1], HW)[0].min() == 0
