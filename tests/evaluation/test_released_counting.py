"""The sizes at which the thesis' code compares classes with labels, by hand and with OpenCV."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from torch import Tensor, nn

from rgbt.data.domains import Domain, Domains
from rgbt.engine.prediction import Prediction
from rgbt.evaluation.measure import measure, measurement_of
from rgbt.evaluation.predict import Predictor
from rgbt.types import Batch, Output
from sweeps.plan.table import load_table
from tests.composed import specified
from tests.evaluation.test_details import session_of

CLASSES = [[0, 8, 8, 2], [0, 8, 2, 2]]
"""What `Shows` predicts."""

LABEL = [[1, 1, 0, 0], [3, 3, 8, 8], [250, 250, 7, 7], [250, 250, 255, 7]]


class Shows(nn.Module):
    """Predicts `CLASSES`, whatever it sees, mirrored where the image is."""

    def forward(self, rgb: Tensor, thermal: Tensor, **_: Any) -> Output:  # noqa: ARG002
        classes = torch.tensor(CLASSES)
        classes = classes.flip(1) if float(rgb[0, 0, 0, 0]) > float(rgb[0, 0, 0, -1]) else classes
        scores = nn.functional.one_hot(classes, 9).permute(2, 0, 1)[None].float()
        return Output(scores.expand(len(rgb), -1, -1, -1), {})


def predictor(**settings: Any) -> Predictor:
    source = Domain(split="train", view=None, head=None, labels="given")
    domains = Domains(source=source, target=None, target_is=None, tested_head="own")
    session: Any = SimpleNamespace(domains=domains, model=Shows(), autocast=nullcontext)
    session.prediction = Prediction(**settings)
    return Predictor(session)


def batch(label: Any, dtype: torch.dtype = torch.uint8) -> Batch:
    label = torch.tensor(np.asarray(label), dtype=dtype)[None]
    ramp = torch.linspace(0, 1, 4).expand(1, 3, 2, 4)
    return Batch(
        rgb=ramp,
        thermal=ramp[:, :1],
        label=label,
        name=("a",),
        position=None,
        centre_yx=torch.zeros(1, 2, dtype=torch.int64),
        original_hw=torch.tensor([label.shape[-2:]]),
    )


def test_port_label_is_the_mean_of_its_pixels() -> None:
    label = np.repeat(np.array(LABEL, np.uint8), 2, 1)
    found = predictor(counted="image", label_resize="bilinear").counted(batch(label)).label[0]
    # Rows are halved: (1 + 3) / 2, (0 + 8) / 2, 250, and 255 where an ignored pixel takes part.
    assert found.tolist() == [[2, 2, 4, 4], [250, 250, 255, 7]]
    assert found.dtype == torch.uint8
    # Where nothing is ignored it is that of OpenCV: the third argument of the released call is not
    # the interpolation, which stays bilinear.
    label = np.random.default_rng(0).integers(0, 14, (4, 8)).astype(np.uint8)
    expected = cv2.resize(label, (4, 2), cv2.INTER_NEAREST)
    assert (expected != cv2.resize(label, (4, 2), interpolation=cv2.INTER_NEAREST)).any()
    found = predictor(counted="image", label_resize="bilinear").counted(batch(label)).label[0]
    np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize("mirrored", [False, True])
def test_class_numbers_of_maximum_squares_are_enlarged_as_brightness(mirrored: bool) -> None:
    """At the border of 0 and 8: 0, 2, 6, 8; of 8 and 2: 8, 6.5, 3.5, 2, halves rounded up."""
    made, data = (
        predictor(enlarged="released", mirrored=mirrored),
        batch(np.zeros((2, 8)), torch.int64),
    )
    classes = made.classes(data)
    assert classes[0].tolist() == [[0, 2, 6, 8, 8, 7, 4, 2], [0, 2, 6, 7, 4, 2, 2, 2]]
    released = cv2.resize(np.array(CLASSES, np.uint8), (8, 2), cv2.INTER_NEAREST)
    np.testing.assert_array_equal(classes[0], released)
    confident, confidence = made.confident_classes(data)
    assert torch.equal(confident, classes)
    assert confidence.shape == classes.shape


@pytest.mark.parametrize("label_resize", ["nearest", "bilinear"])
def test_evaluation_counts_pixels_of_the_smaller_image(data: Path, label_resize: str) -> None:
    """48 x 64 labels against predictions of 24 x 32 images."""
    session = session_of(data)
    small = replace(session.transform, test_short_edge=24)
    settings = Prediction(counted="image", label_resize=label_resize)  # type: ignore[arg-type]
    session = replace(session, transform=small, prediction=settings)
    kept = session.dataset.names("test")
    result = measure(session, measurement_of(session, "test"), keep=kept)
    interpolation = cv2.INTER_NEAREST if label_resize == "nearest" else cv2.INTER_LINEAR
    for name, counts in zip(result.counts.names, result.counts.counts, strict=True):
        sample = session.dataset.read(name)
        assert sample.label is not None
        label = cv2.resize(sample.label, (32, 24), interpolation=interpolation)
        seen = small.test(sample).thermal.astype(float)
        expected = np.zeros((9, 9), int)
        np.add.at(expected, (label, (seen / 28).round().clip(0, 8).astype(int)), 1)
        np.testing.assert_array_equal(counts.sum(0), expected)
    assert result.counts.counts.sum() == 3 * 24 * 32
    # Pictures show the label of the file; the prediction is enlarged for them.
    assert {classes.shape for _, classes in result.kept} == {(48, 64)}


FILES = {
    "released": Prediction(align_corners=True),
    "released_heatnet": Prediction(counted="image", label_resize="bilinear"),
    "released_max_squares": Prediction(mirrored=True, enlarged="released"),
}


ROWS = {
    "HeatNet w/o thermal teacher (reproduced)": "released_heatnet",
    **dict.fromkeys(("HeatNet (reproduced)", "HeatNet*"), "released_heatnet"),
    **dict.fromkeys(("HeatNet RGB-only (reproduced)", "HeatNet RGB-only*"), "released_heatnet"),
    "SH-Maximum squares loss": "released_max_squares",
    **dict.fromkeys(("SH-Adv", "SH-Adv(Seg. on IR)", "Multi-head", "Multi-head*"), "released"),
    "Multi-head**": "released",
}


@pytest.mark.parametrize("name", ["table2", "table3", "table4"])
def test_released_thesis_rows_are_predicted_as_its_code_does(name: str) -> None:
    table = load_table(f"multihead/{name}")
    for row in table.runnable_rows:
        if row.released is None:
            continue
        run = specified((*table.overrides(row, "demo", "released"), "scale=demo"))
        assert run.prediction == FILES[ROWS[row.label]], row.label
        scheme, optimizer = run.scheme.values, run.optimizer.values
        if row.label.startswith("HeatNet") and "critic" in scheme:
            assert scheme["idle_steps"] == "released"
        if row.label == "SH-Maximum squares loss":
            (stage,) = run.upstream
            rates = {optimizer["head_rate"], stage.optimizer.values["head_rate"]}
            assert rates == {"released"}
