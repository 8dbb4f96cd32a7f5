"""The sizes at which the thesis' code compares classes with labels, by hand and with OpenCV."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from lightning_fabric import Fabric
from torch import Tensor, nn

from rgbt.build.session import open_session
from rgbt.checks import InputError
from rgbt.config.compose import compose, conf_dir
from rgbt.data.domains import Domain, Domains
from rgbt.engine.prediction import Prediction
from rgbt.evaluation.prediction import Predictor
from rgbt.evaluation.request import EvaluationRequest, NetworkRequest
from rgbt.evaluation.segmentation import evaluate
from rgbt.spec.load_spec import load_spec
from rgbt.types import Batch, Output
from sweeps.table.load_table import load_table
from tests.composed import specified
from tests.evaluation.test_details import Decoder, session_of

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


@pytest.mark.parametrize("label_resize", ["nearest", "bilinear"])
def test_evaluation_counts_pixels_of_the_smaller_image(data: Path, label_resize: str) -> None:
    """48 x 64 labels against predictions of 24 x 32 images, one pixel after the other."""
    session = session_of(data)
    small = replace(session.transform, test_short_edge=24)
    settings = Prediction(counted="image", label_resize=label_resize)  # type: ignore[arg-type]
    session = replace(session, transform=small, prediction=settings)
    names = session.dataset.names("test")
    request = EvaluationRequest(split="test", keep=names)
    result = evaluate(session, Decoder(), request)
    interpolation = cv2.INTER_NEAREST if label_resize == "nearest" else cv2.INTER_LINEAR
    for name, counts in zip(result.counts.names, result.counts.counts, strict=True):
        sample = session.dataset.read(name)
        assert sample.label is not None
        label = cv2.resize(sample.label, (32, 24), interpolation=interpolation)
        seen = small.test(sample).thermal.astype(float)
        expected = np.zeros((9, 9), int)
        for row, classes in zip(label, (seen / 28).round().clip(0, 8).astype(int), strict=True):
            for truth, predicted in zip(row, classes, strict=True):
                expected[truth, predicted] += 1
        np.testing.assert_array_equal(counts.sum(0), expected)
    assert result.counts.counts.sum() == 3 * 24 * 32
    # Pictures show the label of the file; the prediction is enlarged for them.
    assert {each.prediction.shape for each in result.kept} == {(48, 64)}


def test_predictions_of_a_run_may_be_changed_and_need_a_folder() -> None:
    options: Any = SimpleNamespace(run="x")
    network = NetworkRequest(options, ("prediction=released",))
    with pytest.raises(InputError, match="changes how the run is measured"):
        network.check_comparable(None)
    network.check_comparable(Path("out"))
    stored = compose(["+experiment=mfnet"])
    stored = {key: value for key, value in stored.items() if key != "prediction"}
    assert load_spec(stored).prediction == Prediction()  # of a run that is older than the group
    found = load_spec(stored, ["prediction=released_max_squares", "prediction.scales=[0.5,1.0]"])
    expected = Prediction(mirrored=True, enlarged="released", scales=(0.5, 1.0))
    assert found.prediction == expected


FILES = {
    "whole": Prediction(),
    "released": Prediction(align_corners=True),
    "released_heatnet": Prediction(counted="image", label_resize="bilinear"),
    "released_max_squares": Prediction(mirrored=True, enlarged="released"),
    "heatnet": Prediction(counted="image"),
    "semseg": Prediction(mirrored=True, window_hw=(473, 473)),
}


def test_files_of_the_group_are_what_they_say() -> None:
    assert {path.stem for path in (conf_dir() / "prediction").glob("*.yaml")} == set(FILES)
    for name, settings in FILES.items():
        words = ["transform=semseg", "model=semseg", "transform.crop_hw=[473,473]"]
        spec = specified((*words, f"prediction={name}", "loss=cross_entropy"))
        assert spec.prediction == settings, name


def test_networks_of_masks_are_refused_where_probabilities_are_averaged() -> None:
    causes = {"mirrored": "true", "window_hw": "[16,16]", "scales": "[0.5,1.0]"}
    for key, setting in causes.items():
        spec = specified(("+experiment=baseline", "+debug=smoke", f"prediction.{key}={setting}"))
        with pytest.raises(InputError, match=f"with prediction.{key} requires outputs=scores"):
            open_session(spec)


THESIS = ("multihead/table2", "multihead/table3", "multihead/table4")
ROWS = {
    "HeatNet w/o thermal teacher (reproduced)": "released_heatnet",
    **dict.fromkeys(("HeatNet (reproduced)", "HeatNet*"), "released_heatnet"),
    **dict.fromkeys(("HeatNet RGB-only (reproduced)", "HeatNet RGB-only*"), "released_heatnet"),
    "SH-Maximum squares loss": "released_max_squares",
    **dict.fromkeys(("SH-Adv", "SH-Adv(Seg. on IR)", "Multi-head", "Multi-head*"), "released"),
    "Multi-head**": "released",
}


@pytest.mark.parametrize("name", THESIS)
def test_released_rows_of_the_thesis_are_predicted_as_its_code_does(name: str) -> None:
    table = load_table(name)
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
