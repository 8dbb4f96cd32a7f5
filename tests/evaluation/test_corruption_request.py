"""Choosing a degradation on the command line: files, keys, severities, names of files."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rgbt.evaluation.corrupted import choose, known_degradations, own_words

from rgbt.checks import InputError
from rgbt.corruptions.corruption import OfPixels, OfTime
from tests.corruptions.recorded import NAMES, Recorded

IMAGES = ("", "_rgb", "_thermal")
THERMAL = ("thermal", "frozen", "delayed", "misregistered")
"""Beginnings of the names of failures of the thermal camera alone."""


@dataclass(frozen=True)
class Reading:
    """A session, as far as a failure changes it."""

    dataset: Any


def test_every_file_is_a_degradation_with_a_ladder_and_a_title_of_its_own() -> None:
    found = {name: choose(name).degradation for name in known_degradations()}
    assert set(found) == {
        *("rgb_removed", "thermal_removed", "frozen", "delayed", "misregistered"),
        *(f"{kind}{end}" for kind in ("occluded", "noise", "blur") for end in IMAGES),
    }
    for kind in found.values():
        assert isinstance(kind, OfPixels | OfTime)
        assert len(kind.severities) == (4 if kind.unit else 1)
    assert len({kind.title for kind in found.values()}) == len(found)


@pytest.mark.parametrize("name", known_degradations())
def test_every_file_changes_images_of_the_embedded_data_at_its_lowest_severity(name: str) -> None:
    chosen = choose(name)
    session: Any = Reading(Recorded())
    failure = chosen.at(f"{chosen.degradation.severities[0]:g}")
    data = failure.applied(session, "test").dataset
    clean = [Recorded().read(each) for each in NAMES]
    failing = [data.read(each) for each in NAMES]
    same_rgb, same_thermal = (
        all(np.array_equal(getattr(a, i), getattr(b, i)) for a, b in zip(clean, failing))
        for i in ("rgb", "thermal")
    )
    assert same_rgb == (name.startswith(THERMAL) or name.endswith("_thermal"))
    assert same_thermal == (name == "rgb_removed" or name.endswith("_rgb"))


def test_marks_name_files_and_say_what_was_changed() -> None:
    assert choose("occluded").at("0.5").mark == "occluded-0.5"
    words = ["degradation.block=16", "degradation.seed=3", "degradation.severities=[0.2]"]
    chosen = choose("occluded_rgb", words)
    assert chosen.at("0.25").mark == "occluded_rgb-0.25_block-16_seed-3"
    assert chosen.degradation.severities == (0.2,)
    assert (chosen.seed, chosen.changes) == (3, ("block=16",))
    assert choose("frozen").at("10").mark == "frozen-10"
    assert (chosen.row, choose("frozen").row) == ("occluded_rgb_block-16_seed-3", "frozen")
    assert choose("noise").at("1e1").told == "noise, RGB and thermal 10 (grey levels (std))"
    assert choose("rgb_removed").at("").told == "RGB removed (zeroed)"
    assert choose("noise", ["degradation.seed=0"]).at("8").mark == "noise-8"


def test_a_file_of_ones_own(tmp_path: Path) -> None:
    path = tmp_path / "hazy.yaml"
    path.write_text("_target_: rgbt.corruptions.blur.Blur\nimage: rgb\nseverities: [3, 30]\n")
    chosen = choose(str(path))
    assert (chosen.name, chosen.degradation.severities) == ("hazy", (3.0, 30.0))
    path.write_text("- 1\n")
    with pytest.raises(InputError, match=r"hazy.yaml: expected a mapping of keys and values, got"):
        choose(str(path))
    path.write_text("a: [\n")
    with pytest.raises(InputError, match=r"hazy.yaml cannot be read as YAML"):
        choose(str(path))
    with pytest.raises(InputError, match="there is no such file"):
        choose(str(tmp_path / "no.yaml"))


def test_words_of_the_degradation_are_taken_from_the_overrides() -> None:
    words = ["dataset=mfnet", "degradation.block=16", "data.eval_batch_size=1"]
    assert own_words(words) == (["degradation.block=16"], ["dataset=mfnet", words[2]])


def test_identity_is_what_decides_how_images_look() -> None:
    found = choose("occluded", ["degradation.block=16"]).at("0.5").identity()
    assert found == {
        "degradation": "occluded",
        "kind": "Occluded",
        "settings": {"image": "both", "block": 16},
        "severity": 0.5,
        "seed": 0,
    }


@pytest.mark.parametrize(
    ("name", "words", "severity", "sentence"),
    [
        ("occludd", [], "0.5", "did you mean 'occluded'"),
        ("occluded", [], "", "severity=: degradation=occluded needs a number .share of blocks., "),
        ("occluded", [], "half", "for example one of 0.1, 0.25, 0.5, 0.75"),
        ("occluded", [], "nan", "needs a number"),
        ("occluded", [], "2", "must lie in"),
        ("rgb_removed", [], "0.5", "can only be 1"),
        (
            "occluded",
            ["degradation.blok=1"],
            "0.5",
            "'degradation.blok' is not .*'block'",
        ),
        ("occluded", ["degradation.block=big"], "0.5", "'degradation.block'"),
        ("occluded", ["degradation.block=["], "0.5", "degradation.block cannot be read as YAML"),
        ("occluded", ["degradation.seed=x"], "0.5", "whole number of at least 0"),
        ("noise", ["degradation.severities=[4,2]"], "3", "must rise from above 0"),
    ],
)
def test_what_does_not_fit_is_told(
    name: str, words: list[str], severity: str, sentence: str
) -> None:
    with pytest.raises(InputError, match=sentence):
        choose(name, words).at(severity)


def test_severity_0_may_be_asked_for() -> None:
    assert choose("frozen").at("0").severity == 0
