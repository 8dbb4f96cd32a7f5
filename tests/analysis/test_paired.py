"""Two measurements of one training, such as along an estimated and along the exact flow."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from analysis.compare import entry
from analysis.details import entry as details_entry
from analysis.uncertainty import Resampling, compare
from rgbt.checks import InputError
from rgbt.metrics.counting import pair_counts
from rgbt.metrics.counts import Counts
from tests.commands import Call, assert_one_sentence

PAIRS = 24


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
    pairs("next1-abcdef", 4).save(folder / "consistency_next_test.npz")
    pairs("flow1-123456", 6, left_out=20).save(folder / "consistency_flow-123456_test.npz")
    return folder


def test_two_measurements_of_a_training_are_compared(
    call: Call, measured: Path, tmp_path: Path
) -> None:
    """They count other pixels of the same pairs."""
    files = [measured / f"consistency_{each}_test.npz" for each in ("next", "flow-123456")]
    words = [f"{side}={file}" for side, file in zip("ab", files, strict=True)]
    words += ["metrics=warping_error,TC,day/TC", "resamples=200", f"out={tmp_path / 'out'}"]
    code, _, err = call(entry, *words)
    assert code == 2
    assert_one_sentence(err, "counts by next1-abcdef cannot be compared with counts by flow1")
    code, out, err = call(entry, *words, "paired=true")
    assert code == 0, err
    assert "seeds in pairs" in out
    error, whole, _ = csv.DictReader((tmp_path / "out" / "comparison.csv").open())
    # 4, 5 or 6 of 100 pixels against 6, 7 or 8 of 80.
    assert float(error["a"]) == pytest.approx(5)
    assert float(error["b"]) == pytest.approx(100 * 7 / 80)
    assert float(error["images_low"]) < 100 * 7 / 80 - 5 < float(error["images_high"])
    assert float(whole["difference"]) < 0


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
