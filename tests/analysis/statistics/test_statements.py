"""The statements of SpatialSeg, Sec. III, on data that are made to fulfil them or not."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from analysis.statistics.resampled import ResampledSplit
from analysis.statistics.statements import STATEMENTS, judged, thirds
from analysis.uncertainty import Resampling
from rgbt.checks import InputError
from tests.analysis.statistics.scenes import made

IMAGES = 120
NIGHT = np.arange(IMAGES) >= IMAGES // 2
TENS = Resampling(resamples=1000, blocks=10)
PLAIN = ("", "")


def found_in(*, settings: Resampling = TENS, way: tuple[str, str] = PLAIN, **given) -> pd.DataFrame:
    """The rows of the statements, by key."""
    frame = judged(ResampledSplit(made(images=IMAGES, **given), settings))
    is_way = frame["estimator"] + frame["average"] == "".join(way)
    return frame[is_way].set_index("key")


def verdicts(frame: pd.DataFrame) -> dict[str, str]:
    return frame["verdict"].groupby(level=0).first().to_dict()


def spread(shape: tuple[int, ...], seed: int = 0) -> np.ndarray:
    """Factors around 1 that differ a little from image to image."""
    return np.exp(0.05 * np.random.default_rng(seed).normal(size=shape))


def as_the_paper_says() -> dict[str, np.ndarray]:
    """Rings 1 to 3 that fulfil every claim; a class per column: background, car, curve, bump."""
    labels = np.zeros((IMAGES, 3, 4))
    labels[:] = [[400, 300, 200, 100], [550, 200, 130, 120], [600, 100, 120, 180]]
    laplacian = np.empty((IMAGES, 2, 3))
    laplacian[:, 0] = [300, 250, 200]
    laplacian[:, 1] = [30, 25, 20]
    laplacian[~NIGHT, 0] *= 2
    laplacian[NIGHT, 1] *= 2
    noise = np.empty((IMAGES, 2, 3))
    noise[:, 0] = [12, 11, 10]
    noise[:, 1] = [1.2, 1.1, 1.0]
    noise[NIGHT] *= 2
    return {
        "labels": (labels * spread(labels.shape)).astype(np.int64),
        "laplacian": laplacian * spread(laplacian.shape),
        "noise": noise * spread(noise.shape),
    }


def test_a_sample_as_the_paper_says() -> None:
    frame = found_in(**as_the_paper_says())
    plain = {stated["key"] for stated in STATEMENTS if stated["quantity"] != "snr"}
    assert set(frame.index) == plain - {"occupancy/middle"}
    even = frame.loc["classes/even"]  # curve 0.75; car 0.667 and bump 0.741
    assert even["value"] == pytest.approx(0.75 - (0.667 + 0.741) / 2, abs=0.01)
    expected = dict.fromkeys(frame.index, "holds") | {"entropy/centre": "contradicted"}
    assert verdicts(frame) == expected
    with_and_without = ["holds", "contradicted"]
    assert frame.loc["entropy/centre"]["finding"].tolist() == with_and_without
    for average in ("pooled", "images"):
        noisy = found_in(way=("immerkaer", average), **as_the_paper_says())
        assert set(verdicts(noisy).values()) == {"holds"}
        assert noisy.loc["snr/modality"]["value"] == pytest.approx(10, rel=0.02)
        assert len(noisy.loc["snr/centre"]) == 4


def test_a_sample_that_is_the_other_way_round() -> None:
    given = as_the_paper_says()
    turned = {name: values[..., ::-1] for name, values in given.items() if name != "labels"}
    turned["labels"] = given["labels"][:, ::-1]
    # Modalities stay, day and night change places.
    turned = {name: values[::-1].copy() for name, values in turned.items()}
    turned["noise"][:, 1] *= 20
    found = verdicts(found_in(**turned))
    assert found["laplacian/modality"] == "holds"
    for key in ("occupancy/falls", "laplacian/centre", "laplacian/day_rgb"):
        assert found[key] == "contradicted", key
    assert found["laplacian/day_thermal"] == "contradicted"
    noisy = verdicts(found_in(way=("std", "pooled"), **turned))
    assert set(noisy.values()) == {"contradicted"}


def test_one_rise_among_falls_is_no_fall() -> None:
    labels = np.zeros((IMAGES, 4, 2))
    labels[..., 1] = [400, 200, 300, 100]
    labels[..., 0] = 1000 - labels[..., 1]
    labels = (labels * spread(labels.shape)).astype(np.int64)
    frame = found_in(regions=4, classes=("unlabeled", "car"), labels=labels)
    falls = frame.loc["occupancy/falls"].set_index("contrast")
    assert falls["verdict"].unique().tolist() == ["contradicted"]
    assert falls["finding"].tolist() == ["holds", "holds", "contradicted", "holds"]
    rise = falls.loc["region 2 - region 3, points"]
    assert rise["value"] == pytest.approx(-10, abs=0.3)
    assert rise["low"] < -10 < rise["high"] < 0


def test_too_few_blocks_decide_nothing() -> None:
    """Blocks of 15 are 4 by day and 4 at night, which are refused; of 8 images of "curve", 1."""
    with pytest.raises(InputError, match="an interval needs at least 10"):
        found_in(settings=Resampling(resamples=100, blocks=15), **as_the_paper_says())
    given = as_the_paper_says()
    given["labels"][20:, :, 2] = 0  # curve in 2 blocks of 10
    frame = found_in(**given)
    by_class = frame.loc["classes/central"].set_index("contrast")
    car, curve = (by_class.loc[f"{n}: (centre - edge) / (centre + edge)"] for n in ("car", "curve"))
    assert car["finding"] == "holds"
    assert (curve["finding"], curve["blocks"]) == ("undecided", 2)
    assert np.isnan(curve["low"])
    assert verdicts(frame)["classes/even"] == "undecided"
    given["labels"][..., 3] = 0
    assert "classes/except" not in found_in(**given).index


def test_most_classes_are_more_than_half() -> None:
    labels = np.full((IMAGES, 3, 5), 100.0)
    labels[..., 1] = [300, 200, 100]
    labels[..., 2] = [100, 200, 300]
    labels[..., 3] = [300, 200, 100]
    given = {"classes": ("unlabeled", "car", "person", "bike", "bump")}
    for third, verdict in ((1, "holds"), (-1, "contradicted")):
        labels[..., 3] = labels[0, :, 1][::third]
        counted = (labels * spread(labels.shape)).astype(np.int64)
        assert verdicts(found_in(labels=counted, **given))["classes/central"] == verdict
    assert found_in(labels=counted, **given).loc["classes/central"]["high"].max() <= 1


def test_strips_have_no_centre() -> None:
    keys = set(found_in(partition="vertical3").index)
    assert keys == {"laplacian/modality", "laplacian/day_rgb", "laplacian/day_thermal"}
    labels = np.zeros((IMAGES, 3, 4), np.int64)
    labels[..., 0] = [90, 50, 80]
    labels[..., 1] = [10, 50, 20]
    frame = found_in(partition="horizontal3", labels=labels)
    assert frame.loc["occupancy/middle"]["verdict"] == "holds"
    assert frame.loc["occupancy/middle"]["value"] == pytest.approx(35)


@pytest.mark.parametrize(("regions", "third"), [(2, 1), (5, 1), (9, 3), (11, 3)])
def test_centre_and_edge_are_thirds_of_the_regions(regions: int, third: int) -> None:
    values = np.arange(1.0, regions + 1) ** 2
    centre, edge = thirds(values)
    assert centre == pytest.approx(values[:third].mean())
    assert edge == pytest.approx(values[regions - third :].mean())


def test_without_background_no_claim_is_about_occupancy() -> None:
    """Road is then a class as the others, and an entropy over all classes is left."""
    frame = found_in(classes=("road", "car", "curve", "bump"), background=())
    assert not [key for key in frame.index if key.startswith("occupancy/")]
    assert frame.loc["entropy/centre"]["contrast"] == "label entropy: centre - edge, bits"
    names = [what.partition(":")[0] for what in frame.loc["classes/central"]["contrast"]]
    assert names == ["road", "car", "curve"]
