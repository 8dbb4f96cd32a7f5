"""The picture of corruptions: its data, that it is drawn, and the command."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from rgbt.corruptions.__main__ import draw, entry, sheet, side_by_side
from rgbt.corruptions.late import Delayed
from rgbt.corruptions.pixels import Noise, Removed
from rgbt.evaluation.request import CorruptionRequest
from tests.commands import Call
from tests.conftest import WriteMFNet
from tests.corruptions.recorded import Recorded, sample

KINDS = [
    CorruptionRequest("any", each)
    for each in (
        Noise(image="rgb", severities=(8.0, 16.0)),
        Delayed(severities=(1.0,)),
        Removed(image="thermal"),
    )
]


def test_a_line_per_corruption_with_the_clean_pair_first() -> None:
    lines = sheet(Recorded(), KINDS, "00004D", "test")
    assert [[caption for caption, _ in line] for line in lines] == [
        ["noise, RGB", "8 grey levels (std)", "16 grey levels (std)"],
        ["delayed thermal", "1 frames"],
        ["thermal removed (zeroed)", ""],
    ]
    clean, corrupted = zip(*((line[0][1], line[1][1]) for line in lines))
    for each in clean:
        np.testing.assert_array_equal(each.rgb, sample("00004D").rgb)
    np.testing.assert_array_equal(corrupted[1].thermal, sample("00003D").thermal)
    assert corrupted[2].thermal.max() == 0


def test_pairs_are_drawn_side_by_side_with_titles() -> None:
    pair = side_by_side(sample())
    assert pair.shape == (120, 320, 3)
    np.testing.assert_array_equal(pair[:, 160:, 1], sample().thermal)
    figure = draw(sheet(Recorded(), KINDS, "00004D", "test"))
    titles = [axes.get_title(loc="left") for axes in figure.axes]
    assert titles == [
        *("noise, RGB", "8 grey levels (std)", "16 grey levels (std)"),
        *("delayed thermal", "1 frames", "", "thermal removed (zeroed)", "", ""),
    ]


def test_the_command_writes_a_picture(call: Call, write_mfnet: WriteMFNet, tmp_path: Path) -> None:
    root = write_mfnet({"test": ["00001D", "00002D"]})
    out = tmp_path / "a" / "sheet.png"
    where = (f"dataset.root={root}", "dataset=mfnet", f"out={out}")
    code, said, err = call(entry, "corruptions=noise,removed:rgb", *where)
    assert (code, said.strip()) == (0, str(out)), err
    assert cv2.imread(str(out)).shape[1] > 500
    code, _, err = call(entry, "name=00003D", *where)
    assert code == 2
    assert "split 'test' has no sample of this name; did you mean" in err


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["out=x.pdf"], "out must be the path of a picture to write, .png or .jpg, got 'x.pdf'"),
        (["out=x.png", "corruptions=nois"], "did you mean 'noise"),
    ],
)
def test_bad_input(call: Call, words: list[str], sentence: str) -> None:
    code, out, err = call(entry, *words)
    assert (code, out) == (2, "")
    assert sentence in err
