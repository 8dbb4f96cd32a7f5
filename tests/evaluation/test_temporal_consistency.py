"""Counts of two frames against an independent computation, with predictors that are known."""

from __future__ import annotations

import re
from dataclasses import replace
from math import cos, radians, sin
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from rgbt.assembly.session import Session, open_session
from rgbt.checks import InputError
from rgbt.config.compose import compose
from rgbt.data.mfnet import NextFrames
from rgbt.evaluation.measure import measurement_of
from rgbt.evaluation.pairs.count import (
    CountedPairs,
    _picture,
    consistency_table,
    consistency_values,
    count_pairs,
)
from rgbt.evaluation.pairs.frames import flow_source, pairs_of
from rgbt.evaluation.pairs.scenes import FlowRecord, flow_record
from rgbt.metrics.pairs import ca, frames, tc, triples
from rgbt.requirements import NetworkRecord
from rgbt.runs.specify import specify
from rgbt.transforms.views import read_angles
from rgbt.types import Output
from tests.commands import SPLITS, words_of
from tests.conftest import write_png

HW = (48, 64)


def test_pictures_are_enlarged_between_the_centres_of_their_pixels() -> None:
    """255 times 0, 1/4, 3/4, 1, rounded."""
    found = _picture(torch.tensor([0.0, 1.0]).expand(3, 1, 2), (2, 4))
    assert found.tolist() == [[[level] * 3 for level in (0, 64, 191, 255)]] * 2


def one_hot(classes: Tensor) -> Output:
    return Output(F.one_hot(classes, 9).movedim(-1, 1).float(), {})


class Decoder(nn.Module):
    """Predicts what the thermal image says: class = grey level / 28."""

    record = NetworkRecord(views=("rgbt",))

    def forward(self, rgb: Tensor, thermal: Tensor, *, views: tuple[str, ...] = ()) -> Output:
        return one_hot((thermal[:, 0] * 255 / 28).round().long().clamp(0, 8))


class Oracle(nn.Module):
    """Knows the right answer of every image, by its bytes."""

    record = NetworkRecord(views=("rgbt",))

    def __init__(self) -> None:
        super().__init__()
        self.answers: dict[bytes, Tensor] = {}

    def learn(self, rgb: np.ndarray, label: np.ndarray) -> None:
        self.answers[rgb.tobytes()] = torch.from_numpy(label.astype(np.int64))

    def forward(self, rgb: Tensor, thermal: Tensor, *, views: tuple[str, ...] = ()) -> Output:
        shown = (255 * rgb).round().to(torch.uint8).permute(0, 2, 3, 1).numpy()
        return one_hot(torch.stack([self.answers[image.tobytes()] for image in shown]))


def on_mfnet(data: Path, *overrides: str) -> Session:
    words = words_of(data, data / "runs", "+experiment=temporal_con", "masker.patch_size=null")
    return open_session(specify(compose([*words, *overrides])))


def counted(session: Session, network: nn.Module, **chosen: Any) -> CountedPairs:
    session = replace(session, model=network)
    pairs = pairs_of(session, "test", **chosen)
    return count_pairs(session, measurement_of(session, "test"), pairs)


def source_of(triple: list[float]) -> tuple[np.ndarray, np.ndarray]:
    """Where pixels of a released view come from: rows and columns (H, W), -1 outside.

    Step by step as the release does it for labels: a nearest-neighbour warp onto the canvas, the
    cut, OpenCV's nearest-neighbour resize.
    """
    yaw, pitch, roll = map(radians, triple)
    about_y = np.array([[cos(yaw), 0, sin(yaw)], [0, 1, 0], [-sin(yaw), 0, cos(yaw)]])
    about_x = np.array([[1, 0, 0], [0, cos(pitch), -sin(pitch)], [0, sin(pitch), cos(pitch)]])
    about_z = np.array([[cos(roll), -sin(roll), 0], [sin(roll), cos(roll), 0], [0, 0, 1]])
    centre = (320.5 * 0.1 - 0.5, 240.5 * 0.1 - 0.5)
    focal = (70.26030497884977, 70.34541726858521)
    matrix = np.array([[focal[0], 0, centre[0]], [0, focal[1], centre[1]], [0, 0, 1]])
    turn = matrix @ about_z @ about_x @ about_y @ np.linalg.inv(matrix)
    corners = turn @ np.array([[0, 63, 0, 63], [0, 0, 47, 47], [1, 1, 1, 1]])
    xs, ys = np.sort(corners[:2] / corners[2], axis=1)
    left, right = (int(min(max(v, 0), 63)) for v in (xs[1], xs[2]))
    top, bottom = (int(min(max(v, 0), 47)) for v in (ys[1], ys[2]))
    rows = top + np.floor(np.arange(48) * (bottom - top) / 48)
    columns = left + np.floor(np.arange(64) * (right - left) / 64)
    x, y = np.meshgrid(columns, rows)
    back = np.linalg.inv(turn) @ np.stack([x.ravel(), y.ravel(), np.ones(x.size)])
    column, row = (np.floor(v / back[2] + 0.5).reshape(HW).astype(int) for v in back[:2])
    outside = (row < 0) | (row > 47) | (column < 0) | (column > 63)
    row[outside] = column[outside] = -1
    return row, column


