"""Estimate the one homography of a rig, from RGB to thermal pixels, from pairs that it took.

RGB and thermal differ in brightness, so that their edges are compared, by direction without sign.
The correlation of small tiles is averaged over all pairs before its maximum is taken, so that one
pair without texture does no harm. Points are (x, y), pixel centres lie at whole numbers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[Any]
Floats = NDArray[np.float64]
HW = tuple[int, int]

# Standard deviation in pixels before the gradient, and of the neighbourhood that normalises it.
SMOOTHING, NEIGHBOURHOOD = 0.7, 12.0

# Share of the mean gradient of the image added to that of the neighbourhood: noise stays small.
FLOOR = 0.3

# Shorter edge of the images whose shift is found, and of those that are compared at last.
COARSE_EDGE, FINE_EDGE = 60, 240

# Tiles along a column and a row, their size as a share of the shorter edge, and how many of them
# both images have to show.
TILES, TILE, LEAST_TILES = (9, 12), 1 / 3, 24

# Blocks of tiles along a column and a row that the jackknife leaves out, one at a time.
BLOCKS = (3, 4)

# Points along a side of the grid on which uncertainty is stated.
GRID = 21

# A tile counts if it lies within this of the homography, in pixels of the compared images.
NEAR = 1.5

# A pair is an outlier if it is shifted by more against the others, in the same pixels.
APART = 2.0

# An estimate is used if so many tiles agree, and its uncertainty is at most this share of the
# diagonal: 2 pixels of 640 x 480.
LEAST_SHARE, MOST_UNCERTAIN = 0.75, 1 / 400

# Shorter edge, distance searched around a tile, and whether a homography is fitted: else a
# similarity.
STAGES = ((120, 8, False), (FINE_EDGE, 4, False), (FINE_EDGE, 4, True))


@dataclass(frozen=True, eq=False)
class Alignment:
    """Holds a homography with the points that it was fitted to.

    Attributes:
        matrix: (3, 3) float64, pixels (x, y, 1) of RGB to pixels of thermal.
        points: (N, 2) points of RGB.
        partners: (N, 2) the points of thermal measured or clicked for them.
        uncertainty: (21, 21) standard error in thermal pixels on `grid_of` RGB; NaN: unknown.
        share: of the tiles that both images show, those that agree with the homography, 0..1; 1
            where there are none.
        scores: of each pair, its mean correlation of edges after alignment; () where unknown.
        outliers: indices of pairs that are aligned otherwise, and were left out.
    """

    matrix: Floats
    points: Floats
    partners: Floats
    uncertainty: Floats
    share: float = 1.0
    scores: tuple[float, ...] = ()
    outliers: tuple[int, ...] = ()

    @property
    def residuals(self) -> Floats:
        """Return the distance of each partner from its point after the homography, (N,) pixels."""
        return np.asarray(np.linalg.norm(moved(self.matrix, self.points) - self.partners, axis=1))

    def reason(self, rgb_hw: HW) -> str:
        """Say why an estimate for images of this size is not to be used; "" if it is."""
        error = root_mean_square(self.uncertainty)
        if self.share < LEAST_SHARE:
            return f"only {self.share:.0%} of the tiles agree: no texture, night, or no fixed rig"
        if error > MOST_UNCERTAIN * float(np.hypot(*rgb_hw)):
            return f"its uncertainty is {error:.1f} px: too few pairs, no texture, or night"
        return ""


def root_mean_square(values: Floats) -> float:
    """Return the root of the mean of squares."""
    return float(np.sqrt(np.mean(np.square(values))))


def moved(matrix: Floats, points: Floats) -> Floats:
    """Move points (N, 2) by a homography (3, 3); (N, 2) float64."""
    if not len(points):  # of which OpenCV returns None
        return np.empty((0, 2))
    found = cv2.perspectiveTransform(np.asarray(points, np.float64)[:, None], matrix)
    return np.asarray(found[:, 0], np.float64)


def grid_of(hw: HW, number: int = GRID) -> Floats:
    """Return `number` x `number` even points over an image, from edge to edge, row by row."""
    rows, columns = (np.linspace(0, side - 1, number) for side in hw)
    return np.stack([part.ravel() for part in np.meshgrid(columns, rows)], 1)


def resizing(hw: HW, new_hw: HW) -> Floats:
    """Return the homography of a resize, (3, 3): x' = (x + 0.5) s - 0.5."""
    sy, sx = (new / old for new, old in zip(new_hw, hw, strict=True))
    return np.array([[sx, 0, 0.5 * sx - 0.5], [0, sy, 0.5 * sy - 0.5], [0, 0, 1]])


def inverse(matrix: Floats) -> Floats:
    """Return the inverse of a homography."""
    return np.asarray(np.linalg.inv(matrix), np.float64)


