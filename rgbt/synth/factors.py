"""The factors of the scenes; no factor changes the random draws of another."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import dataclass, fields
from functools import wraps
from typing import Annotated, Any, Literal, TypeVar, get_type_hints

from annotated_types import Interval, doc

from rgbt.ranges import Share

Made = TypeVar("Made")

NumScenes = Annotated[int, Interval(ge=1, le=30_000)]
"""Of a split; names have five digits."""

Side = Annotated[int, Interval(ge=32, le=2048), doc("pixels")]
Strength = Annotated[float, Interval(ge=0, le=4)]
Gain = Annotated[float, Interval(ge=0, le=20)]
RadiusGain = Annotated[float, Interval(ge=-0.95, le=20)]
"""Corners have (1 + this) times the value of the centre; negative: the centre has more."""

Metres = Annotated[float, Interval(ge=2, le=60)]
Multiple = Annotated[float, Interval(ge=0.1, le=10)]


@dataclass(frozen=True, kw_only=True)
class SceneFactors:
    """The factors of a scene; a study varies one of them and keeps the others fixed.

    Attributes:
        height: image height in pixels.
        width: image width in pixels.
        num_objects: groups of near objects (a car, some persons, a row of cones), 4 to 26 m away.
        num_far_objects: objects 26 to 90 m away, small and around the vanishing point.
        texture_strength: factor on surface texture, in RGB and thermal; 1 looks natural, 0 is flat.
        rgb_noise: standard deviation of the sensor noise at the centre of a white image,
            1 = full scale.
        rgb_noise_radius_gain: noise at the corners is (1 + this) times the noise at the centre;
            in between it changes with the squared radius. Negative: more noise in the centre.
        rgb_noise_dark_gain: noise of a black image is (1 + this) times the noise of a white one.
        thermal_noise: standard deviation of the thermal noise, 1 = full scale.
        thermal_contrast: factor on all temperature differences; 1 looks natural, 0 is flat.
        thermal_drift: standard deviation of the low-frequency offset of the thermal image,
            1 = full scale.
        night_share: share of scenes at night.
        camera_height_m: height of the camera above the road in metres.
        camera_pitch_deg: downward tilt of the camera in degrees.
        field_of_view_deg: horizontal field of view in degrees.
        thermal_noise_radius_gain: as for RGB.
        texture_radius_gain: the same for the strength of the texture, in RGB and thermal.
        night_light: factor on all light by night except lamps seen directly.
        glare: strength of the veil around headlights that point at the camera, and around a low
            sun in a third of the clear days; 0: none.
        passive_contrast: factor on the difference between the temperature of the road and that of
            markings, kerbs, cones, car stops, bumps, guardrails and bicycles; 0: only RGB
            distinguishes them from the road.
        far_object_scale: factor on the size of far objects.
        object_mix: shares of the kinds of objects; demo: each kind is frequent; mfnet: more cars,
            fewer cones and car stops, as in the labels of MFNet.
        rail_share: share of scenes with a guardrail.
        bump_share: share of scenes with a bump.
        bump_nearest_m: distance of the nearest bumps in metres.
        bump_farthest_m: distance of the farthest bumps in metres.
        kerb_share: factor on the share of streets with kerbs.
        kerb_scale: factor on the width and height of kerbs.
        vignette: share of the light that the lens takes at the corners of RGB; 0: none.
        whole_shadows: whether an object's shadow by day is drawn although a part of it lies behind
            the camera; false leaves such shadows out, so that a camera that drives past an object
            loses them.
    """

    height: Side = 120
    width: Side = 160
    num_objects: Annotated[int, Interval(ge=0, le=24)] = 7
    num_far_objects: Annotated[int, Interval(ge=0, le=64)] = 16
    texture_strength: Strength = 1.0
    rgb_noise: Share = 0.012
    rgb_noise_radius_gain: RadiusGain = 0.5
    rgb_noise_dark_gain: Gain = 1.5
    thermal_noise: Share = 0.012
    thermal_contrast: Strength = 1.0
    thermal_drift: Share = 0.02
    night_share: Share = 0.5
    camera_height_m: Annotated[float, Interval(ge=0.9, le=4)] = 1.6
    camera_pitch_deg: Annotated[float, Interval(ge=-10, le=20)] = 2.0
    field_of_view_deg: Annotated[float, Interval(ge=20, le=110)] = 64.0
    thermal_noise_radius_gain: RadiusGain = 0.0
    texture_radius_gain: RadiusGain = 0.0
    night_light: Strength = 1.0
    glare: Strength = 0.0
    passive_contrast: Strength = 1.0
    far_object_scale: Multiple = 1.0
    object_mix: Literal["demo", "mfnet"] = "demo"
    rail_share: Share = 0.55
    bump_share: Share = 0.6
    bump_nearest_m: Metres = 4.2
    bump_farthest_m: Metres = 11.7
    kerb_share: Share = 1.0
    kerb_scale: Multiple = 1.0
    vignette: Share = 0.18
    whole_shadows: bool = False


ForwardMetres = Annotated[float, Interval(ge=-3, le=3)]
YawDegrees = Annotated[float, Interval(ge=-15, le=15)]
"""What a camera moves between two frames of a video."""


@dataclass(frozen=True)
class EgoMotion:
    """Motion of the camera between two consecutive frames: first it turns, then it drives ahead.

    Attributes:
        forward_m: metres along the new viewing direction, on the ground plane.
        yaw_deg: degrees to the right.
    """

    forward_m: ForwardMetres
    yaw_deg: YawDegrees = 0.0


def with_factors(
    *left_out: str, **defaults: float
) -> Callable[[Callable[..., Made]], Callable[..., Made]]:
    """Lets a function of ``factors: SceneFactors`` take each factor as a keyword of its own.

    The keys of a data set in the configuration are the arguments of the function that makes it, so
    its signature shows every factor without naming it a second time.

    Args:
        left_out: factors that the data set decides itself; they keep their default.
        defaults: of factors that have another one in this data set.
    """

    def with_keywords(function: Callable[..., Made]) -> Callable[..., Made]:
        own = inspect.signature(function)
        types = get_type_hints(SceneFactors, include_extras=True)
        added = {
            each.name: inspect.Parameter(
                each.name,
                inspect.Parameter.KEYWORD_ONLY,
                default=defaults.get(each.name, each.default),
                annotation=types[each.name],
            )
            for each in fields(SceneFactors)
            if each.name not in left_out
        }

        @wraps(function)
        def made(**settings: Any) -> Made:
            chosen = {name: settings.pop(name, each.default) for name, each in added.items()}
            return function(factors=SceneFactors(**chosen), **settings)

        kept = [each for each in own.parameters.values() if each.name != "factors"]
        parameters = [*kept, *added.values()]
        made.__signature__ = own.replace(parameters=parameters)  # type: ignore[attr-defined]
        made.__annotations__ = {each.name: each.annotation for each in parameters}
        return made

    return with_keywords
