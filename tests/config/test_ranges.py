"""Every number and text that a configuration can set has a range, declared at its constructor."""

from __future__ import annotations

import re
import types
import typing
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import pytest
from annotated_types import Gt, Interval, Len, MultipleOf
from hydra.utils import get_object
from omegaconf import OmegaConf

from rgbt.checks import InputError
from rgbt.config.component import setting_types
from rgbt.config.compose import conf_dir
from rgbt.config.values import check_value, expected
from rgbt.ranges import Pixels, Share
from rgbt.spec.run_spec import VALUES
from sweeps.settings import SweepSettings

TARGETS = sorted(
    {
        target
        for path in conf_dir().rglob("*.yaml")
        for target in re.findall(r"_target_: (rgbt[\w.]+)", path.read_text())
    }
)
"""Constructors that the configuration names."""

OUTSIDE: dict[str, dict[str, list[Any]]] = {
    "data.domains.Domain": {"threshold": [-0.1, 1.0], "split": [""]},
    "data.folder.dataset.Folder": {"num_classes": [0, 256], "shares": [{"train": 1.5}]},
    "data.label_map.LabelMap": {"num_source": [0], "targets": [[]]},
    "data.loaders.LoaderSettings": {
        **{"batch_size": [0, 10**9], "num_workers": [-1, 10**6], "on_error": ["skpi"]},
        **{"sampling": ["rare"], "class_temperature": [0], "min_class_pixels": [-1]},
        "min_crop_ratio": [-0.1],
    },
    "data.synth.dataset.synth": {
        **{"height": [8, 10**6], "night_share": [1.5], "num_val": [0], "ego_forward_m": [9.0]},
    },
    "data.synth.freiburg.synth_freiburg": {"num_test": [1], "num_train_night": [0], "width": [8]},
    "corruptions.pixels.Occluded": {"block": [0, 481], "severities": [[]]},
    "engine.optimizers.AdamW": {"lr": [0, -1], "eps": [0], "backbone_multiplier": [-1]},
    "engine.optimizers.SGD": {"lr": [0.0], "momentum": [1.0], "weight_decay": [-1.0]},
    "engine.schedules.LatePoly": {
        **{"power": [-1], "warmup_steps": [-1], "epochs": [0], "epoch_steps": [0]},
    },
    "engine.schedules.Steps": {"factor": [1.5], "every": [0.0, 1.5]},
    "engine.settings.Scale": {"pixel_factor": [0], "crop_hw": [[], [0, 5], [10**6, 10**6]]},
    "engine.settings.TrainerSettings": {
        **{"max_steps": [0, 10**18], "eval_every": [0], "accumulate": [0], "threads": [0]},
        **{"clip_norm": [0, -1, float("nan"), float("inf")]},
    },
    "geometry.camera.Camera": {"fx": [0.0], "fy": [float("nan")], "height": [0]},
    "losses.cross_entropy.CrossEntropy": {"class_weights": [[], [1.0, -1.0]]},
    "losses.feature_distance.FeatureDistance": {
        **{"weight": [0], "things": [[]], "min_share": [0.5, 1.1]},
    },
    "losses.set_criterion.SetCriterion": {
        **{"num_points": [0], "oversample_ratio": [0.5], "importance_ratio": [1.5]},
        "mask_weight": [-1],
    },
    "losses.spatial.SpatialWeight": {"alpha": [-1.0, float("nan")]},
    "losses.temporal.TemporalLoss": {"alpha": [-0.5, float("nan")], "beta": [float("inf")]},
    "losses.unlabelled.MaxSquares": {
        **{"weight": [-1.0], "image_wise_ratio": [1.5], "normalisation": ["pixel"]},
    },
    "maskers.masker.Masker": {
        **{"patch_size": [0, 6], "ratio": [1.3, -0.1], "sigma_div": [0, -1]},
        "pattern_probabilities": [[1.5, -0.5, 0], [0.5, 0.5]],
    },
    "metrics.metric.Regions": {"regions": [0, 256]},
    "models.cmx.model.CMX": {"depths": [[1, 0, 1, 1]], "drop_path_rate": [1.0], "sr_ratios": [[0]]},
    "models.deeplabv2.model.DeepLabV2": {
        **{"decoder": ["modified"], "heads": [[]], "rates": [[], [0]], "dropout": [[1.0, 0.0]]},
        **{"base_width": [-1], "depths": [[1, 1, 1, 0]]},
    },
    "models.inputs.Inputs": {"rgb_std": [[1.0, 0.0, 1.0]], "thermal_mean": [[], [256.0]]},
    "models.mask2former.model.Mask2Former": {
        **{"share_start": [5], "fusion": ["mean"], "drop_path_rate": [1.0], "num_queries": [0]},
        "depths": [[1, 1, 0, 1]],
    },
    "models.pspnet.PSPNet": {
        **{"modalities": ["late"], "depths": [[1, 0, 1, 1]], "base_width": [0]},
        **{"decoder_width": [0], "dropout": [[0.3, 1.0]]},
    },
    "schemes.two_domains.UnlabelledTarget": {
        **{"guidance_weight": [-1.0], "guidance_threshold": [1.5]},
    },
    "transforms.cmx.CmxTransform": {
        **{"flip_probability": [-1.0], "factors": [[], [1.0, 0.0]], "crop_hw": [[48, 0]]},
        **{"padding_rgb": [[0.0, 0.0, 256.0]], "padding_thermal": [[-1.0], []]},
        **{"test_short_edge": [0], "padding_order": ["grb"]},
    },
    "transforms.cmnext.CmnextTransform": {
        **{"colour_probability": [1.5], "colour_range": [[1.5, 0.5]], "blur_probability": [-0.1]},
        **{"blur_deviation": [0.0], "scale_range": [[2.0, 0.5], [0.0, 1.0]]},
    },
    "transforms.crm.CrmTransform": {
        **{"sizes": [[], [0, 24], [10**6]], "crop_hw": [[0, 10]], "max_size": [0]},
        **{"test_short_edge": [-1], "flip_probability": [2.0], "colour": ["relased"]},
        **{"colour_probability": [1.5], "brightness_delta": [-1.0], "hue_delta": [181]},
        **{"contrast_range": [[1.5, 0.5]], "thermal_contrast_range": [[-1.0, 0.5]]},
    },
    "transforms.rtfnet.RtfnetTransform": {"cut_share": [0.6, -0.1], "crop_hw": [[0, 4]]},
    "transforms.thesis.ThesisTransform": {
        **{"blur_probability": [-0.1], "blur_kernel": [4, -1], "label_resize": ["linear"]},
    },
    "transforms.virtual_view.VirtualView": {
        **{"angles": ["whole"], "mode": ["rot"], "outside": ["black"], "yaw": [[-61.0, 0.0]]},
        **{"pitch": [[0.0, float("nan")]], "roll": [[1.0, -1.0]]},
    },
}
"""Values just outside, by constructor and setting; written by hand, not derived from the types."""


