"""Corruptions requested on the command line: files, settings, severities, names of files."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rgbt.checks import InputError
from rgbt.evaluation.corruption_request import (
    choose_corruption,
    choose_corruptions,
    standard_corruptions,
)
from tests.corruptions.recorded import NAMES, Recorded

THERMAL = ("delayed", "frozen", "misregistered")
"""Corruptions of thermal alone, whatever the image."""


@dataclass(frozen=True)
class Reading:
    """The part of a session that a corruption changes."""

    dataset: Any


def test_standard_corruptions_are_sorted_by_row() -> None:
    names = standard_corruptions()
    assert names == [
        *("blur", "blur:rgb", "blur:thermal", "delayed", "frozen", "misregistered"),
        *("noise", "noise:rgb", "noise:thermal", "occluded", "occluded:rgb", "occluded:thermal"),
        *("removed:rgb", "removed:thermal"),
    ]
    # The names of counts on disk.
    assert [choose_corruption(name).row for name in names] == [
        *("blur", "blur_rgb", "blur_thermal", "delayed", "frozen", "misregistered"),
        *("noise", "noise_rgb", "noise_thermal", "occluded", "occluded_rgb", "occluded_thermal"),
        *("rgb_removed", "thermal_removed"),
    ]


@pytest.mark.parametrize("name", standard_corruptions())
def test_lowest_severity_changes_the_named_image(name: str) -> None:
    session: Any = Reading(Recorded())
    lowest = choose_corruption(name).ladder()[0]
    data = lowest.applied_to(session, "test").dataset
    clean = [Recorded().read(each) for each in NAMES]
    corrupted = [data.read(each) for each in NAMES]
    same_rgb, same_thermal = (
        all(np.array_equal(getattr(a, i), getattr(b, i)) for a, b in zip(clean, corrupted))
        for i in ("rgb", "thermal")
    )
    assert same_rgb == (name.startswith(THERMAL) or name.endswith(":thermal"))
    assert same_thermal == name.endswith(":rgb")


def test_file_stem_and_title() -> None:
    assert choose_corruption("occluded").at("0.5").file_stem == "occluded-0.5"
    words = ["corruption.block=16", "corruption.seed=3", "corruption.severities=[0.2]"]
    request = choose_corruption("occluded:rgb", words)
    assert request.at("0.25").file_stem == "occluded_rgb-0.25_block-16_seed-3"
    assert request.corruption.severities == (0.2,)
    assert (request.seed, request.changes) == (3, ("block=16",))
    assert choose_corruption("frozen").at("10").file_stem == "frozen-10"
    assert (request.row, choose_corruption("frozen").row) == (
        "occluded_rgb_block-16_seed-3",
        "frozen",
    )
    assert choose_corruption("noise").at("1e1").title == (
        "noise, RGB and thermal 10 (grey levels (std))"
    )
    removed = choose_corruption("removed:rgb").at("")
    assert (removed.title, removed.file_stem) == ("RGB removed (zeroed)", "rgb_removed-1")
    assert choose_corruption("noise", ["corruption.seed=0"]).at("8").file_stem == "noise-8"


@pytest.mark.parametrize(
    ("name", "row"),
    [("noise", "noise_rgb"), ("noise:thermal", "noise_rgb"), ("removed", "rgb_removed")],
)
def test_image_as_a_setting_is_the_image_of_the_name(name: str, row: str) -> None:
    request = choose_corruption(name, ["corruption.image=rgb"])
    assert (request.row, request.changes) == (row, ())
    assert request.corruption.title.startswith(("noise, RGB", "RGB removed"))


def test_own_file(tmp_path: Path) -> None:
    path = tmp_path / "hazy.yaml"
    path.write_text("_target_: rgbt.corruptions.pixels.Blur\nimage: rgb\nseverities: [3, 30]\n")
    request = choose_corruption(str(path))
    assert (request.row, request.corruption.severities) == ("hazy", (3.0, 30.0))
    changed = choose_corruption(str(path), ["corruption.image=thermal"])
    assert changed.at("3").file_stem == "hazy-3_image-thermal"
    path.write_text("- 1\n")
    with pytest.raises(InputError, match=r"hazy.yaml: expected a mapping of keys and values, got"):
        choose_corruption(str(path))
    path.write_text("a: [\n")
    with pytest.raises(InputError, match=r"hazy.yaml cannot be read as YAML"):
        choose_corruption(str(path))
    with pytest.raises(InputError, match="the file does not exist"):
        choose_corruption(str(tmp_path / "no.yaml"))


def test_identity_of_a_request() -> None:
    """On disk: counts that exist are recognised by it."""
    request = choose_corruption("occluded:thermal", ["corruption.block=16"]).at("0.5")
    assert request.identity() == {
        "degradation": "occluded_thermal",
        "kind": "Occluded",
        "settings": {"image": "thermal", "block": 16},
        "severity": 0.5,
        "seed": 0,
    }


@pytest.mark.parametrize(
    ("name", "words", "severity", "sentence"),
    [
        ("occludd", [], "0.5", "did you mean 'occluded'"),
        (
            "occluded",
            [],
            "",
            "severity=: corruption=occluded requires a number .share of blocks., ",
        ),
        ("occluded", [], "half", "for example one of 0.1, 0.25, 0.5, 0.75"),
        ("occluded", [], "nan", "requires a number"),
        ("occluded", [], "2", "must be between"),
        ("removed:rgb", [], "0.5", "must be 1"),
        ("removed", [], "1", "'corruption.image' has no value"),
        ("removed:both", [], "1", "'corruption.image'"),
        ("frozen:rgb", [], "2", "'corruption.image' is not a setting of"),
        ("occluded", ["corruption.blok=1"], "0.5", "'corruption.blok' is not .*'block'"),
        ("occluded", ["corruption.block=big"], "0.5", "'corruption.block'"),
        ("occluded", ["corruption.block=["], "0.5", "corruption.block cannot be read as YAML"),
        ("occluded", ["corruption.seed=x"], "0.5", "whole number of at least 0"),
        ("noise", ["corruption.severities=[4,2]"], "3", "must be rising numbers above 0"),
    ],
)
def test_bad_request_is_refused(name: str, words: list[str], severity: str, sentence: str) -> None:
    with pytest.raises(InputError, match=sentence):
        choose_corruption(name, words).at(severity)


def test_choose_corruptions() -> None:
    assert len(choose_corruptions("all", [])) == 14
    both = choose_corruptions("blur:rgb, frozen", ["corruption.seed=2"])
    assert [(each.name, each.seed) for each in both] == [("blur_rgb", 2), ("frozen", 2)]
    with pytest.raises(InputError, match="did you mean 'frozen'"):
        choose_corruptions("blur,froze", [])
    with pytest.raises(InputError, match="'blur' is given twice"):
        choose_corruptions("blur,blur:both", [])
    with pytest.raises(
        InputError, match="'corruption.block' is a setting of a single corruption, but 14"
    ):
        choose_corruptions("all", ["corruption.block=8"])
