"""SpatialSeg, Fig. 3."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from analysis.figures.classes import class_regions, draw
from rgbt.checks import InputError
from tests.analysis.counts import counts_of
from tests.analysis.figures.drawn import statistics, strips, texts

HALVES = strips(2)


def two_images() -> np.ndarray:
    """Car: 6 pixels on the left, 3 on the right; color_cone: none, 2 on the right."""
    labels = np.zeros((2, 3, 4), np.uint8)
    labels[0, :, :2] = 1
    labels[1, :, 3] = 1
    labels[0, :2, 2] = 2
    return labels


def test_shares_of_the_largest_region_by_hand() -> None:
    data = class_regions(statistics(two_images(), HALVES, None))
    assert data.classes == ("car", "color_cone")
    np.testing.assert_allclose(data.shares, [[100, 50], [0, 100]])
    assert data.miou is None


def test_class_that_occurs_nowhere_has_no_share_and_a_remark(tmp_path: Path) -> None:
    labels = np.minimum(two_images(), 1)
    data = class_regions(statistics(labels, HALVES, None))
    assert np.isnan(data.shares[1]).all()
    assert "color cone (none)" in texts(draw(data, ("test", "test")), tmp_path)


def test_miou_of_a_method_over_the_same_regions(tmp_path: Path) -> None:
    matrices = np.array([[[6, 2], [0, 2]], [[8, 0], [0, 2]]])
    method = "CRM-B", counts_of(matrices, partition="vertical2")
    data = class_regions(statistics(two_images(), HALVES, None), "all", method)
    np.testing.assert_allclose(data.miou, [62.5, 100])
    found = texts(draw(data, ("test", "test")), tmp_path)
    assert {"car", "color cone", "mIoU (CRM-B)"} <= set(found)


def test_the_miou_is_of_the_same_part_as_the_shares(tmp_path: Path) -> None:
    matrices = np.array([[[[6, 2], [0, 2]]] * 2, [[[8, 0], [0, 2]]] * 2])
    by_day = counts_of(matrices, partition="vertical2")
    stats = statistics(two_images(), HALVES, np.array([False, True]))
    known = replace(by_day, night=(False, True))
    data = class_regions(stats, "night", ("CRM-B", known))
    np.testing.assert_allclose(data.miou, [100, 100])
    np.testing.assert_allclose(class_regions(stats, "day", ("CRM-B", known)).miou, [62.5, 62.5])
    assert "region (vertical2); images of the night" in texts(
        draw(data, ("test", "test")), tmp_path
    )
    for night in (None, (False, False)):
        with pytest.raises(InputError, match="counts of 'CRM-B' contain no image of the night"):
            class_regions(stats, "night", ("CRM-B", replace(by_day, night=night)))


def test_counts_over_other_regions_are_refused() -> None:
    method = "CRM-B", counts_of(np.ones((2, 2, 2), int))
    with pytest.raises(InputError, match="'CRM-B' was counted over ring2 but the statistics over"):
        class_regions(statistics(two_images(), HALVES, None), "all", method)