@pytest.mark.parametrize("target", OUTSIDE)
def test_values_outside_a_range_are_refused(target: str) -> None:
    hints = setting_types(get_object(f"rgbt.{target}"))
    for key, values in OUTSIDE[target].items():
        for value in values:
            with pytest.raises(InputError, match=rf"^'node\.{key}[^']*' must be"):
                check_value(f"node.{key}", value, hints[key])


def leaves(annotation: Any) -> typing.Iterator[Any]:
    """Numbers and texts inside an annotation."""
    base, *limits = (
        typing.get_args(annotation) if typing.get_origin(annotation) is Annotated else (annotation,)
    )
    if base in (int, float, str):
        yield annotation
    elif typing.get_origin(base) in (tuple, dict, typing.Union, types.UnionType):
        args = [each for each in typing.get_args(base) if each is not ...]
        own = args[1:] if typing.get_origin(base) is dict else args
        yield from (leaf for each in own for leaf in leaves(each))


def bounded(annotation: Any) -> bool:
    """Whether a number has both ends, or a text a length."""
    words = expected(annotation)
    return bool(re.search(r"from .* to|(above|at least) .* and (at most|below)|of \d+ to", words))


@pytest.mark.parametrize("target", [*TARGETS, "sweeps.settings.SweepSettings"])
def test_every_number_and_text_has_a_range(target: str) -> None:
    for key, annotation in setting_types(get_object(target)).items():
        for leaf in leaves(annotation):
            assert bounded(leaf), f"{target}.{key}: declare a range for {leaf} (rgbt.ranges)"


