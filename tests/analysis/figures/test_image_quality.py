"""SpatialSeg, Figs. 5 and 6."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from analysis.figures.image_quality import draw, laplacian_series, snr_series
from analysis.statistics.data import SpatialStatistics
from analysis.statistics.resampling import ConsecutiveBlocks
from tests.analysis.figures.drawn import statistics, strips, texts

LABELS = np.zeros((40, 4, 6), np.uint8)
NIGHT = np.arange(40) >= 20


@pytest.fixture
def measured() -> SpatialStatistics:
    """See `drawn.statistics` for its values."""
    return statistics(LABELS, strips(3), NIGHT)


def blocks(stats: SpatialStatistics) -> ConsecutiveBlocks:
    return ConsecutiveBlocks(stats, size=2, resamples=400)


def test_laplacian_by_hand(measured: SpatialStatistics) -> None:
    """Mean over images n of 10 (m + 1) (n + 1) + r: n + 1 averages 20.5, 10.5, 30.5."""
    data = laplacian_series(measured, blocks(measured))
    means = {"all": 205, "day": 105, "night": 305}
    for part, mean in means.items():
        np.testing.assert_allclose(data.values["rgb", part], mean + np.arange(3))
        np.testing.assert_allclose(data.values["thermal", part], 2 * mean + np.arange(3))
    assert data.images == {"all": 40, "day": 20, "night": 20}
    assert not data.is_log


def test_snr_by_hand(measured: SpatialStatistics) -> None:
    """Pooled: mean of 100 + n over (m + 1) (r + 1)."""
    data = snr_series(measured, blocks(measured), "immerkaer", "pooled")
    np.testing.assert_allclose(data.values["rgb", "all"], 119.5 / np.array([1, 2, 3]), rtol=1e-5)
    np.testing.assert_allclose(
        data.values["thermal", "night"], 129.5 / np.array([2, 4, 6]), rtol=1e-5
    )
    other = snr_series(measured, blocks(measured), "std", "images")
    np.testing.assert_allclose(other.values["rgb", "day"], np.full(3, 109.5 / 20), rtol=1e-5)
    assert "std" in other.measure


@pytest.mark.parametrize("part", ["all", "day", "night"])
def test_intervals_are_of_the_blocks_of_their_part(measured: SpatialStatistics, part: str) -> None:
    """All: 20 blocks in two strata; day and night: 10 blocks each."""
    drawn_from = blocks(measured)
    laplacian = laplacian_series(measured, drawn_from)
    snr = snr_series(measured, drawn_from, "immerkaer", "pooled")
    means = drawn_from.mean(measured.laplacian, part)
    noise = drawn_from.mean(measured.noise["immerkaer"], part)
    ratios = drawn_from.mean(measured.mean, part) / noise
    quantile = 2.10092204024096 if part == "all" else 2.26215716279821  # t of 18 and of 9 degrees
    for series, samples in ((laplacian, means), (snr, ratios)):
        for index, modality in enumerate(("rgb", "thermal")):
            logs = np.log(samples[:, index])
            reach = quantile * logs[1:].std(0) * np.sqrt(10 / 9)
            expected = np.exp([logs[0] - reach, logs[0] + reach])
            np.testing.assert_allclose(series.bands[modality, part], expected, rtol=1e-5)


def test_a_single_image_has_no_interval_and_is_drawn(tmp_path: Path) -> None:
    single = statistics(LABELS[:1], strips(3), None)
    data = laplacian_series(single, blocks(single))
    assert list(data.values) == [("rgb", "all"), ("thermal", "all")]
    assert np.isnan(data.bands["rgb", "all"]).all()
    assert "RGB, all" in texts(draw(data), tmp_path)


def test_far_modalities_get_a_logarithmic_axis(measured: SpatialStatistics, tmp_path: Path) -> None:
    measured.noise["immerkaer"][:, 0] *= 20
    data = snr_series(measured, blocks(measured), "immerkaer", "pooled")
    assert data.is_log
    figure = draw(data)
    assert figure.axes[0].get_yscale() == "log"
    found = texts(figure, tmp_path)
    assert {
        f"{name}, {part}" for name in ("RGB", "thermal") for part in ("all", "day", "night")
    } <= set(found)
    assert "signal-to-noise ratio (immerkaer)" in found
    assert "(all 40, day 20, night 20)" in found
