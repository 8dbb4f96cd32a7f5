"""Corruptions requested on the command line, their file names, and a data set under them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from rgbt.checks import InputError
from rgbt.config.corruption_node import (
    choose_corruption,
    choose_corruptions,
    standard_corruptions,
)
from rgbt.evaluation.corruption import CorruptedDataset, corruption_of, severity_of
from tests.corruptions.recorded import NAMES, Recorded, sample


def corrupted(source: Recorded, name: str, severity: float, *words: str) -> CorruptedDataset:
    chosen = choose_corruption(name, words)
    return CorruptedDataset(source, chosen, severity_of(chosen, str(severity)), "test")


def shown(data: CorruptedDataset, names: Sequence[str]) -> list[str]:
    """Whose thermal image each name shows, known by the pixels."""
    known = {sample(name).thermal.tobytes(): name for name in names}
    return [known[data.read(name).thermal.tobytes()] for name in names]


@pytest.mark.parametrize(
    ("name", "severity", "expected"),
    [
        ("frozen", 3, [0, 0, 0, 3, 3, 3, 6]),
        ("frozen", 20, [0] * 7),
        ("delayed", 1, [0, 0, 1, 2, 3, 4, 5]),
        ("delayed", 4, [0, 0, 0, 0, 0, 1, 2]),
    ],
)
def test_late_thermal_is_that_of_a_previous_frame(
    name: str, severity: int, expected: list[int]
) -> None:
    names = tuple(f"{number:02d}" for number in range(7))
    data = corrupted(Recorded(names, by_night=False), name, severity)
    assert shown(data, names) == [names[number] for number in expected]
    last = data.read(names[6])
    np.testing.assert_array_equal(last.rgb, sample(names[6]).rgb)
    np.testing.assert_array_equal(last.label, sample(names[6]).label)


def test_frames_of_day_and_night_are_separate() -> None:
    assert dict(zip(NAMES, shown(corrupted(Recorded(), "delayed", 1), NAMES), strict=True)) == {
        "00001D": "00001D",
        "00003D": "00001D",
        "00004D": "00003D",
        "00006D": "00004D",
        "00002N": "00002N",
        "00005N": "00002N",
    }


def test_draws_differ_by_name_and_seed() -> None:
    words = ("corruption.block=32",)
    data = corrupted(Recorded(), "occluded:thermal", 0.5, *words)
    other = corrupted(Recorded(), "occluded:thermal", 0.5, *words, "corruption.seed=1")
    hidden = [data.read(NAMES[0]), data.read(NAMES[1]), other.read(NAMES[0])]
    first, *others = [sample.thermal == 0 for sample in hidden]
    assert first.mean() == 0.5
    assert not any(np.array_equal(first, other_one) for other_one in others)


@pytest.mark.parametrize("name", ["noise", "frozen", "delayed", "removed:rgb"])
def test_severity_0_is_the_sample_of_the_source(name: str) -> None:
    source = Recorded()
    found = corrupted(source, name, 0).read("00003D")
    np.testing.assert_array_equal(found.rgb, sample("00003D").rgb)
    np.testing.assert_array_equal(found.thermal, sample("00003D").thermal)
    assert source.reads == ["00003D"]


def test_frames_of_two_sizes_are_refused() -> None:
    data = corrupted(Recorded(sizes={"00003D": (60, 80)}), "delayed", 1)
    for name in ("00004D", "00009D"):
        with pytest.raises(InputError, match=name):
            data.read(name)
    # Corruptions of pixels need no order.
    assert corrupted(Recorded(), "noise", 8).read("00009D").name == "00009D"


@pytest.mark.parametrize("name", standard_corruptions())
def test_lowest_severity_changes_the_named_image(name: str) -> None:
    lowest = corruption_of(choose_corruption(name)).severities[0]
    data = corrupted(Recorded(), name, lowest)
    clean, found = ([source.read(name) for name in NAMES] for source in (Recorded(), data))
    same_rgb, same_thermal = (
        all(np.array_equal(getattr(a, i), getattr(b, i)) for a, b in zip(clean, found, strict=True))
        for i in ("rgb", "thermal")
    )
    of_thermal = ("delayed", "frozen", "misregistered")
    assert same_rgb == (name.startswith(of_thermal) or name.endswith(":thermal"))
    assert same_thermal == name.endswith(":rgb")


SMALL = ("corruption.block=16", "corruption.seed=3", "corruption.severities=[0.2]")


@pytest.mark.parametrize(
    ("name", "words", "typed", "severity", "shown", "changed"),
    [
        ("occluded", (), "0.5", 0.5, "occluded", ()),
        ("occluded:rgb", SMALL, "0.25", 0.25, "occluded_rgb_block-16_seed-3", ("block",)),
        ("removed:rgb", (), "", 1, "rgb_removed", ()),
        ("removed", ("corruption.image=rgb",), "", 1, "rgb_removed", ()),
        ("noise:thermal", ("corruption.image=rgb",), "8", 8, "noise_rgb", ()),
        ("noise", ("corruption.seed=0",), "8", 8, "noise", ()),
    ],
)
def test_name_and_severity_of_what_is_typed(
    name: str,
    words: tuple[str, ...],
    typed: str,
    severity: float,
    shown: str,
    changed: tuple[str, ...],
) -> None:
    chosen = choose_corruption(name, words)
    assert (chosen.name, severity_of(chosen, typed)) == (shown, severity)
    assert chosen.changed == tuple(f"corruption.{key}" for key in changed)
    # The ladder of severities changes no image of one severity.
    assert chosen.settings.keys() >= {"corruption._target_", "corruption.seed"}
    assert "corruption.severities" not in chosen.settings


@pytest.mark.parametrize(
    "text",
    [
        "_target_: rgbt.synth.datasets.synth\ncache_dir: written",
        "_target_: rgbt.corruptions.kinds.Noise\nimage: {_target_: rgbt.synth.datasets.synth}",
        "_target_: rgbt.transforms.crm.CrmTransform",
    ],
)
def test_file_may_name_corruptions_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, text: str
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("mine.yaml").write_text(text)
    with pytest.raises(InputError, match="_target_.* no file of conf/corruption names"):
        choose_corruption("mine.yaml")
    assert [path.name for path in tmp_path.iterdir()] == ["mine.yaml"]


def test_choose_corruptions() -> None:
    assert len(choose_corruptions("all", [])) == 14
    both = choose_corruptions("blur:rgb, frozen", ["corruption.seed=2"])
    assert [(chosen.name, chosen.node["seed"]) for chosen in both] == [
        ("blur_rgb_seed-2", 2),
        ("frozen_seed-2", 2),
    ]
    with pytest.raises(InputError, match=r"corruption\.block=8"):
        choose_corruptions("all", ["corruption.block=8"])