def by_hand(first: np.ndarray, second: np.ndarray, label: np.ndarray) -> np.ndarray:
    found = np.zeros((10, 9, 9), int)
    np.add.at(found, (np.minimum(label, 9), first, second), 1)
    return found


def test_virtual_counts_equal_a_plain_computation(data: Path) -> None:
    rng = np.random.default_rng(0)
    coarse = [rng.integers(0, 9, (6, 8)).astype(np.uint8) for _ in SPLITS["test"]]
    maps = [cv2.resize(image, HW[::-1], interpolation=cv2.INTER_NEAREST) for image in coarse]
    for name, classes in zip(SPLITS["test"], maps, strict=True):
        image = np.dstack([np.zeros((*HW, 3), np.uint8), 28 * classes])
        write_png(data / "images" / f"{name}.png", image)
        write_png(data / "labels" / f"{name}.png", classes)
    session = on_mfnet(data)
    found = counted(session, Decoder()).counts
    sets = session.consistency
    for protocol in ("aligned", "released"):
        counts = found[protocol].counts.reshape(3, 3, 10, 9, 9)
        for image, classes in enumerate(maps):
            for number in range(3):
                triple = read_angles(f"released_{number + 1}")[image : image + 1]
                thermal = torch.from_numpy(28 * classes / 255).float()[None, None]
                second = Decoder()(thermal, sets.view.warp(triple, HW).bilinear(thermal, 255))
                row, column = source_of(triple[0].tolist())
                seen = row >= 0
                brought = np.where(seen, classes[row, column], 0)  # as label and as prediction
                last = second.logits.argmax(1)[0].numpy()
                if protocol == "released":
                    expected = by_hand(classes.ravel(), last.ravel(), brought.ravel())
                else:
                    expected = by_hand(brought[seen], last[seen], brought[seen])
                difference = np.abs(expected - counts[image, number]).sum()
                assert difference <= 0.004 * 48 * 64, (protocol, image, number)


def test_counts_of_neighbouring_scenes_are_kept_as_one(data: Path) -> None:
    whole, added = (
        counted(on_mfnet(data, *words), Decoder()).counts
        for words in ((), ("consistency.scenes_per_count=2",))
    )
    for protocol, counts in whole.items():
        assert len(added[protocol].names) < len(counts.names)
        assert added[protocol].names == counts.added(2).names
        assert np.array_equal(added[protocol].by_region(), counts.by_region())


def test_unreadable_and_repeated_names_do_not_count(data: Path) -> None:
    whole = counted(on_mfnet(data), Decoder()).counts
    first, *others = SPLITS["test"]
    path = data / "images" / f"{first}.png"
    path.write_bytes(path.read_bytes()[:100])
    (data / "test.txt").write_text("\n".join([first, *others, others[0]]))
    session = on_mfnet(data, "data.on_error=skip", "scale.eval_batch_size=4")
    for protocol, counts in counted(session, Decoder()).counts.items():
        assert counts.names == tuple(others)
        # The others keep the angles of their own places in the list.
        assert np.array_equal(counts.counts, whole[protocol].counts[1:])


def on_synth(cache: Path, *overrides: str) -> Session:
    words = (
        *("+experiment=temporal_con", "dataset=synth", f"dataset.cache_dir={cache}"),
        *("dataset.num_train=2", "dataset.num_val=1", "dataset.num_test=3"),
        *("dataset.height=48", "dataset.width=64", "dataset.ego_forward_m=0.5"),
        *("dataset.ego_yaw_deg=3", "scale.test_short_edge=null", "scale.eval_batch_size=2"),
        *("trainer.accelerator=cpu", "tracking=none", *overrides),
    )
    return open_session(specify(compose(words)))


