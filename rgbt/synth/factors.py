"""The factors of the scenes; no factor changes the random draws of another."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import dataclass
from functools import wraps
from typing import Annotated, Any, Literal, TypeVar, get_type_hints

from annotated_types import Interval, doc

from rgbt.ranges import Share

Made = TypeVar("Made")

# Number of scenes of a split; their names have five digits.
NumScenes = Annotated[int, Interval(ge=1, le=30_000)]

Side = Annotated[int, Interval(ge=32, le=2048), doc("pixels")]
Strength = Annotated[float, Interval(ge=0, le=4)]
Gain = Annotated[float, Interval(ge=0, le=20)]
RadiusGain = Annotated[float, Interval(ge=-0.95, le=20)]
Metres = Annotated[float, Interval(ge=2, le=60)]
Multiple = Annotated[float, Interval(ge=0.1, le=10)]


@dataclass(frozen=True, kw_only=True)
class SceneFactors:
    """Holds the factors of a scene, see ``conf/dataset/synth.yaml``; a study varies one of them.

    A gain by radius changes with the squared radius, from 1 at the centre to 1 + gain in a corner.
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


@dataclass(frozen=True)
class EgoMotion:
    """Holds a motion of the camera between two frames: it turns right, then drives ahead."""

    forward_m: ForwardMetres
    yaw_deg: YawDegrees = 0.0


def with_factors(
    *left_out: str, **defaults: float
) -> Callable[[Callable[..., Made]], Callable[..., Made]]:
    """Let a function of ``factors: SceneFactors`` take every factor as a keyword, as a key is.

    `left_out` are factors that the data set decides itself; `defaults` are those that differ.
    """

    def with_keywords(function: Callable[..., Made]) -> Callable[..., Made]:
        types = get_type_hints(SceneFactors, include_extras=True)
        kind = inspect.Parameter.KEYWORD_ONLY
        added = [
            inspect.Parameter(
                name, kind, default=defaults.get(name, default), annotation=types[name]
            )
            for name, default in vars(SceneFactors()).items()
            if name not in left_out
        ]

        @wraps(function)
        def made(**settings: Any) -> Made:
            factors = {}
            for factor in added:
                factors[factor.name] = settings.pop(factor.name, factor.default)
            return function(factors=SceneFactors(**factors), **settings)

        own = inspect.signature(function)
        kept = [parameter for name, parameter in own.parameters.items() if name != "factors"]
        shown = [*kept, *added]
        made.__signature__ = own.replace(parameters=shown)  # type: ignore[attr-defined]
        made.__annotations__ = {parameter.name: parameter.annotation for parameter in shown}
        return made

    return with_keywords
