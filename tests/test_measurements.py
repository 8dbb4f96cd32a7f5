"""No measurement replaces another one, and none is subtracted from another kind without a word."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from analysis import compare
from analysis.results import evaluations_of
from rgbt import evaluate, robustness
from rgbt.config.compose import conf_dir
from rgbt.metrics.counts import Counts
from rgbt.metrics.measurement import Measurement
from rgbt.runs.result import RunResult
from tests.commands import DAYS_AND_NIGHTS, ON_CPU, Call, Trained, short

ENTRY = evaluate.entry

# One change of every kind, and a word of the file that it must get.
CHANGES = {
    "split=val": "counts_val",
    "modality=thermal": "thermal",
    "regions=ring9": "ring9",
    "metric.regions=7": "ring7",
    "prediction.counted=image": "counted-image",
    "prediction.enlarged=released": "enlarged-released",
    "transform.test_short_edge=40": "test_short_edge-40",
    "trainer.precision=bf16-mixed": "precision-bf16-mixed",
    "corruption=noise severity=16": "noise-16",
    "corruption=noise severity=32": "noise-32",
    "corruption=noise severity=16 corruption.seed=3": "noise_seed-3-16",
    "corruption=occluded severity=0.5 corruption.block=16": "occluded_block-16-0.5",
    "checkpoint=last": "last-",
}


def evaluated(call: Call, folder: Path, words: str) -> tuple[Path, str]:
    """The file of counts that the command names, and its output."""
    code, out, err = call(ENTRY, f"run={folder}", *words.split())
    assert code == 0, err
    (line,) = (line for line in out.splitlines() if line.startswith("counts "))
    return Path(line.split()[1]), out


@pytest.fixture
def run(trained: Trained, tmp_path: Path) -> Path:
    done = trained("+experiment=crm", *short(2))
    return Path(shutil.copytree(done, tmp_path / "runs" / done.name))


@pytest.mark.slow
def test_no_setting_replaces_the_counts_of_another(call: Call, run: Path) -> None:
    before = {path: path.read_bytes() for path in run.rglob("*.npz")}
    made: dict[Path, Measurement] = {}
    for words, part in CHANGES.items():
        path, _ = evaluated(call, run, words)
        assert part in path.name
        assert path not in made
        made[path] = Counts.load(path).measurement
    assert {path: path.read_bytes() for path in before} == before
    assert len(set(made.values())) == len(CHANGES)
    contents = {path: path.read_bytes() for path in made}
    for words in CHANGES:  # what is measured is not measured again
        path, out = evaluated(call, run, words)
        assert f"{path} (measured before)" in out
    assert {path: path.read_bytes() for path in made} == contents
    known = RunResult(run).measurements()
    assert {path.relative_to(run).as_posix() for path in made} <= known.keys()


@pytest.mark.slow
def test_the_test_of_a_run_is_found_and_not_measured_again(call: Call, run: Path) -> None:
    for words in ("", "data.eval_batch_size=1", "modality=rgbt", "metric.absent=exclude"):
        path, out = evaluated(call, run, words)
        assert path == run / "counts_test.npz"
        assert "(measured before)" in out
    code, out, err = call(robustness.entry, f"run={run}", "corruptions=removed:rgb")
    assert code == 0, err
    assert {path.name for path in (run / "evaluations").glob("*.npz")} == {
        "test_thermal.npz",
        "test_rgb.npz",
        "test_rgb_removed.npz",
    }


def test_a_named_file_with_another_measurement_is_refused(
    call: Call, run: Path, tmp_path: Path
) -> None:
    out = tmp_path / "counts.npz"
    assert call(ENTRY, f"run={run}", f"out={out}", "modality=rgb")[0] == 0
    before = out.read_bytes()
    code, _, err = call(ENTRY, f"run={run}", f"out={out}", "modality=thermal")
    assert code == 2
    assert f"{out} holds another measurement (view)" in err
    assert out.read_bytes() == before


ON_SCENES = (
    *("dataset=synth", "dataset.num_train=4", "dataset.num_val=2", "dataset.num_test=4"),
    *("scale.batch_size=2", "scale.eval_batch_size=2", *ON_CPU),
)

# The pairs that the two sides of a comparison may not be, unless it says so.
PAIRS = {
    "view": ("modality=rgb", "modality=thermal"),
    "prediction.mirrored": ("", "prediction.mirrored=true"),
    "transform.test_short_edge": ("", "transform.test_short_edge=100"),
    "trainer.precision": ("", "trainer.precision=bf16-mixed"),
    "corruption._target_": ("corruption=noise severity=16", "corruption=removed:rgb"),
    "severity": ("corruption=noise severity=16", "corruption=noise severity=32"),
    "corruption.seed": (
        "corruption=noise severity=16",
        "corruption=noise severity=16 corruption.seed=3",
    ),
    "statistics": ("", "batch_norm=adabn"),
    "checkpoint": ("", "checkpoint=last"),
}
REFUSED = {"split": ("split=val", "split=test"), "regions": ("", "regions=ring9")}


@pytest.mark.slow
def test_differing_measurements_are_named_or_refused(
    call: Call, trained: Trained, tmp_path: Path
) -> None:
    done = trained("+experiment=mfnet", *ON_SCENES, *short(2))
    networks = []
    for name in ("one", "two"):
        networks.append(Path(shutil.copytree(done, tmp_path / name / done.name)))
    for key, words in (PAIRS | REFUSED).items():
        if key == "view":
            continue  # this network has one
        paths = []
        for number, (folder, each) in enumerate(zip(networks, words, strict=True)):
            path, _ = evaluated(call, folder, each)
            counts = Counts.load(path)
            copies = 12  # as many images as intervals need
            many = counts_of_many(counts, copies, number)
            paths.append(tmp_path / f"{key.rpartition('.')[2]}_{number}.npz")
            many.save(paths[-1])
        code, out, err = call(compare.entry, f"a={paths[0]}", f"b={paths[1]}", "resamples=100")
        if key in REFUSED:
            assert code == 2, key
            assert "cannot be compared" in err or "not of the same images" in err
        else:
            assert code == 0, err
            assert f"{key}: " in out.split("Measured differently (")[1]


def counts_of_many(counts: Counts, copies: int, moved: int) -> Counts:
    """Each image several times; `moved` pixels are predicted as another class."""
    names = tuple(f"{name}_{number}" for number in range(copies) for name in counts.names)
    array = np.concatenate([counts.counts] * copies)
    largest = np.unravel_index(array[0].argmax(), array[0].shape)
    array[:, largest[0], largest[1], largest[2]] -= moved
    array[:, largest[0], largest[1], (largest[2] + 1) % len(counts.classes)] += moved
    night = counts.night and counts.night * copies
    return Counts(
        counts=array,
        names=names,
        night=night,
        classes=counts.classes,
        unscored=counts.unscored,
        measurement=counts.measurement,
    )


@pytest.mark.slow
def test_heads_are_told_apart(call: Call, trained: Trained, tmp_path: Path) -> None:
    done = trained("+experiment=multi_head_night_stage1", *DAYS_AND_NIGHTS, *short(1))
    folder = Path(shutil.copytree(done, tmp_path / "runs" / done.name))
    first, second = (
        Counts.load(evaluated(call, folder, f"head={head}")[0]).measurement
        for head in ("own", "source")
    )
    assert first.unlike(second) == ("head: own, source",)
    assert second.file_name == "test_source-head.npz"


@pytest.mark.slow
def test_counts_of_an_earlier_step_are_no_counts_of_the_finished_run(call: Call, run: Path) -> None:
    path, _ = evaluated(call, run, "modality=thermal")
    counts = Counts.load(path)
    stale = replace(counts, measurement=replace(counts.measurement, step=1))
    stale.save(path)
    assert path.relative_to(run).as_posix() not in RunResult(run).measurements()
    assert "thermal" not in {found.condition for found in evaluations_of(RunResult(run))}
    again, out = evaluated(call, run, "modality=thermal")
    assert again == path
    assert "measured before" not in out
    assert Counts.load(path).measurement == counts.measurement


@pytest.mark.slow
def test_a_run_is_scored_in_one_way(call: Call, run: Path) -> None:
    """Whoever measured first with another rule does not decide how tables score."""
    path, _ = evaluated(call, run, "modality=thermal metric.absent=exclude")
    assert Counts.load(path).absent == "exclude"
    name = path.relative_to(run).as_posix()
    assert RunResult(run).counts(name).absent == RunResult(run).counts().absent == "released"


@pytest.mark.slow
def test_files_of_equal_names_are_other_corruptions(call: Call, run: Path, tmp_path: Path) -> None:
    text = (conf_dir() / "corruption" / "occluded.yaml").read_text()
    own = tmp_path / "own" / "occluded.yaml"
    own.parent.mkdir()
    own.write_text(text.replace("block: 32", "block: 16"))
    first, _ = evaluated(call, run, "corruption=occluded severity=0.5")
    second, _ = evaluated(call, run, f"corruption={own} severity=0.5")
    named = [Counts.load(path).measurement for path in (first, second)]
    assert named[0].unlike(named[1]) == ("corruption.block: 32, 16",)
    assert named[0].condition == "occluded"
    assert named[1].condition.startswith("occluded-")
    same, out = evaluated(call, run, "corruption=occluded severity=0.5 corruption.block=32")
    assert same == first
    assert "measured before" in out
