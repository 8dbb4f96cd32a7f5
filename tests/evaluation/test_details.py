"""Details of an evaluation: the same images and classes as the counts, in several processes too."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from rgbt.assembly.session import Session, open_session
from rgbt.config.compose import compose
from rgbt.data.mfnet import MFNet
from rgbt.evaluation.measure import Measured, joined, measure, measurement_of
from rgbt.metrics.details import DEFAULTS, KINDS, SCENE_KINDS, DetailKind, Details
from rgbt.metrics.named import value
from rgbt.processes import collected, rank
from rgbt.requirements import NetworkRecord
from rgbt.runs.specify import specify
from rgbt.types import Output, SceneMaps
from tests.commands import SPLITS, words_of
from tests.processes import run_in_processes

HW = (48, 64)
SURE = 3.0
"""Score of the predicted class; all others have 0."""


class Decoder(nn.Module):
    """Predicts the class grey level / 28 of the thermal image, or of red for the view "rgb"."""

    record = NetworkRecord(views=("rgbt", "rgb"))

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


def session_of(data: Path, kind: type[MFNet] = MFNet) -> Session:
    """A session on the small data set whose network is a `Decoder`."""
    words = words_of(data, data / "runs", "+experiment=mfnet", "masker.patch_size=null")
    session = open_session(specify(compose(words)))
    return replace(session, dataset=kind(data), model=Decoder())


def measured(session: Session, *kinds: DetailKind) -> Measured:
    details = [Details(kind, DEFAULTS[kind]) for kind in kinds]
    return measure(session, measurement_of(session, "test"), details)


def test_details_are_of_the_counted_pixels(data: Path) -> None:
    session = session_of(data, WithScenes)
    plain = measured(session)
    assert plain.details == {}
    result = measured(session, *KINDS)
    assert np.array_equal(result.counts.counts, plain.counts.counts)
    assert tuple(result.details) == KINDS
    for kind, counts in result.details.items():
        assert counts.names == tuple(SPLITS["test"])
        assert counts.partition == Details(kind, DEFAULTS[kind]).partition("ring5")
        assert counts.measurement.differences(plain.counts.measurement) == ("partition",)
    for kind in SCENE_KINDS:  # summed over bins
        counts = result.details[kind]
        bins = counts.counts.reshape(3, 5, -1, 9, 9)
        assert np.array_equal(bins.sum(2), plain.counts.counts)
    # The left half is one object of 48 x 32 = 1536 pixels; 38 of its rows are no sky.
    sizes = result.details["size"].counts.reshape(3, 5, 5, 9, 9).sum((1, 3, 4))
    assert sizes.tolist() == [[0, 0, 0, 1536, 1536]] * 3
    distances = result.details["distance"].counts.reshape(3, 5, 5, 9, 9).sum((1, 3, 4))
    assert distances.tolist() == [[38 * 32, 38 * 32, 0, 0, 10 * 64]] * 3


def test_calibration_counts_are_those_of_the_probabilities(data: Path) -> None:
    session = session_of(data)
    result = measured(session, "calibration")
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


NAMES = ("b", "a", "d", "c")


def _joined() -> tuple[dict[str, dict[str, np.ndarray]], list[str]]:
    counted = {name: {"": np.full((1, 2, 2), ord(name))} for name in NAMES[rank() :: 2]}
    skipped = ["outside", *NAMES[1 - rank() :: 2]]
    merged, _, skipped = joined(collected((counted, [], skipped)), NAMES)
    return merged, skipped


@pytest.mark.slow
def test_processes_together_have_counts_of_images_in_order() -> None:
    for counted, skipped in run_in_processes(_joined, 2):
        assert list(counted) == list(NAMES)
        assert skipped == [*NAMES, "outside"]
        for name, matrices in counted.items():
            assert np.array_equal(matrices[""], np.full((1, 2, 2), ord(name)))