def followed(session: Session, name: str, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """`values` (H, W) of the first frame where the second shows them, and where it does."""
    flow = np.load(session.dataset.root / "next" / "flow" / f"{name}.npy")
    seen = ~np.isnan(flow).any(-1)
    place = np.rint(np.moveaxis(np.where(seen[..., None], flow, 0), -1, 0)).astype(int)
    rows, columns = np.indices(HW) + place
    return np.where(seen, values[rows, columns], 0), seen


def test_the_estimated_flow_is_counted_beside_the_exact_one(tmp_path: Path) -> None:
    session = on_synth(tmp_path)
    exact = counted(session, Decoder(), frames="next").counts
    found = counted(session, Decoder(), frames="next", flow="both")
    assert set(found.counts) == {"next", "flow"}
    assert np.array_equal(found.counts["next"].counts, exact["next"].counts)
    assert re.fullmatch("flow1-[0-9a-f]{6}", found.counts["flow"].partition)
    assert tuple(record.name for record in found.records) == session.dataset.names("test")
    after = NextFrames(session.dataset)
    for record, counts in zip(found.records, found.counts["flow"].counts, strict=True):
        # All pixels of these scenes have a label, so that all used pixels are counted.
        assert counts.sum() == round(record.used * HW[0] * HW[1])
        flow = after.flow(record.name, HW)
        length = np.nanmedian(np.linalg.norm(flow, axis=-1))
        assert record.displacement_px == pytest.approx(length, rel=0.5)
        assert 0 < record.end_point_error_px < length
        assert 0 <= record.hidden < 0.2


def test_reliability_of_an_estimated_flow_by_hand() -> None:
    """Four pixels: right, 1 pixel short, hidden in the first frame, and one that is not used."""
    flow = np.array([[[0, 0], [0, 3], [5, 0], [0, 9]]], np.float32)
    exact = np.array([[[0, 0], [0, 4], [np.nan, np.nan], [0, 0]]], np.float32)
    found: Any = SimpleNamespace(flow=flow, used=np.array([[True, True, True, False]]))
    assert flow_record("a", found, exact) == FlowRecord("a", 0.75, 3.0, 0.5, pytest.approx(1 / 3))
    assert flow_record("a", found)[:3] == ("a", 0.75, 3.0)


def test_oracle_scores_what_labels_do_on_true_frames(tmp_path: Path) -> None:
    session = on_synth(tmp_path)
    after, oracle = NextFrames(session.dataset), Oracle()
    agree, union = np.zeros(9), np.zeros(9)
    for name in session.dataset.names("test"):
        label = after.dataset.read(name).label.copy()
        label[10:30, 5:40] = 255  # pixels without a label do not count
        write_png(after.dataset.root / "labels" / f"{name}.png", label)
        first, second = session.dataset.read(name), after.dataset.read(name)
        for frame in (first, second):
            oracle.learn(frame.rgb, np.where(frame.label == 255, 0, frame.label))
        brought, seen = followed(session, name, first.label)
        seen &= second.label != 255
        for cls in range(9):
            one, two = (brought == cls) & seen, (second.label == cls) & seen
            agree[cls] += (one & two).sum()
            union[cls] += (one | two).sum()
    found = counted(session, oracle, frames="next").counts["next"]
    assert re.fullmatch("next1-[0-9a-f]{6}", found.partition)
    assert found.counts.shape == (3, 10, 9, 9)
    expected = np.where(union > 0, agree / np.maximum(union, 1), np.nan)
    assert tc(frames(found.by_region()), "exclude") == pytest.approx(expected, nan_ok=True)
    # The second prediction is the label: all three agree where two do.
    assert ca(triples(found.by_region()), "exclude") == pytest.approx(expected, nan_ok=True)
    assert np.nanmean(expected) > 0.6
    table = consistency_table({"next": found}, "exclude")
    absent = ", ".join(name for name, n in zip(found.classes, union, strict=True) if n == 0)
    rule = "A class without a pixel is left out of means (absent=exclude)."
    assert table.notes == (f"{rule} Without one: {absent or 'no class'}.",)
    assert "counts as 0 (abs" in consistency_table({"next": found}, "released").notes[0]
    values = consistency_values(table)
    assert values == dict.fromkeys(("TC/next", "CA/next"), pytest.approx(np.nanmean(expected)))


def test_second_frames_that_are_not_listed_are_refused(tmp_path: Path) -> None:
    session = on_synth(tmp_path, "scale.eval_batch_size=1")
    (session.dataset.root / "next" / "test.txt").write_text(session.dataset.names("test")[0])
    with pytest.raises(InputError):
        counted(session, Decoder(), frames="next")


@pytest.mark.parametrize(
    ("frames", "given", "source"),
    [
        ("virtual", "default", None),
        ("virtual", "exact", None),
        ("next", "default", None),
        ("next", "rgb", "rgb"),
        ("video", "default", "both"),
        ("video", "thermal", "thermal"),
        ("virtual", "rgb", "refused"),
        ("video", "exact", "refused"),
    ],
)
def test_flow_fits_the_second_frames(frames: Any, given: str, source: str | None) -> None:
    if source == "refused":
        with pytest.raises(InputError, match=f"flow={given} is not possible: frames={frames}"):
            flow_source(frames, given)
    else:
        assert flow_source(frames, given) == source
