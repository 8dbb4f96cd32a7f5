"""SpatialSeg, Fig. 2."""

from __future__ import annotations

import numpy as np
import pytest

from analysis.figures.trends import trend
from rgbt.checks import InputError
from tests.analysis.counts import counts_of

TWO = np.array([[[6, 2], [0, 2]], [[8, 0], [0, 2]]])
"""Region 1: IoU 6/8 and 2/4, Acc 6/8 and 1. Region 2: all right."""


def test_changes_from_the_first_region_by_hand() -> None:
    data = trend("ring", np.array([0.4, 0.1]), {"CRM": counts_of(TWO)}, "released")
    np.testing.assert_allclose(data.ious["CRM"], [62.5, 100])
    np.testing.assert_allclose(data.accuracies["CRM"], [87.5, 100])
    changes = data.changes()
    assert list(changes) == ["IoU (CRM)", "Acc (CRM)", "SOR"]
    np.testing.assert_allclose(changes["IoU (CRM)"], [0, 37.5])
    np.testing.assert_allclose(changes["Acc (CRM)"], [0, 12.5])
    np.testing.assert_allclose(changes["SOR"], [0, -30])


def test_absent_classes_count_by_the_option() -> None:
    lonely = counts_of(np.array([[[4, 0], [0, 0]], [[4, 0], [0, 4]]]))
    released = trend("ring", np.ones(2), {"a": lonely}, "released")
    excluded = trend("ring", np.ones(2), {"a": lonely}, "exclude")
    assert (released.ious["a"][0], excluded.ious["a"][0]) == (50, 100)


@pytest.mark.parametrize("partition", ["vertical2", "ring3"])
def test_counts_of_another_partition_are_refused(partition: str) -> None:
    with pytest.raises(InputError, match=f"'CRM' was counted over {partition}, expected ring2"):
        trend("ring", np.ones(2), {"CRM": counts_of(TWO, partition=partition)}, "released")
