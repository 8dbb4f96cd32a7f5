"""The published sets of angles, and a user's own files."""

from __future__ import annotations

import hashlib
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from rgbt.checks import InputError
from rgbt.requirements import Record
from rgbt.transforms.view_sets import ViewSets, read_angles
from tests.transforms.test_virtual_view import CAMERA, released

# The first digits of the SHA-256 of each list as the release writes it, and its column means.
PUBLISHED = {
    "released_1": ("dfeb6588", (-0.043, -0.491, -0.341), 380),
    "released_2": ("65f7993c", (-0.239, 0.140, -0.445), 374),
    "released_3": ("65943e37", (-0.346, -0.165, -0.316), 373),
}


@pytest.mark.parametrize("name", PUBLISHED)
def test_published_sets_are_those_of_the_release(name: str) -> None:
    digest, means, distinct = PUBLISHED[name]
    found = read_angles(name)
    assert found.shape == (393, 3)
    assert found.dtype == torch.float64
    text = "\n".join(",".join(f"{value:.1f}" for value in row) for row in found.tolist())
    assert hashlib.sha256(text.encode()).hexdigest().startswith(digest)
    assert found.mean(0).tolist() == pytest.approx(means, abs=5e-4)
    assert len({tuple(row) for row in found.tolist()}) == distinct
    assert torch.equal(found, found.floor())
    assert found.min(0).values.tolist() == [-10, -10, -5]
    assert found.max(0).values.tolist() == [9, 9, 4]


def test_every_published_view_keeps_what_the_release_keeps() -> None:
    view = released()
    triples = torch.cat([read_angles(name) for name in PUBLISHED])
    left, top, right, bottom = view.warp(triples, (480, 640)).rectangle.unbind(1)
    width, height = right - left, bottom - top
    assert (width.min(), width.max()) == (482, 632)
    assert (height.min(), height.max()) == (320, 476)
    assert float(width.mean()) == pytest.approx(556, abs=0.5)
    assert float(height.mean()) == pytest.approx(398, abs=0.5)
    assert float((width * height).mean()) / (480 * 640) == pytest.approx(0.72, abs=0.005)


def sets(*names: str) -> ViewSets:
    return ViewSets(view=released(), sets=names, splits=("test",))


def test_the_kth_image_has_the_kth_triple_and_long_lists_begin_again() -> None:
    views, triples = sets("released_1", "released_3"), read_angles("released_3")
    found = views.angles(1, [5, 0, 392, 393, 398])
    assert torch.equal(found, triples[[5, 0, 392, 0, 5]])
    assert not torch.equal(views.angles(0, [5]), views.angles(1, [5]))
    assert views.angles(0, [0]).tolist() == [[4, 7, 1]]


def test_no_sets_are_none() -> None:
    assert sets().sets == ()


@pytest.mark.parametrize(
    "text",
    [
        "yaw,pitch,roll\n1.5,-2,3\n0,0,0\n",
        "yaw,pitch,roll\r\n1.5,-2,3\r\n0,0,0",
        "\ufeffyaw,pitch,roll\n\n1.5,-2,3\n\n0,0,0\n\n",
    ],
)
def test_a_file_of_ones_own(tmp_path: Path, text: str) -> None:
    path = tmp_path / "mine.csv"
    path.write_bytes(text.encode())
    assert read_angles(str(path)).tolist() == [[1.5, -2, 3], [0, 0, 0]]
    assert sets(str(path)).angles(0, [2]).tolist() == [[1.5, -2, 3]]


