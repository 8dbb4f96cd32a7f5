"""Measurements that tables request: their words, their commands, and where their counts are."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rgbt import consistency, evaluate
from rgbt.checks import InputError
from rgbt.config.options import types_of
from rgbt.metrics.measurement import Measurement, settings_of
from rgbt.metrics.metric import number_of_regions
from rgbt.runs.result import OWN, RunResult
from sweeps.plan.measurement import Words, command_of, counts_of, measurement_of, stored_at
from sweeps.plan.table import Column, words_of
from tests.commands import ON_CPU, Call, Trained, short
from tests.measured import measurement
from tests.sweeps.fakes import finish
from tests.sweeps.tabled import table

OPTIONS = {"rgbt.evaluate": evaluate.Options, "rgbt.consistency": consistency.Options}
ENTRIES = {"rgbt.evaluate": evaluate.entry, "rgbt.consistency": consistency.entry}


@pytest.mark.parametrize(
    ("column", "regions", "words"),
    [
        ({}, "as trained", ""),
        ({"modality": "thermal"}, "ring9", "modality=thermal regions=ring9"),
        (
            {"modality": "rgb", "head": "source"},
            *("ring9", "modality=rgb regions=ring9 head=source"),
        ),
        (
            {"modality": "rgbt", "corruption": "noise", "severity": 16.0},
            *("ring9", "modality=rgbt regions=ring9 corruption=noise severity=16"),
        ),
        (
            {"modality": "rgb", "corruption": "removed:rgb"},
            *("ring5", "modality=rgb regions=ring5 corruption=removed:rgb"),
        ),
        (
            {"batch_norm": "adabn", "batch_norm_splits": ("day", "night")},
            *("as trained", "batch_norm=adabn batch_norm_splits=day,night"),
        ),
        (
            {"modality": "rgb", "corruption": "noise", "severity": 0.5, "metric": "size/64-256"},
            *("ring5", "modality=rgb regions=ring5 corruption=noise severity=0.5 details=size"),
        ),
        ({"metric": "boundary_IoU"}, "as trained", "details=boundary"),
        *(
            ({"metric": "TC", "frames": frames}, "ring9", f"frames={frames}")
            for frames in ("aligned", "released", "next")
        ),
    ],
    ids=str,
)
def test_column_has_words_and_a_command(column: dict[str, Any], regions: str, words: str) -> None:
    given = Column(**{"name": "c", "metric": "mIoU", **column})
    found = words_of(given, table((), (given,), regions=regions))
    assert found == tuple(words.split())
    module, *arguments = command_of(found)
    expected = ("rgbt.evaluate", words)
    if given.frames is not None:
        frames = "next" if given.frames == "next" else "virtual"
        expected = ("rgbt.consistency", f"frames={frames}")
    made = {"details=size": "details=all", "details=boundary": "details=boundary,calibration"}
    assert (module, arguments) == (expected[0], [made.get(w, w) for w in expected[1].split()])
    assert {word.partition("=")[0] for word in arguments} <= set(types_of(OPTIONS[module]))


NOISE = {"_target_": "rgbt.corruptions.kinds.Noise", "image": "rgb", "seed": 0}
BASE = measurement(view="rgbt", step=4, settings=(("transform.test_short_edge", "48"),))


@pytest.mark.parametrize(
    ("words", "changed"),
    [
        ("", {}),
        ("modality=default", {}),
        ("modality=rgbt regions=ring5", {}),
        ("modality=thermal regions=ring9", {"view": "thermal", "partition": "ring9"}),
        ("head=source", {"head": "source"}),
        ("corruption=noise:rgb severity=16", {"severity": 16.0}),
        ("batch_norm=recomputed", {"statistics": "recomputed"}),
        (
            "batch_norm=adabn batch_norm_splits=day,night",
            {"statistics": "adabn", "statistics_of": ("day", "night")},
        ),
        (
            "regions=ring9 details=size",
            {"partition": "ring9-size-64-256-1024"},
        ),
        ("details=boundary", {"partition": "ring5-boundary-0.02"}),
        ("dataset.rgb_noise=0.1", {"dataset": "", "dataset_words": ("dataset.rgb_noise=0.1",)}),
    ],
)
def test_words_change_the_test_of_a_run(words: str, changed: dict[str, Any]) -> None:
    found, expected = measurement_of(tuple(words.split()), BASE), replace(BASE, **changed)
    if "corruption" in words:
        of_noise = {f"corruption.{key}": json.dumps(value) for key, value in NOISE.items()}
        expected = replace(expected, settings=(*sorted(of_noise.items()), *BASE.settings))
    assert found == expected
    assert found.dataset_words == expected.dataset_words


def stored(folder: Path, **measured: Measurement) -> RunResult:
    """A finished run, and files NAME.npz in its evaluations/ with these measurements."""
    run = RunResult(finish(folder, dataset=BASE.dataset).path)
    (run.folder / "evaluations").mkdir()
    own = run.counts()
    files = {OWN: BASE} | {f"evaluations/{name}.npz": found for name, found in measured.items()}
    for path, found in files.items():
        rows = number_of_regions(found.partition) or 3
        whole = np.repeat(own.counts, rows, axis=1)
        replace(own, counts=whole, measurement=found).save(run.folder / path)
    return run


def test_counts_are_found_by_what_they_are_of(tmp_path: Path) -> None:
    thermal = replace(BASE, view="thermal")
    run = stored(
        tmp_path / "run",
        a=replace(thermal, step=2),  # of the run before it was trained on
        b=replace(thermal, checkpoint="last"),
        c=replace(thermal, settings=settings_of({"transform.test_short_edge": 40})),
        d=replace(thermal, changed=("view",), absent="exclude"),
        test_rgb=replace(thermal, split="val"),
    )
    assert stored_at(run, ()) == OWN
    assert stored_at(run, ("modality=rgbt", "regions=ring5")) == OWN
    assert stored_at(run, ("modality=thermal",)) == "evaluations/d.npz"
    assert counts_of(run, ("modality=thermal",)).absent == BASE.absent, "as the run is scored"
    for words in (("modality=rgb",), ("modality=thermal", "regions=ring9")):
        assert stored_at(run, words) is None
        with pytest.raises(InputError, match=f"no counts of {' '.join(words)}; evaluate"):
            counts_of(run, words)


def test_statistics_are_of_the_usual_batches(tmp_path: Path) -> None:
    """The test of a run does not say of which: their size changes nothing of it."""
    size = "data.eval_batch_size"
    settings = tuple(sorted((*BASE.settings, (size, "2"))))
    made = replace(BASE, statistics="adabn", changed=("statistics",), settings=settings)
    other = replace(made, changed=(size, "statistics"))
    assert stored_at(stored(tmp_path / "other", a=other), ("batch_norm=adabn",)) is None
    run = stored(tmp_path / "run", a=other, b=made)
    assert stored_at(run, ("batch_norm=adabn",)) == "evaluations/b.npz"
    assert stored_at(run, ("batch_norm=batch",)) is None


def test_images_of_another_world_are_known_by_its_words(tmp_path: Path) -> None:
    def world(dataset: str, *words: str, **changed: Any) -> Measurement:
        return replace(BASE, dataset=dataset, dataset_words=words, **changed)

    run = stored(
        tmp_path / "run",
        a=world("x", "dataset.rgb_noise=0.1"),
        b=world("y", "dataset.rgb_noise=0.2", view="rgb"),
        c=world("y", "dataset.rgb_noise=0.2"),
        d=world("y", "dataset.rgb_noise=0.2", partition="ring9"),
        e=world("z"),
    )
    for words, name in (
        ("dataset.rgb_noise=0.1", "a"),
        ("dataset.rgb_noise=0.2", "c"),
        ("regions=ring9 dataset.rgb_noise=0.2", "d"),
        ("modality=rgb dataset.rgb_noise=0.2", "b"),
    ):
        assert stored_at(run, tuple(words.split())) == f"evaluations/{name}.npz"
    for words in ("dataset.rgb_noise=0.3", "regions=ring9 dataset.rgb_noise=0.1"):
        assert stored_at(run, tuple(words.split())) is None


def test_pairs_are_found_by_their_protocol(tmp_path: Path) -> None:
    made = ("aligned3-0123abcd", "aligned5", "released5", "next1-0123abcd")
    run = stored(
        tmp_path / "run", **{partition: replace(BASE, partition=partition) for partition in made}
    )
    for protocol, name in zip(("aligned", "released", "next"), made[1:], strict=True):
        assert stored_at(run, (f"frames={protocol}",)) == f"evaluations/{name}.npz"
    (run.folder / "evaluations" / "aligned5.npz").unlink()
    assert stored_at(run, ("frames=aligned",)) is None, "views of its own are other views"
    other = replace(BASE, partition="aligned5", view="rgb")
    assert stored_at(stored(tmp_path / "other", rgb=other), ("frames=aligned",)) is None

    run = stored(tmp_path / "pairs", pairs=replace(BASE, partition="aligned3"))
    (run.folder / OWN).unlink()
    assert stored_at(run, ("frames=aligned",)) == "evaluations/pairs.npz"
    assert stored_at(run, ("frames=released",)) is None, "pairs may be all that there is"
    assert stored_at(RunResult(tmp_path), ("frames=aligned",)) is None


SYNTH = (
    *("+experiment=mfnet", "masker.patch_size=null", "dataset=synth", "dataset.num_train=4"),
    *("dataset.num_val=2", "dataset.num_test=3", "scale.batch_size=2", *short(1), *ON_CPU),
)


@pytest.fixture
def run(trained: Trained, tmp_path: Path) -> RunResult:
    done = trained(*SYNTH)
    return RunResult(Path(shutil.copytree(done, tmp_path / "runs" / done.name)))


@pytest.mark.slow
@pytest.mark.parametrize(
    "words",
    [
        *("regions=ring9", "batch_norm=adabn", "batch_norm=recomputed batch_norm_splits=train,val"),
        "batch_norm=batch",
        *("corruption=noise:rgb severity=16", "corruption=removed:rgb"),
        "regions=ring9 corruption=noise severity=16 details=boundary",
        *("details=size", "frames=aligned", "frames=released"),
        "regions=ring9 dataset.rgb_noise=0.25 dataset.texture_strength=2.0",
        # Of a design whose `combined` cells have overrides of their own.
        "dataset.rgb_noise=0.25 dataset.rgb_noise=0.5",
        # A world of the images that the run was tested on.
        "dataset.num_test=3",
    ],
)
def test_the_command_of_words_makes_what_is_found_by_them(
    call: Call, run: RunResult, tmp_path: Path, words: str
) -> None:
    wanted: Words = tuple(words.split())
    assert stored_at(run, wanted) is None
    module, *arguments = command_of(wanted)
    place = (f"run={run.folder}", f"dataset.cache_dir={tmp_path / 'cache'}")
    code, _, err = call(ENTRIES[module], *place, *arguments)
    assert code == 0, err
    assert stored_at(run, wanted) is not None
    assert counts_of(run, wanted).names == run.counts().names
