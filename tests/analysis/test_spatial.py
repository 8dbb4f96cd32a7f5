from __future__ import annotations

import csv
from pathlib import Path

import pytest

from analysis.spatial import entry
from analysis.statistics.collect import SpatialStatistics
from analysis.statistics.resampled import ResampledSplit
from tests.commands import Call
from tests.data.layouts import write_kp


def test_command_prints_tables_and_writes_files(call: Call, data: Path, tmp_path: Path) -> None:
    out = tmp_path / "statistics"
    arguments = ("dataset=mfnet", f"dataset.root={data}", "regions=4", "resamples=100")
    code, printed, said = call(entry, *arguments, f"out={out}")
    assert code == 0, said
    assert not said, "a line of a log comes after ten seconds"
    assert "mfnet, split train: 8 images (4 at night) of 48x64, ring4, 0.00 %" in printed
    for title in (
        *("sample occupancy rate, % (Eq. 2)", "by class, % of its largest region (Fig. 3)"),
        *("Laplacian variance (four neighbours, Eq. 3)", "signal to noise (Eq. 4; immerkaer"),
        *("noise, grey levels (immerkaer", "label entropy, bits (Eq. 5)"),
        *("statements of SpatialSeg, Sec. III", "how signal to noise depends on the estimator"),
    ):
        assert title in printed
    assert "not shown" in printed  # 4 images by day are too few
    assert "signal to noise is lower in the centre (rgb and thermal, day and night), immerkaer" in (
        printed
    )
    assert "immerkaer, images" in printed.split("how signal to noise depends")[1]
    assert str(out) in printed
    assert len((out / "statements.csv").read_text().splitlines()) > 20
    stats = SpatialStatistics.load(out / "statistics.npz")
    with (out / "regions.csv").open() as file:
        rows = list(csv.DictReader(file))
    found = {
        (row["part"], row["quantity"], row["modality"], row["estimator"], row["average"]): row
        for row in rows
        if row["region"] == "4" and not row["class"]
    }
    snr = found["night", "snr", "thermal", "wavelet_mad", "images"]
    expected = ResampledSplit(stats).snr("night", ("wavelet_mad", "images"))[0, 1, 3]
    assert float(snr["value"]) == pytest.approx(expected, rel=1e-6)
    assert snr["images"] == "4"
    occupancy = found["all", "occupancy", "", "", ""]
    assert float(occupancy["value"]) == pytest.approx(
        ResampledSplit(stats).occupancy()[0, 3], rel=1e-6
    )
    assert "**signal to noise (Eq. 4; std, images)**" in (out / "statistics.md").read_text()


def test_data_set_without_background_has_no_occupancy(call: Call, tmp_path: Path) -> None:
    """Class 0 of KP is road."""
    out = tmp_path / "statistics"
    root = write_kp(tmp_path / "data")
    code, printed, said = call(
        entry,
        "dataset=kp",
        f"dataset.root={root}",
        "split=test",
        "regions=2",
        "resamples=100",
        f"out={out}",
    )
    assert code == 0, said
    assert printed.count("Sample occupancy is not available: no class of kp is stated") == 1
    assert "sample occupancy rate" not in printed
    assert "with background" not in printed.partition("label entropy")[2]
    assert "Sample occupancy is not available" in (out / "statistics.md").read_text()
    quantities = [line.split(",")[5] for line in (out / "regions.csv").read_text().splitlines()]
    assert "occupancy" not in quantities
    assert "label entropy" in quantities
    assert "\n| road |" in (out / "statistics.md").read_text()


def test_the_chosen_estimator_is_shown(call: Call, data: Path, tmp_path: Path) -> None:
    arguments = ("dataset=mfnet", f"dataset.root={data}", f"out={tmp_path / 'out'}", "regions=2")
    code, printed, _ = call(
        entry, *arguments, "estimator=std", "average=images", "kernel=eight", "resamples=100"
    )
    assert code == 0
    assert "signal to noise (Eq. 4; std, images)" in printed
    assert "Laplacian variance (eight neighbours" in printed
    assert ", immerkaer, pooled (III" not in printed


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ("level=95", "level must be between 0.5 and 0.999, got 95."),
        ("metric=ring9", "'metric' has no effect here;"),
    ],
)
def test_bad_input_is_one_sentence(
    call: Call, data: Path, tmp_path: Path, arguments: str, sentence: str
) -> None:
    out = tmp_path / "out"
    given = ("dataset=mfnet", f"dataset.root={data}", f"out={out}")
    code, printed, said = call(entry, *given, *arguments.split())
    assert code == 2
    assert sentence in said
    assert said.count("\n") == 1
    assert printed == ""
    assert not out.exists()