def test_the_mark_tells_views_apart_by_what_they_show(tmp_path: Path) -> None:
    assert sets(*PUBLISHED).mark == ""
    copies = [tmp_path / f"{name}.csv" for name in PUBLISHED]
    for path in copies:
        rows = [",".join(map(str, row)) for row in read_angles(path.stem).tolist()]
        path.write_text("\n".join(["yaw,pitch,roll", *rows]))
    assert sets(*map(str, copies)).mark == ""
    marks = {
        sets("released_1").mark,
        sets(*reversed(PUBLISHED)).mark,
        *(
            ViewSets(view=view, sets=tuple(PUBLISHED), splits=("test",)).mark
            for view in OTHER_VIEWS
        ),
    }
    assert len(marks) == 2 + len(OTHER_VIEWS)
    assert all(len(mark) == 6 for mark in marks)
    narrow = released(yaw=(-9.0, 3.0))  # nothing is drawn
    assert ViewSets(view=narrow, sets=tuple(PUBLISHED), splits=("test",)).mark == ""


OTHER_VIEWS = (
    released(order="zyx"),
    released(rectangle="largest"),
    released(resampling="once"),
    released(mode="rotation"),
    released(outside="ignore"),
    released(camera=replace(CAMERA, fx=500.0)),
)

BROKEN = {
    "empty": (b"", "must begin with the line 'yaw,pitch,roll'"),
    "no triple": (b"yaw,pitch,roll\n", "got 'yaw,pitch,roll' and 0 lines"),
    "no header": (b"1,2,3\n", "must begin with the line 'yaw,pitch,roll'"),
    "other header": (b"roll,pitch,yaw\n1,2,3\n", "must begin with the line 'yaw,pitch,roll'"),
    "two values": (b"yaw,pitch,roll\n1,2\n", "expected yaw,pitch,roll in degrees, got '1,2'"),
    "four values": (b"yaw,pitch,roll\n1,2,3,4\n", "expected yaw,pitch,roll in degrees"),
    "a word": (b"yaw,pitch,roll\n1,2,x\n", "expected yaw,pitch,roll in degrees, got '1,2,x'"),
    "no number": (b"yaw,pitch,roll\n1,2,nan\n", "expected yaw,pitch,roll .* got '1,2,nan'"),
    "endless": (b"yaw,pitch,roll\n0,0,0\ninf,2,3\n", "expected yaw,pitch,roll .* got 'inf,2,3'"),
    "too steep": (b"yaw,pitch,roll\n0,0,0\n80,2,3\n", "yaw 80, pitch 2, roll 3 degrees leave no"),
    "is not UTF-8 text": (b"\xff\xfe\x00\x01" * 9, "consistency.sets"),
    "another encoding": ("yaw,pitch,roll\n1,2,3\n".encode("utf-16"), "consistency.sets"),
}


@pytest.mark.parametrize(("content", "sentence"), BROKEN.values(), ids=BROKEN)
def test_broken_files_are_named(tmp_path: Path, content: bytes, sentence: str) -> None:
    path = tmp_path / "mine.csv"
    path.write_bytes(content)
    with pytest.raises(InputError, match=sentence) as raised:
        sets(str(path))
    assert str(path) in str(raised.value)


def test_sets_without_a_split_to_measure_are_refused() -> None:
    with pytest.raises(InputError, match=r"consistency\.splits is empty, .* consistency=none"):
        ViewSets(view=released(), sets=("released_1",), splits=())
    assert ViewSets(view=released(), sets=(), splits=()).sets == ()


def test_unknown_sets_are_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="'released_4' is neither a published set .*did you mean"):
        sets("released_4")
    with pytest.raises(InputError, match="is neither a published set of angles nor a file"):
        sets(str(tmp_path))


def test_views_that_paint_the_background_require_class_0_to_be_that() -> None:
    (required,) = sets("released_1").record.requires
    assert (required.node, required.setting) == ("dataset", "consistency.view.outside=background")
    assert "dataset.background" in required.advice
    assert required.is_met_by(Record(first_class="background"))
    assert not required.is_met_by(Record(first_class="object"))
    assert not sets().record.requires
    assert not ViewSets(
        view=released(outside="ignore"), sets=("released_1",), splits=("test",)
    ).record.requires
