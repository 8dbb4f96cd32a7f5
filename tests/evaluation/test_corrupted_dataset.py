"""A data set under a corruption: which frames are shown, and what stays as it is."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from rgbt.checks import InputError
from rgbt.corruptions.corruption import OfPixels, OfTime
from rgbt.corruptions.late import Delayed, Frozen
from rgbt.corruptions.pixels import Noise, Occluded, Removed
from rgbt.evaluation.corrupted_dataset import CorruptedDataset, settings_of
from tests.corruptions.recorded import NAMES, Recorded, sample

FROZEN, DELAYED = Frozen(severities=(2.0,)), Delayed(severities=(1.0,))
NOISE = Noise(image="both", severities=(8.0,))


def shown(data: CorruptedDataset, names: Sequence[str]) -> list[str]:
    """Whose thermal image each name shows, known by the pixels."""
    known = {sample(name).thermal.tobytes(): name for name in names}
    return [known[data.read(name).thermal.tobytes()] for name in names]


@pytest.mark.parametrize(
    ("kind", "severity", "expected"),
    [
        (FROZEN, 3, [0, 0, 0, 3, 3, 3, 6]),
        (FROZEN, 2, [0, 0, 2, 2, 4, 4, 6]),
        (FROZEN, 20, [0] * 7),
        (DELAYED, 1, [0, 0, 1, 2, 3, 4, 5]),
        (DELAYED, 4, [0, 0, 0, 0, 0, 1, 2]),
    ],
)
def test_late_thermal_is_that_of_a_previous_frame(
    kind: OfTime, severity: int, expected: list[int]
) -> None:
    names = tuple(f"{number:02d}" for number in range(7))
    data = CorruptedDataset(Recorded(names, by_night=False), kind, severity, split="test")
    assert shown(data, names) == [names[number] for number in expected]
    assert [data.shown(name) for name in names] == [names[number] for number in expected]
    last = data.read(names[6])
    np.testing.assert_array_equal(last.rgb, sample(names[6]).rgb)
    np.testing.assert_array_equal(last.label, sample(names[6]).label)


def test_frames_of_day_and_night_are_separate() -> None:
    data = CorruptedDataset(Recorded(), DELAYED, 1, split="test")
    assert dict(zip(NAMES, shown(data, NAMES), strict=True)) == {
        **{"00001D": "00001D", "00003D": "00001D", "00004D": "00003D", "00006D": "00004D"},
        **{"00002N": "00002N", "00005N": "00002N"},
    }


def test_the_order_of_reading_does_not_matter() -> None:
    for kind, severity in ((NOISE, 8), (DELAYED, 2), (FROZEN, 3)):
        forward = CorruptedDataset(Recorded(), kind, severity, split="test")
        backward = CorruptedDataset(Recorded(), kind, severity, split="test")
        first = {name: forward.read(name) for name in NAMES}
        second = {name: backward.read(name) for name in reversed(NAMES)}
        for name in NAMES:
            np.testing.assert_array_equal(first[name].rgb, second[name].rgb)
            np.testing.assert_array_equal(first[name].thermal, second[name].thermal)


def test_draws_differ_by_name_and_seed() -> None:
    blocks = Occluded(image="thermal", block=32, severities=(0.5,))
    data, other = (CorruptedDataset(Recorded(), blocks, 0.5, split="test", seed=s) for s in (0, 1))
    hidden = [data.read(name).thermal == 0 for name in NAMES[:2]] + [
        other.read(NAMES[0]).thermal == 0
    ]
    assert [each.mean() for each in hidden] == [0.5] * 3
    assert not np.array_equal(hidden[0], hidden[1])
    assert not np.array_equal(hidden[0], hidden[2])


@pytest.mark.parametrize("kind", [NOISE, FROZEN, DELAYED, Removed(image="rgb")])
def test_severity_0_is_the_sample_of_the_source(kind: OfPixels | OfTime) -> None:
    source = Recorded()
    data = CorruptedDataset(source, kind, 0, split="test")
    found = data.read("00003D")
    np.testing.assert_array_equal(found.rgb, sample("00003D").rgb)
    np.testing.assert_array_equal(found.thermal, sample("00003D").thermal)
    assert source.reads == ["00003D"]
    assert data.files("00003D") == source.files("00003D")


def test_files_are_those_that_are_read() -> None:
    late = CorruptedDataset(Recorded(), DELAYED, 1, split="test")
    assert late.files("00004D") == (
        *(Path("00004D.png"), Path("00004D_label.png")),
        *(Path("00003D.png"), Path("00003D_label.png")),
    )
    assert late.files("00001D") == (Path("00001D.png"), Path("00001D_label.png"))


def test_decoding_of_different_corruptions_differs() -> None:
    made = [
        CorruptedDataset(Recorded(), NOISE, 8, split="test"),
        CorruptedDataset(Recorded(), NOISE, 9, split="test"),
        CorruptedDataset(Recorded(), NOISE, 8, split="test", seed=1),
        CorruptedDataset(Recorded(), Noise(image="rgb", severities=(8.0,)), 8, split="test"),
        CorruptedDataset(Recorded(), FROZEN, 8, split="test"),
        CorruptedDataset(Recorded(NAMES[:-1]), FROZEN, 8, split="test"),
    ]
    decodings = [each.decoding() for each in made]
    assert all(each["layout"] == "recorded" for each in decodings)
    assert all(a != b for index, a in enumerate(decodings) for b in decodings[:index])
    assert decodings[0] == CorruptedDataset(Recorded(), NOISE, 8, split="test").decoding()


def test_settings_leave_out_the_ladder() -> None:
    assert settings_of(Occluded(image="rgb", block=8, severities=(0.5,))) == {
        "image": "rgb",
        "block": 8,
    }
    assert settings_of(FROZEN) == {}


@pytest.mark.parametrize(
    ("kind", "severity", "sentence"),
    [
        (NOISE, 256, "must be between"),
        (NOISE, -1, "must be between"),
        (FROZEN, 1, "1 changes nothing; give 2 or more"),
        (FROZEN, 2.5, "counts frames: expected 1, 2, 3"),
        (DELAYED, float("inf"), "counts frames"),
        (DELAYED, float("nan"), "counts frames"),
        (DELAYED, -1, "counts frames"),
    ],
)
def test_severity_out_of_range_is_refused(
    kind: OfPixels | OfTime, severity: float, sentence: str
) -> None:
    with pytest.raises(InputError, match=sentence):
        CorruptedDataset(Recorded(), kind, severity, split="test")


def test_frames_of_two_sizes_are_refused() -> None:
    data = CorruptedDataset(Recorded(sizes={"00003D": (60, 80)}), DELAYED, 1, split="test")
    with pytest.raises(InputError, match=r"'00004D' \(120x160 pixels\) .* '00003D' \(60x80 pixels"):
        data.read("00004D")
    with pytest.raises(InputError, match="'00009D' is not in split 'test', whose order determines"):
        data.read("00009D")
    # Corruptions of pixels need no order.
    assert CorruptedDataset(Recorded(), NOISE, 8, split="test").read("00009D").name == "00009D"
    with pytest.raises(InputError, match="no split 'tset'"):
        CorruptedDataset(Recorded(), DELAYED, 1, split="tset")