def edges(image: Image) -> NDArray[np.float32]:
    """Compute direction and strength of edges of grey levels (H, W): (H, W, 2) float32.

        sqrt(m / n) (cos 2a, sin 2a)

    m, a: magnitude and angle of the gradient; n: its root mean square nearby. An edge from dark to
    bright and one from bright to dark are equal.
    """
    smooth = cv2.GaussianBlur(image.astype(np.float32), (0, 0), SMOOTHING)
    across, down = (cv2.Scharr(smooth, cv2.CV_32F, *order) for order in ((1, 0), (0, 1)))
    square = across**2 + down**2
    usual = np.sqrt(cv2.GaussianBlur(square, (0, 0), NEIGHBOURHOOD))
    usual += FLOOR * np.sqrt(square.mean()) + 1e-6
    strength = np.sqrt(np.sqrt(square) / usual) / (square + 1e-6)
    return np.dstack([(across**2 - down**2) * strength, 2 * across * down * strength])


def estimated(pairs: Sequence[tuple[Image, Image]]) -> Alignment | None:
    """Estimate one alignment of pairs of grey images; None where tiles give no homography at all.

    `pairs` are RGB (H, W) and thermal (H', W'), any real type, of one size each. Whether the
    estimate can be trusted says `Alignment.reason`.
    """
    rgb_hw, thermal_hw = pairs[0][0].shape, pairs[0][1].shape
    small_hw = _with_edge(rgb_hw, FINE_EDGE)
    small = [(_resized(rgb, small_hw), _resized(thermal, small_hw)) for rgb, thermal in pairs]
    start = _shift(small)
    found = _refined(small, start, tuple(range(len(small))))
    if found is None:
        return None
    if found.outliers and len(found.outliers) < len(small) / 2:
        kept = tuple(index for index in range(len(small)) if index not in found.outliers)
        found = _refined(small, start, kept) or found
    before, after = resizing(rgb_hw, small_hw), resizing(small_hw, thermal_hw)
    matrix = after @ found.matrix @ before
    points = moved(inverse(before), found.points)
    return replace(
        found,
        matrix=matrix / matrix[2, 2],
        points=points,
        partners=moved(after, found.partners),
        uncertainty=found.uncertainty * np.sqrt(abs(np.linalg.det(after[:2, :2]))),
    )


def _with_edge(hw: HW, edge: int) -> HW:
    return round(hw[0] * edge / min(hw)), round(hw[1] * edge / min(hw))


def _resized(image: Image, hw: HW) -> Image:
    return np.asarray(
        cv2.resize(image.astype(np.float32), hw[::-1], interpolation=cv2.INTER_AREA), np.float32
    )


def _shift(pairs: Sequence[tuple[Image, Image]]) -> Floats:
    """Find the shift of whole images by the mean correlation of their edges, at a small size."""
    full_hw = pairs[0][0].shape
    hw = _with_edge(full_hw, COARSE_EDGE)
    reach = min(hw) // 5
    total = np.zeros((2 * reach + 1, 2 * reach + 1))
    inner = np.s_[reach : hw[0] - reach, reach : hw[1] - reach]
    for rgb, thermal in pairs:
        one, other = (edges(_resized(image, hw)) for image in (rgb, thermal))
        total += _correlation(other, one[inner])
    dx, dy = _peak(total)[0]
    size = resizing(full_hw, hw)
    shift = np.array([[1, 0, dx], [0, 1, dy], [0, 0, 1]])
    return np.asarray(inverse(size) @ shift @ size, np.float64)


def _refined(
    pairs: Sequence[tuple[Image, Image]], matrix: Floats, used: tuple[int, ...]
) -> Alignment | None:
    """Refine a homography by tiles of the pairs `used`, from coarse to fine."""
    full_hw = pairs[0][0].shape
    for edge, reach, is_homography in STAGES:
        hw = _with_edge(full_hw, edge)
        size = resizing(full_hw, hw)
        local = size @ matrix @ inverse(size)
        centres, sheets = _sheets(pairs, local, hw, reach)
        peaks = [_peak(sheet) for sheet in sheets[list(used)].mean(0)]
        inside = np.array([is_inside for _, is_inside in peaks], bool)
        shifts = np.array([shift for shift, _ in peaks]).reshape(-1, 2)[inside]
        points = centres[inside]
        step, near = _fitted(points, points + shifts, is_homography=is_homography)
        if step is None:
            return None
        matrix = inverse(size) @ local @ step @ size
    matrix = matrix / matrix[2, 2]
    uncertainty = _jackknife(points, points + shifts, full_hw)
    own = np.array([_peak(sheet)[0] for sheet in sheets.mean(1)])
    apart = np.linalg.norm(own - np.median(own[list(used)], 0), axis=1)
    outliers = tuple(np.flatnonzero(apart > APART).tolist())
    scores = tuple(float(sheet[reach, reach]) for sheet in sheets.mean(1))
    return Alignment(
        matrix,
        points[near],
        moved(local, (points + shifts)[near]),  # the last stage is of full size
        uncertainty,
        float(near.sum()) / max(len(centres), LEAST_TILES),
        scores,
        outliers,
    )


