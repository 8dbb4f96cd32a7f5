"""The sizes at which the thesis' code compares classes with labels, by hand and with OpenCV."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from lightning_fabric import Fabric
from torch import Tensor, nn

from rgbt.data.domains import Domain, Domains
from rgbt.engine.prediction import Prediction
from rgbt.evaluation.prediction import Predictor
from rgbt.evaluation.request import EvaluationRequest
from rgbt.types import Batch, Output

CLASSES = [[0, 8, 8, 2], [0, 8, 2, 2]]
"""What `Shows` predicts."""

LABEL = [
    [1, 1, 0, 0],
    [3, 3, 8, 8],
    [250, 250, 7, 7],
    [250, 250, 255, 7],
]


class Shows(nn.Module):
    """Predicts `CLASSES`, whatever it sees, mirrored where the image is."""

    def forward(self, rgb: Tensor, thermal: Tensor, **_: Any) -> Output:  # noqa: ARG002
        classes = torch.tensor(CLASSES)
        classes = classes.flip(1) if float(rgb[0, 0, 0, 0]) > float(rgb[0, 0, 0, -1]) else classes
        scores = nn.functional.one_hot(classes, 9).permute(2, 0, 1)[None].float()
        return Output(scores.expand(len(rgb), -1, -1, -1), {})


def predictor(**settings: Any) -> Predictor:
    domains = Domains(
        source=Domain(split="train", view=None, head=None, labels="given"),
        **{"target": None, "target_is": None, "tested_head": "own"},
    )
    session: Any = SimpleNamespace(
        domains=domains,
        model=Shows(),
        fabric=Fabric(accelerator="cpu", devices=1),
        prediction=Prediction(**settings),
    )
    return Predictor(session, session.model, EvaluationRequest(split="test"))


def batch(label: Any, dtype: torch.dtype = torch.uint8) -> Batch:
    label = torch.tensor(np.asarray(label), dtype=dtype)[None]
    ramp = torch.linspace(0, 1, 4).expand(1, 3, 2, 4)
    return Batch(
        rgb=ramp,
        thermal=ramp[:, :1],
        label=label,
        name=("a",),
        centre_yx=torch.zeros(1, 2, dtype=torch.int64),
        position=None,
        original_hw=torch.tensor([label.shape[-2:]]),
    )


def test_label_of_the_port_is_the_mean_of_its_pixels() -> None:
    label = np.repeat(np.array(LABEL, np.uint8), 2, 1)
    found = predictor(counted="image", label_resize="bilinear").counted(batch(label)).label[0]
    # Rows are halved: (1 + 3) / 2, (0 + 8) / 2, 250, and 255 where an ignored pixel takes part.
    assert found.tolist() == [[2, 2, 4, 4], [250, 250, 255, 7]]
    assert found.dtype == torch.uint8


def test_label_of_the_port_is_that_of_opencv_where_nothing_is_ignored() -> None:
    """The third argument of the released call is not the interpolation, which stays bilinear."""
    label = np.random.default_rng(0).integers(0, 14, (4, 8)).astype(np.uint8)
    expected = cv2.resize(label, (4, 2), cv2.INTER_NEAREST)
    assert (expected != cv2.resize(label, (4, 2), interpolation=cv2.INTER_NEAREST)).any()
    found = predictor(counted="image", label_resize="bilinear").counted(batch(label)).label[0]
    np.testing.assert_array_equal(found, expected)


def test_label_of_heatnet_is_every_second_pixel() -> None:
    label = np.arange(32, dtype=np.uint8).reshape(4, 8)
    found = predictor(counted="image", label_resize="nearest").counted(batch(label)).label[0]
    assert found.tolist() == [[0, 2, 4, 6], [16, 18, 20, 22]]
    expected = cv2.resize(label, (4, 2), interpolation=cv2.INTER_NEAREST)
    np.testing.assert_array_equal(found, expected)


def test_label_of_the_file_is_counted_by_default() -> None:
    data = batch(LABEL)
    assert predictor().counted(data) is data


@pytest.mark.parametrize("mirrored", [False, True])
def test_class_numbers_of_maximum_squares_are_enlarged_as_brightness(mirrored: bool) -> None:
    """At the border of 0 and 8: 0, 2, 6, 8; of 8 and 2: 8, 6.5, 3.5, 2, halves rounded up."""
    made = predictor(enlarged="released", mirrored=mirrored)
    data = batch(np.zeros((2, 8)), torch.int64)
    classes = made.classes(data)
    assert classes[0].tolist() == [[0, 2, 6, 8, 8, 7, 4, 2], [0, 2, 6, 7, 4, 2, 2, 2]]
    released = cv2.resize(np.array(CLASSES, np.uint8), (8, 2), cv2.INTER_NEAREST)
    np.testing.assert_array_equal(classes[0], released)
    confident, confidence = made.confident_classes(data)
    assert torch.equal(confident, classes)
    assert confidence.shape == classes.shape


def test_scores_are_enlarged_by_default() -> None:
    classes = predictor().classes(batch(np.zeros((2, 8)), torch.int64))
    assert set(classes.unique().tolist()) == {0, 2, 8}
