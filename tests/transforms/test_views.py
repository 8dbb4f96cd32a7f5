"""Virtual views: what is drawn, where pixels come from, what becomes of a batch, fixed angles."""

from __future__ import annotations

import hashlib
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch

from rgbt.checks import InputError
from rgbt.geometry.camera import homography
from rgbt.geometry.warp import Warp
from rgbt.requirements import DatasetRecord
from rgbt.transforms.views import ViewSets, VirtualView, read_angles
from rgbt.types import IGNORE, Batch
from tests.geometry.views import RELEASED as CAMERA

PAPER: dict[str, Any] = {
    "camera": CAMERA,
    "yaw": (-10.0, 10.0),
    "pitch": (-10.0, 10.0),
    "roll": (-5.0, 5.0),
    "order": "zyx",
    "angles": "uniform",
    "mode": "both",
    "rectangle": "largest",
    "resampling": "once",
    "outside": "ignore",
}
RELEASED = {
    **PAPER,
    "order": "zxy",
    "angles": "integer",
    "rectangle": "corners",
    "resampling": "twice",
    "outside": "background",
}
HW = (96, 128)


def paper(**changes: Any) -> VirtualView:
    return VirtualView(**{**PAPER, **changes})


def released(**changes: Any) -> VirtualView:
    return VirtualView(**{**RELEASED, **changes})


def angles(*triples: tuple[float, float, float]) -> torch.Tensor:
    return torch.tensor(triples, dtype=torch.float64)


def drawn(view: VirtualView) -> torch.Tensor:
    return view.draw(4000, torch.Generator().manual_seed(0))


