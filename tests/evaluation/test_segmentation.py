"""Tables from counts, with numbers that can be followed by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rgbt.evaluation.tables import result_tables
from rgbt.metrics.counts import Counts
from rgbt.metrics.metric import Regions
from tests.measured import measurement


def test_result_tables_of_two_regions_and_two_classes() -> None:
    # Two classes, two regions, one image by day and one by night.
    day = [[[6, 0], [2, 2]], [[10, 0], [0, 0]]]
    night = [[[4, 2], [0, 4]], [[8, 2], [0, 0]]]
    counts = Counts(
        counts=np.array([day, night]),
        names=("1D", "2N"),
        night=(False, True),
        classes=("road", "car"),
        measurement=measurement(partition="ring2"),
    )
    regions = Regions(partition="ring", regions=2, aspect="image", absent="released")
    tables = result_tables(counts, regions, "mine", step=7)

    # Whole image: road 28 of 34 (28 right, 4 missed, 2 wrongly road), car 6 of 12.
    assert tables.classes.ious == pytest.approx((28 / 34, 6 / 12))
    assert tables.classes.accuracies == pytest.approx((28 / 32, 6 / 8))
    assert tables.regions.miou == pytest.approx((28 / 34 + 6 / 12) / 2)
    # Ring 1: road 10 of 14, car 6 of 10. Ring 2: road 18 of 20, car 0 of 2.
    rings = ((10 / 14 + 6 / 10) / 2, (18 / 20 + 0) / 2)
    assert tables.regions.region_ious == pytest.approx(rings)
    spread = 100 * (rings[0] - rings[1]) / 2
    assert tables.regions.variance == pytest.approx(spread**2)
    assert tables.classes.region_ious[1] == pytest.approx((6 / 10, 0))
    # Day: road 16 of 18, car 2 of 4. Night: road 12 of 16, car 4 of 8.
    assert tables.classes.subset_mious["day"] == pytest.approx((16 / 18 + 2 / 4) / 2)
    assert tables.classes.subset_mious["night"] == pytest.approx((12 / 16 + 4 / 8) / 2)
    assert (tables.region_names, tables.step) == (("ring_1", "ring_2"), 7)

    # Without the car every mean is what the road alone has; the classes stay as they are.
    road = result_tables(replace(counts, unscored=("car",)), regions, "mine", step=7)
    assert road.regions.miou == pytest.approx(28 / 34)
    assert road.regions.region_ious == pytest.approx((10 / 14, 18 / 20))
    assert road.regions.variance == pytest.approx((100 * (18 / 20 - 10 / 14) / 2) ** 2)
    assert road.classes.subset_mious == pytest.approx({"day": 16 / 18, "night": 12 / 16})
    assert road.classes == replace(
        tables.classes, unscored=("car",), subset_mious=road.classes.subset_mious
    )
