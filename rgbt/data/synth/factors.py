"""The knobs of the scene generator. Each one is independent: none changes the draws of another."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import dataclass, fields
from functools import wraps
from typing import Any, TypeVar

from rgbt.checks import check_range

Made = TypeVar("Made")

_RANGES: dict[str, tuple[float, float]] = {
    "height": (32, 2048),
    "width": (32, 2048),
    "num_objects": (0, 24),
    "num_far_objects": (0, 64),
    "texture_strength": (0, 4),
    "rgb_noise": (0, 1),
    "rgb_noise_radius_gain": (0, 20),
    "rgb_noise_dark_gain": (0, 20),
    "thermal_noise": (0, 1),
    "thermal_contrast": (0, 4),
    "thermal_drift": (0, 1),
    "night_share": (0, 1),
    "camera_height_m": (0.9, 4),
    "camera_pitch_deg": (-10, 20),
    "field_of_view_deg": (20, 110),
}


@dataclass(frozen=True, kw_only=True)
class SceneFactors:
    """What a scene is made of; a study varies one of these while holding the rest.

    Attributes:
        height: image height in pixels.
        width: image width in pixels.
        num_objects: groups of near objects (a car, some persons, a row of cones), 4 to 26 m away.
        num_far_objects: objects 26 to 90 m away, small and around the vanishing point.
        texture_strength: factor on surface texture, in RGB and thermal; 1 looks natural, 0 is flat.
        rgb_noise: standard deviation of the sensor noise at the centre of a white image,
            1 = full scale.
        rgb_noise_radius_gain: noise at the corners is (1 + this) times the noise at the centre;
            in between it grows with the squared radius.
        rgb_noise_dark_gain: noise of a black image is (1 + this) times the noise of a white one.
        thermal_noise: standard deviation of the thermal noise, 1 = full scale.
        thermal_contrast: factor on all temperature differences; 1 looks natural, 0 is flat.
        thermal_drift: standard deviation of the low-frequency offset of the thermal image,
            1 = full scale.
        night_share: share of scenes at night.
        camera_height_m: height of the camera above the road in metres.
        camera_pitch_deg: downward tilt of the camera in degrees.
        field_of_view_deg: horizontal field of view in degrees.
    """

    height: int = 120
    width: int = 160
    num_objects: int = 7
    num_far_objects: int = 16
    texture_strength: float = 1.0
    rgb_noise: float = 0.012
    rgb_noise_radius_gain: float = 0.5
    rgb_noise_dark_gain: float = 1.5
    thermal_noise: float = 0.012
    thermal_contrast: float = 1.0
    thermal_drift: float = 0.02
    night_share: float = 0.5
    camera_height_m: float = 1.6
    camera_pitch_deg: float = 2.0
    field_of_view_deg: float = 64.0

    def __post_init__(self) -> None:
        """Raise InputError where a factor lies outside its range."""
        for name, (low, high) in _RANGES.items():
            check_range(name, getattr(self, name), low, high)


@dataclass(frozen=True)
class EgoMotion:
    """What the camera does between two consecutive frames: first it turns, then it drives ahead.

    Attributes:
        forward_m: metres along the new viewing direction, on the ground plane.
        yaw_deg: degrees to the right.
    """

    forward_m: float
    yaw_deg: float = 0.0

    def __post_init__(self) -> None:
        """Raise InputError where a motion is larger than between two frames of a video."""
        check_range("ego_forward_m", self.forward_m, -3, 3)
        check_range("ego_yaw_deg", self.yaw_deg, -15, 15)


def with_factors(
    *left_out: str, **defaults: float
) -> Callable[[Callable[..., Made]], Callable[..., Made]]:
    """Lets a function of ``factors: SceneFactors`` take each factor as a keyword of its own.

    The keys of a data set in the configuration are the arguments of the function that makes it, so
    its signature shows every factor without naming it a second time.

    Args:
        left_out: factors that the data set decides itself; they keep their default.
        defaults: of factors that have another one in this data set.

    Returns:
        decorator; what it makes takes keywords alone.
    """

    def with_keywords(function: Callable[..., Made]) -> Callable[..., Made]:
        own = inspect.signature(function)
        added = [
            inspect.Parameter(
                factor.name,
                inspect.Parameter.KEYWORD_ONLY,
                default=defaults.get(factor.name, factor.default),
                annotation=factor.type,
            )
            for factor in fields(SceneFactors)
            if factor.name not in left_out
        ]

        @wraps(function)
        def made(**settings: Any) -> Made:
            chosen = {each.name: settings.pop(each.name, each.default) for each in added}
            return function(factors=SceneFactors(**chosen), **settings)

        kept = [each for each in own.parameters.values() if each.name != "factors"]
        made.__signature__ = own.replace(parameters=[*kept, *added])  # type: ignore[attr-defined]
        made.__annotations__ = {each.name: each.annotation for each in [*kept, *added]}
        made.__annotations__["return"] = own.return_annotation
        return made

    return with_keywords