def scene(label_hw: tuple[int, int] = HW) -> Batch:
    """Blurred noise, which has edges everywhere, and blobs of nine classes."""
    rng = np.random.default_rng(3)
    image = cv2.GaussianBlur(rng.random((*HW, 4)).astype(np.float32), (0, 0), 3)
    images = torch.from_numpy((image - image.min()) / np.ptp(image)).permute(2, 0, 1)[None]
    coarse = torch.from_numpy(rng.integers(1, 9, (6, 8)))
    label = coarse.repeat_interleave(label_hw[0] // 6, 0).repeat_interleave(label_hw[1] // 8, 1)
    places = torch.stack(torch.meshgrid(*map(torch.arange, HW), indexing="ij"))
    centre, size = torch.zeros(1, 2, dtype=torch.int64), torch.tensor([HW])
    named = {"name": ("0",), "centre_yx": centre, "original_hw": size}
    maps = {"rgb": images[:, :3], "thermal": images[:, 3:], "label": label[None]}
    return Batch(**maps, **named, position=places[None].float())  # type: ignore[arg-type]


# ---- what is drawn --------------------------------------------------------------------------


def test_uniform_angles_fill_their_own_intervals() -> None:
    found = drawn(paper(yaw=(-10.0, 2.0), pitch=(3.0, 4.0), roll=(-5.0, -5.0)))
    assert (found.shape, found.dtype) == ((4000, 3), torch.float64)
    low, high = found.min(0).values, found.max(0).values
    assert (low >= torch.tensor([-10.0, 3.0, -5.0])).all()
    assert (high <= torch.tensor([2.0, 4.0, -5.0])).all()
    # The ends of 4000 draws lie this near to those of the interval with probability 0.998 each.
    assert (low[:2] - torch.tensor([-10.0, 3.0])).abs().max() < 0.02
    assert (found[:, 0].mean() + 4).abs() < 0.3  # standard error 0.055


def test_integer_angles_are_whole_degrees_without_the_upper_end() -> None:
    found = drawn(released())
    for column, (low, high) in enumerate([(-10, 10), (-10, 10), (-5, 5)]):
        assert sorted(set(found[:, column].tolist())) == list(range(low, high))
    counts = np.unique(found[:, 2], return_counts=True)[1]
    assert counts.min() > 330  # of 400 expected, standard deviation 19


def test_rotation_does_not_cut_and_translation_does_nothing_else() -> None:
    triple = angles((4, 7, 1))
    both, rotation, translation = (
        paper(mode=mode).warp(triple, HW) for mode in ("both", "rotation", "translation")
    )
    assert torch.equal(rotation.homography, both.homography)
    assert torch.equal(both.homography, homography(triple, CAMERA.matrix(HW), "zyx"))
    of_release = released().warp(triple, HW).homography
    assert torch.equal(of_release, homography(triple, CAMERA.matrix(HW), "zxy"))
    assert rotation.rectangle.tolist() == [[-0.5, -0.5, 127.5, 95.5]]
    assert torch.equal(translation.homography, torch.eye(3, dtype=torch.float64)[None])
    assert torch.equal(translation.rectangle, both.rectangle)
    assert translation.inside().all()
    assert not rotation.inside().all()
    assert both.inside().all()


# ---- what becomes of a batch ----------------------------------------------------------------


@pytest.mark.parametrize(("outside", "label"), [("ignore", 255), ("background", 0)])
def test_what_the_first_frame_does_not_show(outside: str, label: int) -> None:
    view = paper(mode="rotation", outside=outside)
    warp = view.warp(angles((10, 0, 0)), HW)
    found, inside = view.batch(scene(), warp), warp.inside()
    assert 0.05 < 1 - inside.float().mean() < 0.5
    assert (found.label[~inside] == label).all()
    assert (found.label[inside] > 0).all()
    assert (found.label[inside] < 9).all()
    assert not found.rgb.movedim(1, -1)[~inside].any()
    assert not found.thermal.movedim(1, -1)[~inside].any()
    assert torch.equal(view.valid(warp), inside if label == 255 else torch.ones_like(inside))


@pytest.mark.parametrize("label_hw", [HW, (2 * HW[0], 2 * HW[1])])
@pytest.mark.parametrize(("outside", "confidence"), [("ignore", 0.0), ("background", 1.0)])
def test_confidences_move_with_their_labels(
    outside: str, confidence: float, label_hw: tuple[int, int]
) -> None:
    view = paper(mode="rotation", outside=outside)
    batch = scene(label_hw=label_hw)
    batch = replace(batch, confidence=batch.label / 16)
    found = view.batch(batch, view.warp(angles((10, 0, 0)), HW))
    assert found.confidence is not None
    inside = (found.label > 0) & (found.label < IGNORE)
    assert torch.equal(found.confidence[inside], found.label[inside] / 16)
    assert (found.confidence[~inside] == confidence).all()
    assert not inside.all()
    if label_hw == HW:  # positions say where a pixel was
        rows, columns = found.position[0].long()
        assert torch.equal(found.label[inside], batch.label[0, rows, columns][inside[0]])


def test_centre_moves_to_the_nearest_pixel_of_view() -> None:
    """The middle half is enlarged twofold: row 30 to (30 - 23.5) 2 - 0.5, less 0.2 of the shift."""
    whole, middle = (-0.5, -0.5, 127.5, 95.5), (31.5, 23.5, 95.5, 71.5)
    for x, y, edges, point, expected in (
        (0.3, 0.8, whole, (40, 50), [41, 50]),
        (0.8, 0.3, whole, (41, 51), [41, 52]),
        (-0.1, -0.1, middle, (30, 40), [12, 16]),
        (-0.1, -0.1, middle, (0, 0), [0, 0]),
        (-0.1, -0.1, middle, (30, 127), [12, 127]),
    ):
        turn = torch.tensor([[[1, 0, x], [0, 1, y], [0, 0, 1]]], dtype=torch.float64)
        warp = Warp(turn, torch.tensor([edges], dtype=torch.float64), HW, "once")
        batch = replace(scene(), centre_yx=torch.tensor([point]))
        assert paper().batch(batch, warp).centre_yx[0].tolist() == expected


@pytest.mark.parametrize("make", [paper, released])
def test_only_released_images_are_whole_bytes(make: Any) -> None:
    view = make()
    found = view.batch(scene(), view.warp(angles((4, 7, 1)), HW))
    for image in (255 * found.rgb, 255 * found.thermal):
        off = (image - image.round()).abs().max()
        assert off < 1e-3 if make is released else off > 0.4


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"angles": "integer", "yaw": (-0.5, 3.0)}, "view.yaw"),
        ({"angles": "integer", "yaw": (3.0, 3.0)}, "view.yaw"),
        ({"yaw": (-50.0, 50.0)}, "yaw -50, pitch -10, roll .* leave a rectangle of 0 % "),
        ({"yaw": (-50.0, 50.0), "mode": "rotation"}, "a rectangle of 0 % "),
        ({"yaw": (-44.0, 44.0)}, "a rectangle of [0-9.]+ % .* more than 10 % is required"),
        ({"yaw": (0.0, 44.0), "rectangle": "corners"}, "a rectangle of [0-9.]+ %"),
    ],
)
def test_ranges_that_cannot_be_are_refused(changes: dict[str, Any], sentence: str) -> None:
    with pytest.raises(InputError, match=sentence):
        paper(**changes)


