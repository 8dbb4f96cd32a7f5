from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from analysis.spatial import entry
from analysis.statistics.collect import MeasurementSettings, collect
from analysis.statistics.comparison import Resampling, comparison_grids
from rgbt.checks import InputError
from rgbt.metrics.metric import Regions
from rgbt.tables import ABSENT
from rgbt.types import Sample
from tests.analysis.statistics.scenes import InMemory, made
from tests.commands import Call

WAY = ("immerkaer", "pooled")
DRAWS = Resampling(resamples=200, blocks=2)


def test_levels_and_their_ratio_by_hand() -> None:
    labels = np.full((40, 3, 4), 100, np.int64)
    labels[..., 1] = 50  # of 350 pixels
    first = made(labels=labels, laplacian=np.full((40, 2, 3), 30.0))
    levels, premises = comparison_grids(first, made(), WAY, DRAWS)
    rows = {row[0]: row[1:] for row in levels.rows}
    # All images are alike, so the intervals have no width.
    assert rows["car, % of the pixels"] == (
        *("14.29 [14.29, 14.29]", "25.00 [25.00, 25.00]", "0.571", "[0.571, 0.571]"),
    )
    assert rows["Laplacian variance, thermal, night"][2] == "3.000"
    assert rows["occupancy, %"][0].startswith("71.43")
    assert rows["car, % of the images"][:2] == ("100.00 [100.00, 100.00]",) * 2
    statements = [row[0] for row in premises.rows]
    assert "   rgb / thermal" in statements
    assert "   car: (centre - edge) / (centre + edge)" in statements


def test_interval_of_a_ratio_combines_both() -> None:
    """Relative half widths of 10 % and 20 % on the logarithmic scale: sqrt(0.01 + 0.04)."""
    from analysis.statistics.comparison import _ratio
    from analysis.statistics.resampling import ValueInterval

    above = ValueInterval(6.0, 6.0 * math.exp(-0.1), 6.0 * math.exp(0.1))
    below = ValueInterval(2.0, 2.0 * math.exp(-0.2), 2.0 * math.exp(0.2))
    reach = math.sqrt(0.05)
    assert _ratio(above, below) == (
        "3.000",
        f"[{3 * math.exp(-reach):.3f}, {3 * math.exp(reach):.3f}]",
    )
    assert _ratio(above, ValueInterval(0.0, 0.0, 0.0)) == (ABSENT, ABSENT)


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"classes": ("unlabeled", "car", "curve", "cat")}, "the classes differ"),
        (
            {"background": ()},
            "the background classes differ .unlabeled of made, none of made.; state the same",
        ),
        ({"regions": 5}, "the regions differ .ring3 of made, ring5 of made.; measure both"),
    ],
)
def test_data_sets_that_cannot_be_compared(changed: dict, said: str) -> None:
    with pytest.raises(InputError, match=said):
        comparison_grids(made(), made(**changed), WAY, DRAWS)


def test_images_are_measured_in_the_chosen_size() -> None:
    label = np.zeros((48, 64), np.uint8)
    label[24:, :] = 1
    rgb = np.repeat(np.arange(64, dtype=np.uint8)[None, :, None], 48, 0).repeat(3, 2)
    sample = Sample(rgb, rgb[..., 0], label, "00000D")
    rings = Regions(partition="horizontal", regions=2, aspect=None, absent="released")
    settings = MeasurementSettings(regions=rings, short_edge=12)
    stats = collect(InMemory([sample]), "train", settings)  # type: ignore[arg-type]
    assert stats.region_map.shape == (12, 16)
    assert stats.labels[0, :, :2].tolist() == [[96, 0], [0, 96]]
    # The area mean of columns 0..3 is 1.5, and so on: mean of all columns is 31.5, rounded to even.
    assert stats.mean[0, 1] == pytest.approx([31.5, 31.5], abs=0.5)


def test_command_compares(call: Call, data: Path, tmp_path: Path) -> None:
    words = ("dataset=mfnet", f"dataset.root={data}", "regions=3", "resamples=100")
    assert call(entry, *words, "short_edge=24", f"out={tmp_path / 'a'}")[0] == 0
    stored = tmp_path / "a" / "statistics.npz"
    code, out, err = call(
        entry, *words, "short_edge=24", f"against={stored}", f"out={tmp_path / 'b'}"
    )
    assert code == 0, err
    assert "levels of both data sets" in out
    text = (tmp_path / "b" / "statistics.md").read_text()
    assert "premises of SpatialSeg, Sec. III, on both data sets" in text
    code, _, err = call(entry, *words, f"against={stored}")
    assert code == 2
    assert "against: the image sizes differ (48 64 of mfnet, 24 32 of mfnet)" in err
