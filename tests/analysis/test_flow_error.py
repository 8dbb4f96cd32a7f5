"""Scores along an estimated flow against those along the exact one, from stored counts."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from analysis.details import entry as details_entry
from analysis.flow_error import compare_flows, entry, read_measured
from analysis.uncertainty import Resampling, compare
from rgbt.checks import InputError
from rgbt.metrics.counting import pair_counts
from rgbt.metrics.counts import Counts
from tests.commands import Call, assert_one_sentence

PAIRS = 24
HEADER = "name,used,displacement_px,end_point_error_px,hidden"


def pairs(partition: str, wrong: int, left_out: int = 0) -> Counts:
    """100 pixels a pair, half of class 0; `wrong` + (number of the pair) % 3 of them change."""
    found = []
    for index in range(PAIRS):
        first = np.repeat([0, 1], 50)[None]
        second, valid = first.copy(), np.ones((1, 100), bool)
        second[0, : wrong + index % 3] = 1
        valid[0, 100 - left_out :] = False
        found.append(pair_counts(first, second, first, 2, valid))
    return Counts(
        counts=np.stack(found),
        names=tuple(f"v{index % 12}_{index // 12:03d}" for index in range(PAIRS)),
        night=tuple(index % 2 == 1 for index in range(PAIRS)),
        classes=("road", "car"),
        partition=partition,
        dataset="d",
        split="test",
    )


@pytest.fixture
def measured(tmp_path: Path) -> Path:
    folder = tmp_path / "rgb"
    folder.mkdir()
    exact = pairs("next1-abcdef", 4)
    exact.save(folder / "consistency_next_test.npz")
    pairs("flow1-123456", 6, left_out=20).save(folder / "consistency_flow-123456_test.npz")
    lines = [f"{name},0.8,3.5,{1 + (index % 2)},0.05" for index, name in enumerate(exact.names)]
    (folder / "flow-123456_test.csv").write_text("\n".join([HEADER, *lines, ""]))
    return folder


def test_differences_by_hand(measured: Path) -> None:
    comparison = compare_flows(
        read_measured(measured, "test"), Resampling(resamples=500, blocks="none")
    )
    found = {each.metric: each for each in comparison.differences}
    error = found["warping_error"]
    # 4, 5 or 6 of 100 pixels against 6, 7 or 8 of 80.
    assert error.a.value == pytest.approx(5)
    assert error.b.value == pytest.approx(100 * 7 / 80)
    assert error.value == pytest.approx(100 * 7 / 80 - 5)
    assert error.interval is not None
    assert error.interval.low < error.value < error.interval.high
    assert {"day/TC", "night/warning"} - set(found) == {"night/warning"}
    assert found["TC"].value < 0


def test_command_shows_differences_and_records(call: Call, measured: Path) -> None:
    code, shown, err = call(entry, f"folder={measured}", "resamples=200")
    assert code == 0, err
    text = " ".join(shown.split())
    assert "warping error 5.00 8.75 +3.75 [" in text
    assert "all 80.0 5.0 1.50 3.50" in text
    assert "day 80.0 5.0 1.00 3.50" in text


def test_other_folders_are_refused(call: Call, measured: Path, tmp_path: Path) -> None:
    def refused(sentence: str, *words: str) -> None:
        code, _, err = call(entry, *words)
        assert code == 2
        assert_one_sentence(err, sentence)

    refused("'folder' has no value")
    refused("has 0 files consistency_flow-*_test.npz, expected one", f"folder={tmp_path}")
    (measured / "flow-123456_test.csv").unlink()
    refused("flow-123456_test.csv does not exist", f"folder={measured}")


def test_whole_videos_are_resampled_where_there_are_many(call: Call, measured: Path) -> None:
    """Twelve videos of two pairs each."""
    path = measured / "consistency_flow-123456_test.npz"
    code, shown, err = call(details_entry, f"run={path}", "resamples=200")
    assert code == 0, err
    text = " ".join(shown.split())
    assert "Consistency of pairs of frames in percent" in text
    assert "all images" in text
    assert "12 blocks of 2 neighbouring frames" in text
    assert "each is one block" in text


def test_triples_of_two_methods_have_other_classes_in_the_first_frame() -> None:
    a = replace(pairs("triples1", 4), night=None)
    b = replace(a, counts=a.counts[:, ::-1])
    found = compare([a], [b], ["flicker"], Resampling(resamples=200, blocks="none"))
    assert found.differences[0].metric == "flicker"
    less = replace(b, counts=b.counts * 2)
    with pytest.raises(InputError, match="has different labels in the two counts"):
        compare([a], [less], ["flicker"], Resampling(resamples=200, blocks="none"))
