"""Details of an evaluation: the same images and classes as the counts, in several processes too."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from rgbt.build.session import Session, open_session
from rgbt.checks import InputError
from rgbt.config.compose import compose
from rgbt.data.mfnet import MFNet
from rgbt.dataset import DatasetWrapper
from rgbt.evaluation.request import EvaluationRequest
from rgbt.evaluation.segmentation import _joined, _Part, evaluate
from rgbt.metrics.boundary import BoundaryCounter
from rgbt.metrics.details import KINDS, OF_SCENES, DetailKind, default
from rgbt.metrics.named import value
from rgbt.processes import collected, rank
from rgbt.requirements import Record
from rgbt.spec.specify import specify
from rgbt.types import Output, SceneMaps
from tests.commands import SPLITS, words_of
from tests.processes import run_in_processes

HW = (48, 64)
SURE = 3.0
"""Score of the predicted class; all others have 0."""


class Decoder(nn.Module):
    """Predicts the class grey level / 28 of the thermal image, or of red for the view "rgb"."""

    record = Record(views=("rgbt", "rgb"))

    def forward(self, rgb: Tensor, thermal: Tensor, *, views: tuple[str, ...] = ()) -> Output:
        seen = rgb[:, 0] if views == ("rgb",) else thermal[:, 0]
        classes = (seen * 255 / 28).round().long().clamp(0, 8)
        return Output(SURE * F.one_hot(classes, 9).movedim(-1, 1).float(), {})


class WithScenes(MFNet):
    """Left half: 5 m and object 1; right half: 15 m, no object, and a sky of 10 rows."""

    def scene_maps(self, name: str) -> SceneMaps:
        height, width = self.label(name).shape
        left = np.broadcast_to(np.arange(width) < width // 2, (height, width))
        depth = np.where(left, 5.0, 15.0).astype(np.float32)
        depth[:10] = np.inf
        return SceneMaps(depth, left.astype(np.int32))


class OtherSize(WithScenes):
    def scene_maps(self, name: str) -> SceneMaps:
        return SceneMaps(*(each[::2] for each in super().scene_maps(name)))


def session_of(data: Path, kind: type[MFNet] = MFNet) -> Session:
    words = words_of(data, data / "runs", "+experiment=mfnet", "masker.patch_size=null")
    session = open_session(specify(compose(words)))
    return replace(session, dataset=kind(data))


def request(*kinds: DetailKind, **others: object) -> EvaluationRequest:
    return EvaluationRequest(split="test", details=tuple(map(default, kinds)), **others)


def test_details_are_of_the_counted_pixels(data: Path) -> None:
    session = session_of(data, WithScenes)
    plain = evaluate(session, Decoder(), request())
    assert plain.details == {}
    result = evaluate(session, Decoder(), request(*KINDS))
    assert np.array_equal(result.counts.counts, plain.counts.counts)
    assert tuple(result.details) == KINDS
    for kind, counts in result.details.items():
        assert counts.names == tuple(SPLITS["test"])
        assert counts.partition == default(kind).partition("ring5")
        assert (counts.night, counts.dataset) == (plain.counts.night, plain.counts.dataset)
    for kind in OF_SCENES:  # summed over bins
        counts = result.details[kind]
        bins = counts.counts.reshape(3, 5, -1, 9, 9)
        assert np.array_equal(bins.sum(2), plain.counts.counts)
    # The left half is one object of 48 x 32 = 1536 pixels; 38 of its rows are no sky.
    sizes = result.details["size"].counts.reshape(3, 5, 5, 9, 9).sum((1, 3, 4))
    assert sizes.tolist() == [[0, 0, 0, 1536, 1536]] * 3
    distances = result.details["distance"].counts.reshape(3, 5, 5, 9, 9).sum((1, 3, 4))
    assert distances.tolist() == [[38 * 32, 38 * 32, 0, 0, 10 * 64]] * 3


def test_boundary_counts_are_those_of_the_predicted_classes(data: Path) -> None:
    session = session_of(data)
    found = evaluate(session, Decoder(), request("boundary")).details["boundary"]
    count = BoundaryCounter(9, session.regions, 0.02)
    for name, counts in zip(found.names, found.counts, strict=True):
        sample = session.dataset.read(name)
        classes = (sample.thermal / 28).round().clip(0, 8).astype(np.uint8)
        assert np.array_equal(counts, count(sample.label, classes))


def test_calibration_counts_are_those_of_the_probabilities(data: Path) -> None:
    session = session_of(data)
    result = evaluate(session, Decoder(), request("calibration"))
    found = result.details["calibration"]
    confidence = float(torch.tensor([SURE] + [0.0] * 8).softmax(0)[0])  # e^3 / (e^3 + 8) = 0.715
    number, correct, units = found.counts.reshape(3, 5, 15, 3, 9).sum((0, 1, 4)).T
    assert np.flatnonzero(number).tolist() == [10]  # 10/15 = 0.667 to 11/15 = 0.733
    assert number[10] == 3 * 48 * 64 == result.counts.counts.sum()
    assert correct[10] == np.trace(result.counts.whole())
    assert units[10] == number[10] * round(confidence * 10_000)
    accuracy = value("pixel_accuracy", result.counts, "released")
    expected = abs(accuracy - 100 * confidence)
    assert value("ECE", found, "released") == pytest.approx(expected, abs=0.005)


def test_details_follow_the_input(data: Path) -> None:
    session = replace(session_of(data), model=Decoder())
    both, rgb = (
        evaluate(session, Decoder(), request("boundary", view=view)).details["boundary"]
        for view in ("rgbt", "rgb")
    )
    assert not np.array_equal(both.counts, rgb.counts)
    assert np.array_equal(both.counts[:, :, 1], rgb.counts[:, :, 1])  # the labels are the same


def test_generated_scenes_have_distances_and_sizes(tmp_path: Path) -> None:
    words = ("dataset=synth_calibrated", f"dataset.cache_dir={tmp_path}", "+experiment=mfnet")
    small = ("dataset.num_train=1", "dataset.num_val=1", "dataset.num_test=2")
    size = ("dataset.height=48", "dataset.width=64", "trainer.accelerator=cpu")
    session = open_session(specify(compose((*words, *small, *size))))
    result = evaluate(session, Decoder(), request(*OF_SCENES))
    for kind, counts in result.details.items():
        bins = counts.counts.reshape(2, 5, -1, 9, 9)
        assert np.array_equal(bins.sum(2), result.counts.counts)
        assert bins[:, :, :-1].sum() > 0
        assert bins[:, :, -1].sum() > 0  # the sky, and pixels of no object
        if kind == "size":
            assert bins[:, :, :-1, 0].sum() == 0  # objects have a class


@pytest.mark.parametrize("kind", OF_SCENES)
def test_data_sets_without_scenes_are_refused(data: Path, kind: DetailKind) -> None:
    with pytest.raises(InputError, match=f"details={kind}: mfnet has no maps of distance and ob"):
        evaluate(session_of(data), Decoder(), request(kind))


def test_scenes_are_found_behind_wrappers(data: Path) -> None:
    session = session_of(data, WithScenes)
    wrapped = replace(session, dataset=DatasetWrapper(session.dataset))
    found, direct = (
        evaluate(each, Decoder(), request("distance")).details["distance"].counts
        for each in (wrapped, session)
    )
    assert np.array_equal(found, direct)


def test_maps_of_another_size_than_the_label_are_refused(data: Path) -> None:
    with pytest.raises(InputError, match="'00201D': the map of depth has the size 24x64, but the"):
        evaluate(session_of(data, OtherSize), Decoder(), request("size"))


NAMES = ("b", "a", "d", "c")


def _merged() -> tuple[list[str], dict[str, dict[DetailKind, np.ndarray]]]:
    own = NAMES[rank() :: 2]
    counted = {name: np.full((1, 2, 2), ord(name)) for name in own}
    detailed = {name: {"boundary": np.full((1, 3, 2), ord(name))} for name in own}
    merged = _joined(collected(_Part(counted, detailed, [], ())), NAMES)
    return list(merged.counted), merged.detailed


def test_processes_together_have_the_details_of_all_images_in_order() -> None:
    for names, detailed in run_in_processes(_merged, 2):
        assert names == list(detailed) == list(NAMES)
        for name, kinds in detailed.items():
            assert np.array_equal(kinds["boundary"], np.full((1, 3, 2), ord(name)))