def _sheets(
    pairs: Sequence[tuple[Image, Image]], local: Floats, hw: HW, reach: int
) -> tuple[Floats, Floats]:
    """Correlate tiles of RGB with aligned thermal, where thermal shows what is near.

    Returns the middle of each tile, (tiles, 2), and (pairs, tiles, shifts, shifts).
    """
    tile = round(TILE * min(hw))
    tops, lefts = (
        np.linspace(reach, side - tile - reach, number).round().astype(int)
        for side, number in zip(hw, TILES, strict=True)
    )
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    covered = cv2.warpPerspective(np.ones(hw, np.uint8), local, hw[::-1], flags=flags)
    corners, wide = [], tile + 2 * reach
    for top in tops - reach:
        for left in lefts - reach:
            if covered[top : top + wide, left : left + wide].mean() > 0.95:
                corners.append((left, top))
    sheets = np.zeros((len(pairs), len(corners), 2 * reach + 1, 2 * reach + 1))
    for index, (rgb, thermal) in enumerate(pairs):
        warped = cv2.warpPerspective(
            _resized(thermal, hw), local, hw[::-1], flags=flags, borderMode=cv2.BORDER_REPLICATE
        )
        one, other = edges(_resized(rgb, hw)), edges(np.asarray(warped))
        for number, (left, top) in enumerate(corners):
            inner = one[top + reach : top + reach + tile, left + reach : left + reach + tile]
            outer = other[top : top + wide, left : left + wide]
            sheets[index, number] = _correlation(outer, inner)
    return np.array(corners, np.float64).reshape(-1, 2) + reach + (tile - 1) / 2, sheets


def _correlation(image: Image, part: Image) -> Floats:
    """Return the normalised correlation of every shift; 0 where a part has no edge."""
    found = cv2.matchTemplate(image, np.ascontiguousarray(part), cv2.TM_CCOEFF_NORMED)
    return np.nan_to_num(np.asarray(found, np.float64), posinf=0, neginf=0)


def _peak(sheet: Floats) -> tuple[Floats, bool]:
    """Return the shift (x, y) of the maximum, to parts of a pixel; false: it is at the border."""
    row, column = np.unravel_index(sheet.argmax(), sheet.shape)
    at = np.array([column - sheet.shape[1] // 2, row - sheet.shape[0] // 2], np.float64)
    rows, columns = sheet.shape
    if not (0 < row < rows - 1 and 0 < column < columns - 1):
        return at, False
    lines = sheet[row, column - 1 : column + 2], sheet[row - 1 : row + 2, column]
    for axis, (before, top, after) in enumerate(lines):
        bend = before - 2 * top + after
        at[axis] += 0.5 * (before - after) / bend if bend < 0 else 0.0
    return at, True


def _fitted(
    points: Floats, partners: Floats, *, is_homography: bool
) -> tuple[Floats | None, NDArray[np.bool_]]:
    """Fit robustly; the matrix, None without one, and which points are near it."""
    matrix, near = None, np.zeros(len(points), np.uint8)
    if len(points) >= 8 and is_homography:
        matrix, near = cv2.findHomography(points, partners, cv2.USAC_MAGSAC, NEAR)
    elif len(points) >= 8:
        matrix, near = cv2.estimateAffinePartial2D(points, partners, ransacReprojThreshold=NEAR)
    if matrix is None or near.sum() < 8:
        return None, np.zeros(len(points), bool)
    return np.vstack([matrix, [0, 0, 1]])[:3], near.ravel() > 0


def _jackknife(points: Floats, partners: Floats, hw: HW) -> Floats:
    """Compute the standard error on `grid_of` an image, (21, 21), by leaving out blocks of points.

        sqrt((m - 1) / m sum_i |p_i - mean p|^2)

    m: blocks with points; p_i: where the fit without block i moves a point of the grid.

    Source: Efron and Tibshirani, "An Introduction to the Bootstrap", 1993, Eq. 11.5.
    """
    grid, results = grid_of(hw), []
    cells = [
        np.minimum(points[:, axis] * number // hw[1 - axis], number - 1)
        for axis, number in ((0, BLOCKS[1]), (1, BLOCKS[0]))
    ]
    block = cells[1] * BLOCKS[1] + cells[0]
    for left_out in np.unique(block):
        kept = block != left_out
        matrix, _ = _fitted(points[kept], partners[kept], is_homography=True)
        results.append(np.full_like(grid, np.inf) if matrix is None else moved(matrix, grid))
    if len(results) < 4 or not np.isfinite(results).all():
        return np.full((GRID, GRID), np.inf)
    spread = np.square(np.array(results) - np.mean(results, 0)).sum((0, 2))
    error = np.sqrt(spread * (len(results) - 1) / len(results))
    return np.asarray(error, np.float64).reshape(GRID, GRID)