def test_top_level_keys_have_a_range() -> None:
    assert all(bounded(leaf) for each in VALUES.values() for leaf in leaves(each))
    assert check_value("seed", 0, VALUES["seed"]) == 0
    for wrong in (-1, 2**32, True, 0.5, None):
        with pytest.raises(InputError, match="'seed' must be a whole number at least 0 and below"):
            check_value("seed", wrong, VALUES["seed"])


# ---- sentences ------------------------------------------------------------------------------


@dataclass(frozen=True)
class Plain:
    one: Share
    other: Literal["a", "b"]


@pytest.mark.parametrize(
    ("annotation", "words"),
    [
        (float, "a number"),
        (Annotated[float, Gt(0)] | None, "a number above 0, or null"),
        (Annotated[int, Interval(ge=2, le=9)], "a whole number from 2 to 9"),
        (Annotated[float, Interval(ge=0, lt=1)], "a number at least 0 and below 1"),
        (
            Annotated[int, Interval(ge=4), MultipleOf(4)],
            "a whole number at least 4 (multiples of 4)",
        ),
        (Literal["a", "b", "c"], "'a', 'b' or 'c'"),
        (tuple[int, str], "a list of 2: a whole number; a text"),
        (Annotated[tuple[int, ...], Len(1, 5)], "a list of 1 to 5, each a whole number"),
        (int | tuple[int, ...], "a whole number or a list, each a whole number"),
        (dict[str, float], "a mapping whose values are each a number"),
        (Plain, "a mapping with one, other"),
    ],
)
def test_what_is_expected_in_words(annotation: Any, words: str) -> None:
    assert expected(annotation) == words


@pytest.mark.parametrize(
    ("value", "annotation", "sentence"),
    [
        (float("nan"), float, "'a.b' must be a number, got NaN."),
        ([1.0, float("-inf")], tuple[float, ...], "'a.b[1]' must be a number, got -Infinity."),
        (
            [1, 0],
            tuple[Pixels, ...],
            "'a.b[1]' must be a whole number from 1 to 8192 (pixels), got 0",
        ),
        (
            [{"one": 2, "other": "a"}],
            tuple[Plain, ...],
            "'a.b[0].one' must be a number from 0 to 1",
        ),
        ("x" * 500, int, f"'a.b' must be a whole number, got \"{'x' * 79}...."),
        (
            "\x00",
            VALUES["name"],
            "'a.b' must be a text of 1 to 4096 (printable",
        ),
    ],
)
def test_a_refused_value_is_named_with_its_place_and_range(
    value: Any, annotation: Any, sentence: str
) -> None:
    with pytest.raises(InputError) as raised:
        check_value("a.b", value, annotation)
    assert str(raised.value).startswith(sentence)
    assert "\n" not in str(raised.value)


def test_settings_of_a_sweep_are_those_of_its_file() -> None:
    node = OmegaConf.load(conf_dir() / "hydra" / "sweeper" / "study.yaml")
    assert set(setting_types(SweepSettings)) == set(node) - {"_target_"}
