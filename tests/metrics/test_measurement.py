"""What a measurement is called, how two differ, and what is no measurement."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rgbt.checks import InputError
from rgbt.metrics.archive import Archive
from rgbt.metrics.counts import ARCHIVE, read_measurement
from rgbt.metrics.measurement import Measurement, settings_of
from tests.analysis.counts import counts_of
from tests.measured import measurement

OWN = measurement(run="0123456789ab", settings=settings_of({"prediction.mirrored": False}))
KP = {"dataset": "fedcba9876543210", "dataset_name": "kp"}
NOISE = {"corruption": "noise_rgb", "title": "noise, RGB", "unit": "grey levels", "severity": 16.0}
SHOWN = "noise, RGB 16 (grey levels)"
REMOVED = {"corruption": "rgb_removed", "title": "RGB removed", "severity": 1.0}
MIRRORED = {"settings": settings_of({"prediction.mirrored": True})}


def other(*changed: str, **fields: Any) -> Measurement:
    """`OWN` but for these fields."""
    return replace(OWN, changed=changed, **fields)


@pytest.mark.parametrize(
    ("found", "condition", "label", "file"),
    [
        (OWN, "clean", "", "counts_test"),
        (replace(OWN, split="val"), "clean", "", "counts_val"),
        (other("view", view="thermal"), "thermal", "thermal alone", "test_thermal"),
        (
            other("severity", **NOISE),
            "noise_rgb",
            "noise, RGB 16 (grey levels)",
            "test_noise_rgb-16",
        ),
        (other("severity", **REMOVED), "rgb_removed", "RGB removed", "test_rgb_removed"),
        (
            other("view", "severity", "statistics", view="rgb", statistics="adabn", **NOISE),
            *("rgb noise_rgb adabn", f"RGB alone · {SHOWN} · AdaBN"),
            "test_rgb_noise_rgb-16_adabn",
        ),
        (
            other("statistics", statistics="recomputed", statistics_of=("train", "val")),
            *("recomputed-train-val", "statistics recomputed of train, val"),
            "test_recomputed-train-val",
        ),
        (other("head", head="source"), "source-head", "source head", "test_source-head"),
        (
            other("checkpoint", checkpoint="last", step=40),
            *("last-40", "last checkpoint, step 40", "test_last-40"),
        ),
        (other("dataset", **KP), "kp-fedcba98", "kp", "test_kp-fedcba98"),
        (other("partition", partition="ring9"), "ring9", "ring9", "test_ring9"),
        (measurement(weights="ab" * 32), "weights-abababab", "", "test_ring5_weights-abababab"),
        (measurement(split="night rain"), "clean", "", "night-rain_ring5"),
        (
            other("prediction.mirrored", **MIRRORED),
            *("prediction.mirrored=true", "prediction.mirrored=true"),
            f"test_mirrored-true_{other(**MIRRORED).digest[:8]}",
        ),
    ],
)
def test_names_are_of_what_differs_from_the_test_of_the_run(
    found: Measurement, condition: str, label: str, file: str
) -> None:
    assert (found.condition, found.label, found.file_name) == (condition, label, f"{file}.npz")


def test_words_and_the_convention_for_absent_classes_are_no_part_of_the_identity() -> None:
    shown = replace(OWN, absent="exclude", title="x", unit="x", corruption="x", changed=("view",))
    assert shown == OWN
    assert shown.digest == OWN.digest
    assert replace(OWN, severity=1.0).digest != OWN.digest


def test_two_measurements_are_unlike_in_what_was_changed() -> None:
    mirrored = other("prediction.mirrored", **MIRRORED)
    assert OWN.differences(mirrored) == ("prediction.mirrored",)
    assert OWN.unlike(mirrored) == ("prediction.mirrored: false, true",)
    # Of two networks, each as its own test.
    another = replace(mirrored, run="ba9876543210", step=9, changed=())
    assert OWN.differences(another) == ("prediction.mirrored", "run", "step")
    assert OWN.unlike(another) == ()
    assert OWN.unlike(replace(mirrored, run="ba9876543210")) == OWN.unlike(mirrored)
    noisy = other("severity", settings=settings_of({"corruption.seed": 3}), **NOISE)
    assert noisy.unlike(replace(noisy, run="ba9876543210", settings=())) == (
        "corruption.seed: 3, none",
    )


def test_every_field_comes_back() -> None:
    found = other("view", "dataset", view="rgb", **KP, **NOISE, dataset_words=("dataset=kp",))
    again = Measurement.from_json(found.to_json())
    assert vars(again) == vars(found)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda plain: plain.update(view="rgb"), "does not match its digest"),
        (lambda plain: plain.pop("digest"), "does not match its digest"),
        (lambda plain: plain.update(severity="high"), "severity"),
        (lambda plain: plain.update(statistics="guessed"), "statistics"),
        (lambda plain: plain.update(absent="both"), "absent"),
        (lambda plain: plain.update(further=1), "further"),
        (lambda plain: plain.update(title="\x1b[31m"), "control characters"),
    ],
)
def test_another_text_in_a_file_is_refused(
    tmp_path: Path, change: Callable[[dict[str, Any]], Any], said: str
) -> None:
    path = tmp_path / "counts.npz"
    counts_of(np.ones((1, 1, 2, 2), int)).save(path)
    assert read_measurement(path) == measurement(partition="ring1")
    with np.load(path) as stored:
        arrays = {name: stored[name] for name in stored.files}
    plain = json.loads(str(arrays["measurement"]))
    change(plain)
    for text in (json.dumps(plain), "{", "[]"):
        Archive(ARCHIVE.mark, "counts", "x").save(path, arrays | {"measurement": np.array(text)})
        word = said if text == json.dumps(plain) else "not a readable file"
        with pytest.raises(InputError, match=word):
            read_measurement(path)


def test_splits_of_statistics_are_named_between_two_networks() -> None:
    first = other("statistics", statistics="adabn")
    second = replace(first, run="another", statistics_of=("train",))
    assert first.unlike(second) == ("statistics_of: none, ('train',)",)


def test_the_step_is_named_of_one_network_alone() -> None:
    assert OWN.unlike(replace(OWN, step=3)) == ("step: 0, 3",)
    assert OWN.unlike(replace(OWN, step=3, run="another")) == ()


@pytest.mark.parametrize(
    "fields", [{"view": "foo"}, {"head": "third"}, {"severity": float("nan")}, {"absent": "no"}]
)
def test_a_field_that_no_network_has_is_refused(fields: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=f"^{next(iter(fields))}: expected"):
        replace(OWN, **fields)
