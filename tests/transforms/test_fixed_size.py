"""Padding, colours and published numbers of transforms whose steps are in `test_releases`."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from rgbt.assembly import training_setup
from rgbt.assembly.training_setup import TrainingSetup
from rgbt.checks import InputError
from rgbt.config.component import build
from rgbt.config.compose import compose
from rgbt.requirements import TransformRecord, record_of
from rgbt.transforms.fixed_size import recoloured
from rgbt.types import IGNORE
from tests.composed import specified
from tests.transforms.recipes import noise
from tests.transforms.test_releases import made


@pytest.mark.parametrize("inputs", ["cmx", "cmx_released", "temporal", "crm", "unit"])
def test_padding_is_zero_for_the_network(inputs: str) -> None:
    """To half a grey level; thermal on the mean of its channels."""
    config = compose(["model=cmx_tiny", f"model/inputs={inputs}", "transform=cmx_released"])
    transform, normalise = build(config.transform), build(config.model.inputs)
    transform = replace(transform, factors=(0.5,))
    bare = noise(hw=(120, 160), label=np.zeros((120, 160), np.uint8))
    example = transform.train(bare, np.random.default_rng(8))
    outside = torch.from_numpy(example.label == IGNORE)
    rgb = torch.from_numpy(example.rgb).permute(2, 0, 1)[None] / 255
    images = normalise(rgb, torch.from_numpy(example.thermal)[None, None] / 255)
    half_level = (0.5 / 255) / min(normalise.rgb_std.min(), normalise.thermal_std.min())
    assert outside.float().mean() == 0.75
    assert images.rgb[0][:, outside].abs().max() <= half_level * 1.001
    grey_levels = images.thermal[0][:, outside] * normalise.thermal_std.view(-1, 1) * 255
    assert grey_levels.mean(0).abs().max() <= 0.501


def test_recoloured_by_hand() -> None:
    """(100, 50, 20): half as bright (50, 25, 10), luma 30; contrast 2 about 30: (70, 20, 0)."""
    image = np.full((2, 2, 3), (100, 50, 20), np.uint8)
    assert recoloured(image, 0.5, 1.0, 1.0)[0, 0].tolist() == [50, 25, 10]
    assert recoloured(image, 0.5, 2.0, 1.0)[0, 0].tolist() == [70, 20, 0]
    # Luma of (70, 20, 0) is 32: half the saturation is half way to it.
    assert recoloured(image, 0.5, 2.0, 0.5)[0, 0].tolist() == [51, 26, 16]
    np.testing.assert_array_equal(recoloured(image, 1.0, 1.0, 1.0), image)


def test_heatnet_target_keeps_blocks_and_thermal(monkeypatch: pytest.MonkeyPatch) -> None:
    chances = ("drop_probability", "thermal_probability", "class_probability")
    full = replace(made("heatnet"), **dict.fromkeys(chances, 1.0))
    target = record_of(full, TransformRecord).for_target
    assert target == replace(full, **dict.fromkeys(chances, 0.0))
    assert record_of(target, TransformRecord).for_target is None
    # Training takes the transform of each domain.
    taken: list[Any] = []
    monkeypatch.setattr(
        training_setup, "train_batches", lambda *given: taken.append(given[2]) or SimpleNamespace()
    )
    monkeypatch.setattr(training_setup, "PairedBatches", lambda *_, **__: None)
    spec = specified(("+experiment=heatnet_original",))
    named = {"domains": spec.domains, "loading": spec.data, "trainer": spec.trainer}
    session: Any = SimpleNamespace(spec=spec, transform=full, **named)
    setup: Any = SimpleNamespace(session=session, datasets=dict.fromkeys(("source", "target")))
    setup.rare = None
    TrainingSetup.batches(setup, range(1))
    assert taken == [full, target]


@pytest.mark.parametrize(
    ("changes", "key"),
    [
        *(({"crop_hw": hw}, "crop_hw") for hw in ((48, 77), (49, 60))),
        *(({name: (5, 61)}, "drop_") for name in ("drop_height", "drop_width")),
    ],
)
def test_heatnet_sizes_that_do_not_fit_are_refused(changes: dict[str, Any], key: str) -> None:
    with pytest.raises(InputError, match=f"transform.{key}"):
        replace(made("heatnet"), **changes)


def test_published_numbers_of_the_teacher_and_of_heatnet() -> None:
    """Configuration mv_pspnet50 of the thesis' code; batch and auxiliary weight of semseg."""
    spec = specified(("+experiment=thermal_teacher_semseg", "scale=paper", "dataset.root=x"))
    mean, teacher = (123.675, 116.28, 103.53), spec.transform.build()
    assert (teacher.crop_hw, teacher.padding_rgb) == ((473, 473), mean)
    assert teacher.padding_thermal == pytest.approx(sum(mean) / 3)
    optimizer = spec.optimizer.values
    assert (optimizer["lr"], optimizer["backbone_multiplier"]) == (0.1, 0.1)
    assert (optimizer["momentum"], optimizer["weight_decay"]) == (0.9, 1e-4)
    assert (spec.loss.values["weight"], spec.data.batch_size) == (0.4, 16)
    assert spec.trainer.max_steps == 400 * (12170 // 16)
    assert (spec.prediction.window_hw, spec.prediction.mirrored) == ((473, 473), True)
    assert spec.schedule.build()(152000, 304000, 760) == pytest.approx(0.5**0.9)
    # 320 x 960 of 650 x 1920; columns 148 to 851 in the test, 150 to 849 in training.
    spec = specified(("+experiment=heatnet_original", "scale=paper", "dataset.root=x"))
    assert spec.dataset.values["crop"] == (0, 650, 2 * 148, 2 * 852)
    assert spec.dataset.values["thermal_range"] == (21800, 25000)
    assert (spec.data.batch_size, spec.trainer.max_steps) == (8, 200 * 1506)
    assert (spec.prediction.counted, spec.prediction.label_resize) == ("image", "nearest")
