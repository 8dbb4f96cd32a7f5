"""Counts of two frames against an independent computation, with predictors that are known."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from math import cos, radians, sin
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from rgbt.build.session import Session, open_session
from rgbt.checks import InputError
from rgbt.config.compose import compose
from rgbt.data.next_frames import NextFrames
from rgbt.evaluation.pairing import Pairing
from rgbt.evaluation.request import EvaluationRequest
from rgbt.evaluation.segmentation import evaluate
from rgbt.evaluation.temporal_consistency import consistency_table, consistency_values, count_pairs
from rgbt.metrics.counts import Counts
from rgbt.metrics.pairs import Protocol, ca, tc
from rgbt.requirements import Record
from rgbt.spec.specify import specify
from rgbt.transforms.view_sets import read_angles
from rgbt.types import Output
from tests.commands import SPLITS, words_of
from tests.conftest import write_png

HW = (48, 64)
VAL, TEST = EvaluationRequest(split="val"), EvaluationRequest(split="test")


class Decoder(nn.Module):
    """Predicts what the thermal image says: class = grey level / 28."""

    record = Record(views=("rgbt",))

    def forward(self, rgb: Tensor, thermal: Tensor, *, views: tuple[str, ...] = ()) -> Output:
        classes = (thermal[:, 0] * 255 / 28).round().long().clamp(0, 8)
        return Output(F.one_hot(classes, 9).movedim(-1, 1).float(), {})


class Oracle(nn.Module):
    """Knows the right answer of every image."""

    record = Record(views=("rgbt",))

    def __init__(self) -> None:
        super().__init__()
        self.answers: dict[bytes, Tensor] = {}

    @staticmethod
    def key(rgb: np.ndarray) -> bytes:
        return np.ascontiguousarray(rgb).tobytes()

    def learn(self, rgb: np.ndarray, label: np.ndarray) -> None:
        self.answers[self.key(rgb)] = torch.from_numpy(label.astype(np.int64))

    def forward(self, rgb: Tensor, thermal: Tensor, *, views: tuple[str, ...] = ()) -> Output:
        shown = (255 * rgb).round().to(torch.uint8).permute(0, 2, 3, 1).numpy()
        classes = torch.stack([self.answers[self.key(each)] for each in shown])
        return Output(F.one_hot(classes, 9).movedim(-1, 1).float(), {})


def opened(*overrides: str) -> Session:
    return open_session(specify(compose(overrides)))


def on_mfnet(data: Path, *overrides: str) -> Session:
    words = words_of(data, data / "runs", "+experiment=temporal_con", "masker.patch_size=null")
    return opened(*words, *overrides)


def draw(data: Path, maps: list[np.ndarray]) -> None:
    """Make the test images say, and be labelled, these class maps (H, W)."""
    for name, classes in zip(SPLITS["test"], maps, strict=True):
        image = np.dstack([np.zeros((*HW, 3), np.uint8), (28 * classes).astype(np.uint8)])
        write_png(data / "images" / f"{name}.png", image)
        write_png(data / "labels" / f"{name}.png", classes.astype(np.uint8))


# ---- virtual views --------------------------------------------------------------------------


def source_of(triple: list[float]) -> tuple[np.ndarray, np.ndarray]:
    """Where pixels of a released view come from: rows and columns (H, W), -1 outside.

    Step by step as the release does it for labels: a nearest-neighbour warp onto the canvas, the
    cut, OpenCV's nearest-neighbour resize.
    """
    yaw, pitch, roll = (radians(each) for each in triple)
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
    maps = [cv2.resize(each, HW[::-1], interpolation=cv2.INTER_NEAREST) for each in coarse]
    draw(data, maps)
    session = on_mfnet(data)
    found = count_pairs(session, Decoder(), TEST, Pairing("virtual")).counts
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


def stripes() -> np.ndarray:
    """Bands of class 0 and of class 8, nine columns wide."""
    bands: np.ndarray = 8 * ((np.arange(64) // 9) % 2) * np.ones((48, 1), int)
    return bands


class Bands(Decoder):
    """Two classes, divided at the middle of their grey levels."""

    def forward(self, rgb: Tensor, thermal: Tensor, *, views: tuple[str, ...] = ()) -> Output:
        classes = 8 * (thermal[:, 0] > 4 * 28 / 255).long()
        return Output(F.one_hot(classes, 9).movedim(-1, 1).float(), {})


def test_perfect_consistency_scores_100_aligned_and_little_as_released(data: Path) -> None:
    draw(data, [stripes(), stripes(), stripes()[:, ::-1]])
    scores = {}
    for view in ("paper", "released"):
        session = on_mfnet(data, f"view@consistency.view={view}")
        found = count_pairs(session, Bands(), TEST, Pairing("virtual"))
        scores[view] = consistency_table(found.counts, "exclude")
    shown = {"unlabeled": 0, "bump": 8}
    for index in shown.values():
        # One interpolation: an edge is where the nearest pixel says it is.
        assert scores["paper"].tc["aligned"][index] > 0.9999
        assert scores["paper"].ca["aligned"][index] > 0.9999
        # Two, with OpenCV's rule for labels that is off by up to half a pixel: bands of 9 pixels.
        assert 0.85 < scores["released"].tc["aligned"][index] < 0.999
        assert scores["paper"].tc["released"][index] < 0.75
        assert scores["released"].tc["released"][index] < 0.75
    assert np.isnan([scores["paper"].tc["aligned"][n] for n in range(1, 8)]).all()


def test_pixels_without_a_label_do_not_count_where_frames_are_aligned(data: Path) -> None:
    draw(data, [stripes()] * 3)
    for name in SPLITS["test"]:
        write_png(data / "labels" / f"{name}.png", np.full(HW, 255, np.uint8))
    found = count_pairs(on_mfnet(data), Bands(), TEST, Pairing("virtual")).counts
    assert not found["aligned"].counts.any()
    released = found["released"].counts.reshape(3, 3, 10, 9, 9)
    # What the release's border rule fills in is background, the rest has no label.
    assert (released.sum((2, 3, 4)) == 48 * 64).all()
    assert (released[:, :, 9].sum((2, 3)) > 0.97 * 48 * 64).all()
    values = consistency_values(consistency_table(found, "released"))
    assert values["TC/aligned"] == values["CA/aligned"] == 0
    assert values["CA/released"] < 0.001 < values["TC/released"]


def test_images_may_be_evaluated_at_another_size_than_their_labels(data: Path) -> None:
    draw(data, [stripes()] * 3)
    session = on_mfnet(data, "scale.test_short_edge=96", "view@consistency.view=paper")
    found = count_pairs(session, Bands(), TEST, Pairing("virtual")).counts["aligned"]
    assert found.counts.sum() > 0.97 * 9 * 48 * 64
    by_class = tc(found.by_region(), "exclude")
    assert by_class[0] > 0.9
    assert by_class[8] > 0.9


def test_the_size_of_a_batch_does_not_change_the_counts(data: Path) -> None:
    one, two = (
        count_pairs(
            on_mfnet(data, f"scale.eval_batch_size={size}"), Decoder(), TEST, Pairing("virtual")
        )
        for size in (1, 2)
    )
    for protocol in ("aligned", "released"):
        assert np.array_equal(one.counts[protocol].counts, two.counts[protocol].counts)


def test_an_unreadable_image_is_left_out(data: Path) -> None:
    whole = count_pairs(on_mfnet(data), Decoder(), TEST, Pairing("virtual")).counts["aligned"]
    path = data / "images" / f"{SPLITS['test'][0]}.png"
    path.write_bytes(path.read_bytes()[:100])
    session = on_mfnet(data, "data.on_error=skip")
    found = count_pairs(session, Decoder(), TEST, Pairing("virtual")).counts["aligned"]
    assert found.names == tuple(SPLITS["test"][1:])
    # The others keep the angles of their own places in the list.
    assert np.array_equal(found.counts, whole.counts[1:])


@pytest.mark.parametrize("size", [1, 4])
def test_a_name_that_a_list_holds_twice_counts_once(data: Path, size: int) -> None:
    first, *others = SPLITS["test"]
    (data / "test.txt").write_text("\n".join([first, *others, first]))
    session = on_mfnet(data, f"scale.eval_batch_size={size}")
    for counts in count_pairs(session, Decoder(), TEST, Pairing("virtual")).counts.values():
        assert counts.names == tuple(SPLITS["test"])
        by_set = counts.counts.reshape(3, 3, 10, 9, 9).sum((2, 3, 4))
        assert (by_set <= 48 * 64).all()
        assert (by_set > 0.97 * 48 * 64).all()


def test_each_protocol_has_the_accuracy_that_it_is_known_by() -> None:
    """One set of 10 pixels and two classes; counts[label, first prediction, second prediction]."""
    pairs = np.zeros((1, 3, 2, 2), np.int32)
    pairs[0, 0, 0], pairs[0, 1, :, 1] = [4, 2], [1, 3]

    def counts(partition: str) -> Counts:
        return Counts(
            counts=pairs,
            names=("a",),
            night=None,
            classes=("road", "car"),
            partition=partition,
            dataset="files",
            split="test",
        )

    requested: list[Protocol] = ["aligned", "released", "next"]
    table = consistency_table({each: counts(f"{each}1") for each in requested}, "exclude")
    # Road: 7, 4 and 6 pixels by the first, the second and the label; 4 by all, 7 by any.
    # Car: 3, 6 and 4; 3 by all, 6 by any. Released: sum of the three less twice what all share.
    exact, released = (4 / 7, 3 / 6), (4 / (17 - 8), 3 / (13 - 6))
    assert table.ca["aligned"] == table.ca["next"] == pytest.approx(exact)
    assert table.ca["released"] == pytest.approx(released)
    assert table.mean_ca["aligned"] == pytest.approx(sum(exact) / 2)
    assert table.mean_ca["released"] == pytest.approx(sum(released) / 2)
    # Of two predictions: 4 of 7 + 4 - 4 pixels, and 3 of 3 + 6 - 3.
    for protocol in requested:
        assert table.tc[protocol] == pytest.approx((4 / 7, 3 / 6))
    assert table.names == ("road", "car")

    left_out = {each: replace(counts(f"{each}1"), unscored=("car",)) for each in requested}
    fewer = consistency_table(left_out, "exclude")
    assert (fewer.names, fewer.unscored) == (("road", "car"), ("car",))
    assert (fewer.tc, fewer.ca) == (table.tc, table.ca)
    assert fewer.mean_tc["next"] == pytest.approx(4 / 7)
    assert fewer.mean_ca["released"] == pytest.approx(released[0])


def test_counts_say_which_classes_the_data_set_leaves_out_of_means(data: Path) -> None:
    session = on_mfnet(data)
    session.dataset.unscored = ("bump", "unlabeled")
    for counts in count_pairs(session, Decoder(), TEST, Pairing("virtual")).counts.values():
        assert counts.unscored == ("bump", "unlabeled")
    assert evaluate(session, Decoder(), TEST).counts.unscored == ("bump", "unlabeled")


# ---- true frames ----------------------------------------------------------------------------


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("cache")


def on_synth(cache: Path, *overrides: str) -> Session:
    return opened(
        *("+experiment=temporal_con", "dataset=synth", f"dataset.cache_dir={cache}"),
        *("dataset.num_train=2", "dataset.num_val=1", "dataset.num_test=3"),
        *("dataset.height=48", "dataset.width=64", "dataset.ego_forward_m=0.5"),
        *("dataset.ego_yaw_deg=3", "scale.test_short_edge=null", "scale.eval_batch_size=2"),
        *("trainer.accelerator=cpu", "tracking=none", *overrides),
    )


def followed(session: Session, name: str, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """`values` (H, W) of the first frame where the second shows them, pixel by pixel."""
    flow = np.load(session.dataset.root / "next" / "flow" / f"{name}.npy")
    found, seen = np.zeros(HW, np.int64), np.zeros(HW, bool)
    for row in range(HW[0]):
        for column in range(HW[1]):
            down, right = flow[row, column]
            if not (np.isnan(down) or np.isnan(right)):
                at = int(np.rint(row + down)), int(np.rint(column + right))
                found[row, column], seen[row, column] = values[at], True
    return found, seen


def test_the_estimated_flow_is_counted_beside_the_exact_one(cache: Path) -> None:
    session = on_synth(cache)
    exact = count_pairs(session, Decoder(), TEST, Pairing("next")).counts
    found = count_pairs(session, Decoder(), TEST, Pairing("next", "both"))
    assert set(found.counts) == {"next", "flow"}
    assert np.array_equal(found.counts["next"].counts, exact["next"].counts)
    assert re.fullmatch("flow1-[0-9a-f]{6}", found.counts["flow"].partition)
    names = session.dataset.names("test")
    assert [record.name for record in found.records] == list(names)
    after = NextFrames(session.dataset)
    for record, counts in zip(found.records, found.counts["flow"].counts, strict=True):
        # All pixels of these scenes have a label, so that all used pixels are counted.
        assert counts.sum() == round(record.used * HW[0] * HW[1])
        flow = after.flow(record.name, HW)
        length = np.nanmedian(np.linalg.norm(flow, axis=-1))
        assert record.displacement_px == pytest.approx(length, rel=0.5)
        assert 0 < record.end_point_error_px < length
        assert 0 <= record.hidden < 0.2
    rgb = count_pairs(session, Decoder(), TEST, Pairing("next", "rgb")).counts["flow"]
    assert rgb.partition != found.counts["flow"].partition


def test_an_oracle_scores_on_true_frames_what_its_labels_do(cache: Path) -> None:
    session = on_synth(cache)
    after, oracle = NextFrames(session.dataset), Oracle()
    agree, union, triple = np.zeros(9), np.zeros(9), np.zeros(9)
    for name in session.dataset.names("test"):
        first, second = session.dataset.read(name), after.dataset.read(name)
        for each in (first, second):
            oracle.learn(each.rgb, each.label)
        brought, seen = followed(session, name, first.label)
        for cls in range(9):
            one, two = (brought == cls) & seen, (second.label == cls) & seen
            agree[cls] += (one & two).sum()
            union[cls] += (one | two).sum()
            triple[cls] += (one & two).sum()
    found = count_pairs(session, oracle, TEST, Pairing("next")).counts["next"]
    assert re.fullmatch("next1-[0-9a-f]{6}", found.partition)
    assert found.counts.shape == (3, 10, 9, 9)
    expected = np.where(union > 0, agree / np.maximum(union, 1), np.nan)
    assert tc(found.by_region(), "exclude") == pytest.approx(expected, nan_ok=True)
    # The second prediction is the label: all three agree where two do.
    assert ca(found.by_region(), "exclude") == pytest.approx(expected, nan_ok=True)
    assert np.nanmean(expected) > 0.6
    values = consistency_values(consistency_table({"next": found}, "exclude"))
    assert values == {
        "TC/next": pytest.approx(np.nanmean(expected)),
        "CA/next": pytest.approx(np.nanmean(expected)),
    }


def test_pixels_of_true_frames_without_a_label_do_not_count(tmp_path: Path) -> None:
    session = on_synth(tmp_path)
    after, expected = NextFrames(session.dataset), []
    for name in session.dataset.names("test"):
        label = after.dataset.read(name).label.copy()
        label[10:30, 5:40] = 255
        write_png(after.dataset.root / "labels" / f"{name}.png", label)
        _, seen = followed(session, name, label)
        expected.append(int((seen & (label != 255)).sum()))
        assert (seen & (label == 255)).any()
    found = count_pairs(session, Decoder(), TEST, Pairing("next")).counts["next"]
    assert not found.counts[:, 9].any()
    assert found.counts.sum((1, 2, 3)).tolist() == expected


def test_true_frames_listed_twice_count_once(tmp_path: Path) -> None:
    once = count_pairs(on_synth(tmp_path), Decoder(), TEST, Pairing("next")).counts["next"]
    root = on_synth(tmp_path).dataset.root
    for place in (root, root / "next"):
        listed = (place / "test.txt").read_text().split()
        (place / "test.txt").write_text("\n".join([*listed, listed[0]]))
    found = count_pairs(on_synth(tmp_path), Decoder(), TEST, Pairing("next")).counts["next"]
    assert found.names == once.names
    assert np.array_equal(found.counts, once.counts)


def test_second_frames_of_another_motion_are_another_partition(cache: Path) -> None:
    partitions = [
        count_pairs(on_synth(cache, *more), Decoder(), TEST, Pairing("next"))
        .counts["next"]
        .partition
        for more in ((), ("seed=1",), ("dataset.ego_forward_m=0.6",))
    ]
    assert partitions[0] == partitions[1] != partitions[2]


def test_perfect_consistency_on_true_frames_is_100_whatever_is_right(cache: Path) -> None:
    session = on_synth(cache)
    after, oracle, rng = NextFrames(session.dataset), Oracle(), np.random.default_rng(0)
    for name in session.dataset.names("test"):
        noise = rng.integers(0, 9, HW)
        brought, seen = followed(session, name, noise)
        oracle.learn(session.dataset.read(name).rgb, noise)
        oracle.learn(after.dataset.read(name).rgb, np.where(seen, brought, 0))
    found = count_pairs(session, oracle, TEST, Pairing("next")).counts["next"]
    assert tc(found.by_region(), "exclude").tolist() == [1.0] * 9
    assert ca(found.by_region(), "exclude").max() < 0.9
    # Noise that does not move with the scene agrees by chance alone.
    for name in session.dataset.names("test"):
        oracle.learn(after.dataset.read(name).rgb, rng.integers(0, 9, HW))
    found = count_pairs(session, oracle, TEST, Pairing("next")).counts["next"]
    assert tc(found.by_region(), "exclude").max() < 0.12


def test_pictures_show_what_was_followed(cache: Path) -> None:
    session = on_synth(cache)
    name = session.dataset.names("test")[1]
    kept = count_pairs(
        session, Decoder(), EvaluationRequest(split="test", keep=[name]), Pairing("next")
    ).kept
    (example,) = kept
    assert example.name == name
    assert np.array_equal(example.first_rgb, session.dataset.read(name).rgb)
    after = NextFrames(session.dataset)
    assert np.array_equal(example.second_rgb, after.dataset.read(name).rgb)
    brought, seen = followed(session, name, example.first)
    assert np.array_equal(example.seen, seen)
    assert np.array_equal(np.where(seen, example.followed, 0), brought)


def other_size(root: Path, name: str) -> str:
    write_png(root / "next" / "images" / f"{name}.png", np.zeros((24, 32, 4), np.uint8))
    write_png(root / "next" / "labels" / f"{name}.png", np.zeros((24, 32), np.uint8))
    return name


def other_names(root: Path, name: str) -> str:
    listed = (root / "next" / "test.txt").read_text().split()
    (root / "next" / "test.txt").write_text("\n".join(reversed(listed)))
    return "must be listed in test and readable"


def fewer_names(root: Path, name: str) -> str:
    (root / "next" / "test.txt").write_text(name)
    return "must be listed in test and readable"


def no_list(root: Path, name: str) -> str:
    (root / "next" / "test.txt").unlink()
    return "the list .* does not exist"


def no_image(root: Path, name: str) -> str:
    (root / "next" / "images" / f"{name}.png").unlink()
    return name


def flow_out_of_the_image(root: Path, name: str) -> str:
    np.save(root / "next" / "flow" / f"{name}.npy", np.full((*HW, 2), 99, np.float32))
    return "points outside the first frame"


@pytest.mark.parametrize(
    "spoil", [other_size, other_names, fewer_names, no_list, no_image, flow_out_of_the_image]
)
def test_second_frames_that_do_not_fit_are_named(
    tmp_path: Path, spoil: Callable[[Path, str], str]
) -> None:
    session = on_synth(tmp_path, "scale.eval_batch_size=1")
    sentence = spoil(session.dataset.root, session.dataset.names("test")[0])
    with pytest.raises(InputError, match=sentence):
        count_pairs(session, Decoder(), TEST, Pairing("next"))
