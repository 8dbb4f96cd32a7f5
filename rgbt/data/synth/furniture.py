"""Shapes of the classes of street furniture: cones, car stops, guardrails, bumps."""

from __future__ import annotations

from functools import cache

from rgbt.data.synth.shapes import (
    BUMP,
    CAR_STOP,
    COLOR_CONE,
    GUARDRAIL,
    Face,
    Point,
    Shape,
    box,
    rectangle,
    shape_of,
    sideways,
    thin,
    upright,
)

RAIL_STEP_M = 2.0
"""Length of one guardrail segment."""


@cache
def cone() -> Shape:
    """A traffic cone of 0.75 m: a base and five stacked bands, each of two halves."""
    parts = box((-0.2, 0.0, -0.2), (0.2, 0.06, 0.2), "cone_base", COLOR_CONE)
    heights = (0.06, 0.25, 0.39, 0.50, 0.62, 0.75)
    for number, (low, high) in enumerate(zip(heights, heights[1:], strict=False)):
        material = "cone_white" if number % 2 else "cone_orange"
        parts += _wedge((_cone_half(low), _cone_half(high)), (low, high), material, COLOR_CONE)
    return shape_of(parts)


def _cone_half(y: float) -> float:
    return 0.165 - 0.17 * y


def _wedge(
    halves: tuple[float, float], heights: tuple[float, float], material: str, label: int
) -> list[Face]:
    """Left and right half of a round post, meeting in an edge towards the camera."""
    (low_half, high_half), (low, high) = halves, heights
    parts = []
    for side in (-1, 1):
        outline: list[Point] = [(0.0, low, -low_half), (side * low_half, low, 0.0)]
        outline += [(side * high_half, high, 0.0), (0.0, high, -high_half)]
        parts.append(thin(outline, material, label))
    return parts


NUM_STOPS = 3
BOLLARD = 1


@cache
def car_stop(kind: int) -> Shape:
    """A car stop, yellow with black bands: a low long block, a bollard, or a heavy cube."""
    if kind == BOLLARD:
        return _bollard()
    half, height, depth = ((0.85, 0.30, 0.22), (0.0, 0.0, 0.0), (0.38, 0.58, 0.34))[kind]
    parts = box((-half, 0.0, -depth), (half, height, depth), "yellow", CAR_STOP)
    for x in (-half * 0.55, half * 0.55):
        band = rectangle(x - half * 0.14, 0.0, x + half * 0.14, height)
        parts.append(Face(upright(band, -depth - 0.01), "black_band", CAR_STOP))
        parts.append(Face(upright(band, depth + 0.01), "black_band", CAR_STOP))
    return shape_of(parts)


def _bollard() -> Shape:
    bands = (
        (0.0, 0.18, "black_band"),
        (0.18, 0.62, "yellow"),
        (0.62, 0.72, "black_band"),
        (0.72, 0.88, "yellow"),
    )
    parts = []
    for low, high, material in bands:
        parts += _wedge((0.13, 0.13), (low, high), material, CAR_STOP)
    return shape_of(parts)


@cache
def guardrail() -> Shape:
    """Two metres of guardrail along z: post, mesh and a rail of three folds, a filled band."""
    ends = (-RAIL_STEP_M / 2, RAIL_STEP_M / 2)
    strips = (
        (0.10, 0.46, "rail_mesh"),
        (0.46, 0.60, "rail_light"),
        (0.60, 0.70, "rail_dark"),
        (0.70, 0.86, "rail_light"),
    )
    parts = [
        thin(sideways(rectangle(ends[0], low, ends[1], high)), material, GUARDRAIL)
        for low, high, material in strips
    ]
    parts.append(
        thin(
            sideways(rectangle(ends[0], 0.0, ends[0] + 0.14, 0.92)),
            "rail_dark",
            GUARDRAIL,
        )
    )
    parts.append(thin(upright(rectangle(-0.07, 0.0, 0.07, 0.92), ends[0]), "rail_light", GUARDRAIL))
    return shape_of(parts)


NUM_STRIPES = 8


@cache
def bump() -> Shape:
    """A speed bump, 1 m wide (scaled to the lane) and 1.1 m long, striped yellow and black."""
    parts = []
    for z, peak in ((0.55, 0.12), (-0.55, -0.12)):
        for number in range(NUM_STRIPES):
            x0, x1 = (number / NUM_STRIPES - 0.5, (number + 1) / NUM_STRIPES - 0.5)
            material = "black_band" if number % 2 else "yellow"
            corners: list[Point] = [(x0, 0.0, z), (x1, 0.0, z), (x1, 0.08, peak), (x0, 0.08, peak)]
            parts.append(thin(corners, material, BUMP))
    top = [(-0.5, 0.08, -0.12), (0.5, 0.08, -0.12), (0.5, 0.08, 0.12), (-0.5, 0.08, 0.12)]
    return shape_of([*parts[:NUM_STRIPES], thin(top, "yellow", BUMP), *parts[NUM_STRIPES:]])