# ---- fixed sets of angles -------------------------------------------------------------------

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
    assert (found.shape, found.dtype) == ((393, 3), torch.float64)
    text = "\n".join(",".join(f"{value:.1f}" for value in row) for row in found.tolist())
    assert hashlib.sha256(text.encode()).hexdigest().startswith(digest)
    assert found.mean(0).tolist() == pytest.approx(means, abs=5e-4)
    assert len({tuple(row) for row in found.tolist()}) == distinct


def sets(*names: str, view: VirtualView | None = None) -> ViewSets:
    return ViewSets(view=view or released(), sets=names, splits=("test",))


def test_images_take_triples_in_order_and_again() -> None:
    views, triples = sets("released_1", "released_3"), read_angles("released_3")
    assert torch.equal(views.angles(1, [5, 0, 392, 393, 398]), triples[[5, 0, 392, 0, 5]])
    assert views.angles(0, [0]).tolist() == [[4, 7, 1]]


def test_a_file_of_ones_own(tmp_path: Path) -> None:
    path = tmp_path / "mine.csv"
    path.write_bytes("\ufeffyaw, pitch, roll\r\n\r\n1.5,-2,3\r\n\n0,0,0".encode())
    assert sets(str(path)).angles(0, [2, 1]).tolist() == [[1.5, -2, 3], [0, 0, 0]]


def test_the_mark_tells_views_apart_by_what_they_show(tmp_path: Path) -> None:
    copies = [tmp_path / f"{name}.csv" for name in PUBLISHED]
    for path in copies:
        rows = [",".join(map(str, row)) for row in read_angles(path.stem).tolist()]
        path.write_text("\n".join(["yaw,pitch,roll", *rows]))
    narrow = released(yaw=(-9.0, 3.0))  # nothing is drawn
    same = [sets(*PUBLISHED), sets(*map(str, copies)), sets(*PUBLISHED, view=narrow)]
    assert [views.mark for views in same] == ["", "", ""]
    changes: tuple[dict[str, Any], ...] = (
        *({"order": "zyx"}, {"rectangle": "largest"}, {"resampling": "once"}),
        *({"mode": "rotation"}, {"outside": "ignore"}, {"camera": replace(CAMERA, fx=500.0)}),
    )
    others = [sets(*PUBLISHED, view=released(**change)) for change in changes]
    marks = {views.mark for views in (*others, sets("released_1"), sets(*reversed(PUBLISHED)))}
    assert (len(marks), {len(mark) for mark in marks}) == (8, {6})


BROKEN = {
    "empty": b"",
    "no triple": b"yaw,pitch,roll\n",
    "no header": b"1,2,3\n",
    "order": b"roll,pitch,yaw\n1,2,3\n",
    "two values": b"yaw,pitch,roll\n1,2\n",
    "four values": b"yaw,pitch,roll\n1,2,3,4\n",
    "a word": b"yaw,pitch,roll\n1,2,x\n",
    "nan": b"yaw,pitch,roll\n1,2,nan\n",
    "endless": b"yaw,pitch,roll\n0,0,0\ninf,2,3\n",
    "too steep": b"yaw,pitch,roll\n0,0,0\n80,2,3\n",
    "bytes": b"\xff\xfe\x00\x01" * 9,
    "ragged": b"yaw,pitch,roll\n1,2,3\n1,2\n",
    "utf-16": "1,2,3\n".encode("utf-16"),
}


@pytest.mark.parametrize("content", BROKEN.values(), ids=BROKEN)
def test_broken_sets_are_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "mine.csv"
    path.write_bytes(content)
    with pytest.raises(InputError, match="consistency.sets: ") as raised:
        sets(str(path))
    assert str(path) in str(raised.value)


def test_unknown_sets_and_sets_without_a_split_are_refused(tmp_path: Path) -> None:
    for name in ("released_4", str(tmp_path)):
        with pytest.raises(InputError, match="consistency.sets: .*released_1"):
            sets(name)
    with pytest.raises(InputError, match=r"consistency\.splits"):
        ViewSets(view=released(), sets=("released_1",), splits=())
    assert ViewSets(view=released(), sets=(), splits=()).sets == ()


def test_views_painting_background_require_it_as_class_0() -> None:
    (required,) = sets("released_1").record.requires
    assert (required.node, required.setting) == ("dataset", "consistency.view.outside=background")
    assert required.is_met_by(DatasetRecord(first_class="background"))
    assert not required.is_met_by(DatasetRecord(first_class="object"))
    assert not sets().record.requires
    assert not sets("released_1", view=released(outside="ignore")).record.requires
