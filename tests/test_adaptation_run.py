"""Every experiment on days and nights, end to end: heads, resumed runs, and what does not fit."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch

from rgbt.checkpoints.stored import save
from rgbt.config.component import build
from rgbt.config.compose import compose
from rgbt.engine.checkpoint import load_checkpoint
from rgbt.metrics.counts import Counts
from rgbt.schemes.adversarial import Adversarial
from rgbt.spec.specify import specify
from tests.commands import Call, assert_one_sentence
from tests.conftest import write_png
from tests.test_run import ADAPTATION, EXPERIMENTS

ROOT = Path(__file__).resolve().parents[1]
SIZES = (
    *("dataset=synth_freiburg", "dataset.num_train_day=6", "dataset.num_train_night=5"),
    *("dataset.num_val=2", "dataset.num_test=4"),
)
SMALL = (
    *("scale.batch_size=2", "scale.eval_batch_size=4", "scale.critic_width=4", "tracking=none"),
    *("trainer.accelerator=cpu", "trainer.threads=1", "trainer.log_every=1"),
)
QUICK = ("multi_head_night",)
"""Two kinds; the others are like one of them, or run below, and are slow."""


def short(steps: int) -> tuple[str, ...]:
    return f"trainer.max_steps={steps}", f"trainer.eval_every={steps}", "trainer.checkpoint_every=2"


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("adaptation")


class Runs:
    """Calls `rgbt.run` on the small data set; a finished run is found again."""

    def __init__(self, call: Call, place: Path, runs: Path) -> None:
        self.call, self.cache, self.runs = call, place / "cache", runs

    def words(self, experiment: str, *overrides: str) -> list[str]:
        return [
            *(f"+experiment={experiment}", *SIZES, f"dataset.cache_dir={self.cache}", *SMALL),
            *(f"runs_dir={self.runs}", *(() if "max_steps" in str(overrides) else short(2))),
            *overrides,
        ]

    def folder(self, experiment: str, *overrides: str) -> Path:
        """Of a run, whether it is there or not."""
        return self.runs / specify(compose(self.words(experiment, *overrides))).key

    def told(self, experiment: str, *overrides: str) -> tuple[int, str, str]:
        from rgbt.run import main

        return self.call(main, *self.words(experiment, *overrides))

    def __call__(self, experiment: str, *overrides: str) -> Path:
        """Of a run that is finished."""
        folder = self.folder(experiment, *overrides)
        if not (folder / "result.json").exists():
            code, _, err = self.told(experiment, *overrides)
            assert code == 0, err
            assert (folder / "result.json").exists()
        return folder


@pytest.fixture
def run(call: Call, place: Path) -> Runs:
    """In the folder of runs that all tests of this module share."""
    return Runs(call, place, place / "runs")


@pytest.fixture
def elsewhere(call: Call, place: Path, tmp_path: Path) -> Callable[[str], Runs]:
    return lambda name: Runs(call, place, tmp_path / name)


@pytest.fixture
def evaluated(call: Call, tmp_path: Path) -> Callable[..., Counts]:
    """Counts of `rgbt.evaluate` of a run folder."""
    from rgbt import evaluate

    def evaluate_run(folder: Path, *words: str) -> Counts:
        out = tmp_path / "evaluated.npz"
        entry = evaluate.entry
        code, _, err = call(entry, f"run={folder}", f"out={out}", *words)
        assert code == 0, err
        return Counts.load(out)

    return evaluate_run


# ---- every experiment -----------------------------------------------------------------------


def mean_of_twelve(matrix: np.ndarray) -> float:
    """mIoU by hand; a class without pixels is 0."""
    ious = []
    for k in range(12):
        union = matrix[k].sum() + matrix[:, k].sum() - matrix[k, k]
        ious.append(matrix[k, k] / union if union else 0.0)
    return float(np.mean(ious))


@pytest.mark.parametrize(
    "experiment",
    [
        pytest.param(name, marks=() if name in QUICK else pytest.mark.slow)
        for name in EXPERIMENTS
        if name.startswith(ADAPTATION)
    ],
)
def test_every_experiment_trains_and_counts_every_image(run: Runs, experiment: str) -> None:
    folder = run(experiment)
    counts = Counts.load(folder / "counts_test.npz")
    dataset = build(compose(run.words(experiment)).dataset)
    assert counts.names == dataset.names("test")
    assert counts.night == (False, False, True, True)
    assert counts.unscored == ("background", "ignore")
    labels = np.stack([dataset.read(name).label for name in counts.names])
    assert counts.counts.sum() == (labels != 255).sum()
    lines = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    assert [(line["kind"], line["step"]) for line in lines] == [
        *(("train", 1), ("train", 2), ("val", 2), ("test", 2))
    ]
    scores = lines[-1]["values"]
    by_image = counts.counts.sum(1)
    assert scores["mIoU"] == pytest.approx(mean_of_twelve(by_image.sum(0)))
    assert scores["day/mIoU"] == pytest.approx(mean_of_twelve(by_image[:2].sum(0)))
    assert scores["night/mIoU"] == pytest.approx(mean_of_twelve(by_image[2:].sum(0)))
    result = json.loads((folder / "result.json").read_text())
    assert (result["best_step"], result["steps"]) == (2, 2)


@pytest.mark.slow
@pytest.mark.parametrize("scheme", ["entropy", "adversarial_adaptsegnet", "adversarial_released"])
def test_schemes_that_no_experiment_chooses(run: Runs, scheme: str) -> None:
    heads = scheme == "adversarial_released"
    experiment = "multi_head_thermal" if heads else "sh_adversarial"
    extra = ["domains.target.labels=given"] if heads else []
    folder = run(experiment, f"scheme={scheme}", "model.weights=null", *extra)
    assert (folder / "counts_test.npz").exists()


# ---- heads ----------------------------------------------------------------------------------


def without_head(folder: Path, head: str, place: Path) -> Path:
    """A copy of a run whose head scores nothing: it predicts class 0 everywhere."""
    shutil.copytree(folder, place)
    payload = load_checkpoint(place / "best.pt")
    zeroed = [name for name in payload["model"] if name.startswith(f"heads.{head}.")]
    assert zeroed
    for name in zeroed:
        payload["model"][name].zero_()
    save(place / "best.pt", payload)
    return place


def only_road(counts: np.ndarray) -> bool:
    return not counts[..., 1:].any()


@pytest.mark.slow
def test_night_images_are_predicted_by_the_targets_head(
    run: Runs, evaluated: Callable[..., Counts], tmp_path: Path
) -> None:
    folder = run("multi_head_night")
    whole = Counts.load(folder / "counts_test.npz").counts
    night, day = slice(2, 4), slice(0, 2)
    target = evaluated(without_head(folder, "target", tmp_path / "target")).counts
    assert only_road(target[night])
    assert not only_road(target[day])
    assert np.array_equal(target[day], whole[day])
    source = evaluated(without_head(folder, "source", tmp_path / "source")).counts
    assert only_road(source[day])
    assert np.array_equal(source[night], whole[night])
    # And as asked.
    assert only_road(evaluated(tmp_path / "target", "head=target").counts)
    assert not only_road(evaluated(tmp_path / "target", "head=source").counts[night])
    assert np.array_equal(evaluated(folder, "head=own").counts, whole)


@pytest.mark.slow
def test_one_head_for_all_as_the_thesis_scripts(
    run: Runs, evaluated: Callable[..., Counts]
) -> None:
    own, one = run("multi_head_night"), run("multi_head_night", "domains.tested_head=source")
    assert own.name != one.name
    weights = [load_checkpoint(folder / "best.pt")["model"] for folder in (own, one)]
    assert all(torch.equal(weights[0][name], weights[1][name]) for name in weights[0])
    counts = Counts.load(one / "counts_test.npz").counts
    assert np.array_equal(evaluated(own, "head=source").counts, counts)
    assert np.array_equal(
        evaluated(one, "head=own").counts, Counts.load(own / "counts_test.npz").counts
    )
    assert not np.array_equal(counts[2:], Counts.load(own / "counts_test.npz").counts[2:])


@pytest.mark.slow
def test_thermal_images_are_predicted_by_the_targets_head(
    run: Runs, evaluated: Callable[..., Counts], tmp_path: Path
) -> None:
    folder = run("multi_head_thermal")
    broken = without_head(folder, "target", tmp_path / "broken")
    assert only_road(evaluated(broken, "modality=thermal").counts)
    whole = Counts.load(folder / "counts_test.npz").counts
    assert np.array_equal(evaluated(broken).counts, whole)
    assert np.array_equal(evaluated(broken, "modality=rgb").counts, whole)
    thermal = evaluated(folder, "modality=thermal").counts
    assert not only_road(thermal)
    assert not np.array_equal(thermal, whole)
    # The run's own tables hold the same score.
    values = json.loads((folder / "metrics.jsonl").read_text().splitlines()[-1])["values"]
    assert values["thermal/mIoU"] == pytest.approx(mean_of_twelve(thermal.sum((0, 1))))


@pytest.mark.slow
def test_the_targets_counts_are_stored(run: Runs, evaluated: Callable[..., Counts]) -> None:
    """Its scores in every line follow from them."""
    folder = run("multi_head_thermal")
    lines = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    for split in ("val", "test"):
        stored = Counts.load(folder / f"counts_{split}_thermal.npz")
        again = evaluated(folder, "modality=thermal", f"split={split}")
        assert (stored.split, stored.names) == (split, again.names)
        assert np.array_equal(stored.counts, again.counts)
        (values,) = (line["values"] for line in lines if line["kind"] == split)
        by_image = stored.counts.sum(1)
        assert values["thermal/mIoU"] == pytest.approx(mean_of_twelve(by_image.sum(0)))
    day, night = mean_of_twelve(by_image[:2].sum(0)), mean_of_twelve(by_image[2:].sum(0))
    assert (values["thermal/day/mIoU"], values["thermal/night/mIoU"]) == pytest.approx((day, night))
    for name in ("multi_head_night", "sh_source"):  # seen as the source is
        assert not list(run(name).glob("counts_*_*.npz"))


def heads_line(said: str) -> list[str]:
    return [" ".join(line.split()) for line in said.splitlines() if line.split()[:1] == ["heads"]]


@pytest.mark.parametrize(
    ("experiment", "own"),
    [
        ("multi_head_night", "source by day, target at night"),
        ("multi_head_thermal", "target for thermal, source otherwise"),
        ("sh_source", None),
    ],
)
@pytest.mark.slow
def test_which_head_predicted_what_is_said(
    run: Runs, call: Call, tmp_path: Path, experiment: str, own: str | None
) -> None:
    from rgbt import evaluate

    folder = run(experiment)
    expected = [] if own is None else [f"heads {own}"]
    _, said, _ = run.told(experiment)
    assert heads_line(said) == expected
    asked = {"as trained": expected}
    if own is not None:
        asked |= {head: [f"heads {head} for all images"] for head in ("source", "target")}
    for head, line in asked.items():
        words = (f"run={folder}", f"head={head}", f"out={tmp_path / 'x.npz'}")
        code, said, err = call(evaluate.entry, *words)
        assert code == 0, err
        assert heads_line(said) == line


def test_images_of_ones_own_are_predicted_with_the_head_that_is_asked(
    run: Runs, call: Call, tmp_path: Path
) -> None:
    from rgbt import predict

    folder = run("multi_head_night")
    broken = without_head(folder, "target", tmp_path / "broken")
    dataset = build(compose(run.words("multi_head_night")).dataset)
    sample = dataset.read(dataset.names("test_day")[0])
    write_png(tmp_path / "mine" / "street.png", np.dstack([sample.rgb, sample.thermal]))
    entry, out = predict.entry, tmp_path / "out"
    words = (f"run={broken}", f"input={tmp_path / 'mine'}", f"out={out}")
    code, _, err = call(entry, *words)
    assert code == 2
    assert_one_sentence(err, "so no head can be chosen; set head=source or head=target")

    found = {}
    for head in ("source", "target"):
        code, _, err = call(entry, *words, f"head={head}")
        assert code == 0, err
        found[head] = cv2.imread(str(out / "street.png"), cv2.IMREAD_UNCHANGED)
    assert not found["target"].any()
    assert found["source"].any()


@pytest.mark.slow
def test_a_stage_begins_with_the_network_of_the_one_before(run: Runs) -> None:
    """With a rate of almost 0 it is that network still, and the teacher's labels are there."""
    stage = run("multi_head_night_stage1")
    second = run("multi_head_night", "optimizer.lr=1e-30", "scheme.critic_optimizer.lr=1e-30")
    before = load_checkpoint(stage / "last.pt")["model"]
    after = load_checkpoint(second / "last.pt")["model"]
    parameters = [name for name in before if "running" not in name and "num_batches" not in name]
    assert parameters
    assert all(torch.equal(before[name], after[name]) for name in parameters)
    (labels,) = run("thermal_teacher").glob("pseudo_labels/*/pseudo_labels.json")
    said = json.loads(labels.read_text())
    assert (said["split"], said["view"], said["images"]) == ("train_night", "thermal", 5)
    assert said["teacher"] == run("thermal_teacher").name


# ---- killed and continued -------------------------------------------------------------------


def heatnets(run: Runs) -> list[str]:
    """HeatNet on labels from a folder, so that it can be trained anywhere."""
    run("heatnet")
    (folder,) = run("thermal_teacher").glob("pseudo_labels/*")
    return ["heatnet", f"domains.target.labels={folder}", "domains.target.teacher_view=null"]


RESUMED: dict[str, tuple[Callable[[Runs], list[str]], int]] = {
    # The sixth step, after the segmentation has stepped.
    "one head": (lambda _: ["sh_adversarial", "model.weights=null"], 6),
    "two heads": (lambda _: ["multi_head_thermal", "model.weights=null"], 6),
    # Steps 1, 3, 5 are the discriminator's: the fifth one.
    "heatnet": (heatnets, 3),
}


def assert_same_runs(one: Path, other: Path) -> None:
    assert one.name == other.name
    payloads = [load_checkpoint(each / "last.pt") for each in (one, other)]
    for part in ("model", "others", "optimizers"):
        assert_equal(payloads[0][part], payloads[1][part])
    assert payloads[0]["others"]
    for split in ("val", "test"):
        counts = [Counts.load(each / f"counts_{split}.npz").counts for each in (one, other)]
        assert np.array_equal(*counts)
    assert losses(one) == losses(other)


def assert_equal(one: Any, other: Any) -> None:
    if isinstance(one, torch.Tensor):
        assert torch.equal(one, other)
    elif isinstance(one, dict):
        assert one.keys() == other.keys()
        for key in one:
            assert_equal(one[key], other[key])
    elif isinstance(one, list):
        assert len(one) == len(other)
        for a, b in zip(one, other, strict=True):
            assert_equal(a, b)
    else:
        assert one == other


def losses(folder: Path) -> list[dict[str, float]]:
    lines = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    return [
        {name: value for name, value in line["values"].items() if name.startswith(("loss", "grad"))}
        for line in lines
        if line["kind"] == "train"
    ]


@pytest.mark.parametrize(
    "case",
    [
        *(pytest.param(name, marks=pytest.mark.slow) for name in ("one head", "two heads")),
        "heatnet",
    ],
)
def test_stopped_in_the_critics_phase_and_continued(
    run: Runs,
    elsewhere: Callable[[str], Runs],
    monkeypatch: pytest.MonkeyPatch,
    case: str,
) -> None:
    words, at = RESUMED[case][0](run), RESUMED[case][1]
    stopped, straight, calls = elsewhere("stopped"), elsewhere("straight"), 0

    def stop(self: Adversarial, seen: Any) -> Any:
        nonlocal calls
        calls += 1
        if calls == at:
            raise KeyboardInterrupt
        return phase(self, seen)

    phase = Adversarial._discriminator_phase
    with monkeypatch.context() as patch:
        patch.setattr(Adversarial, "_discriminator_phase", stop)
        assert stopped.told(*words, *short(6))[0] == 130
    folder = stopped.folder(*words, *short(6))
    assert not (folder / "result.json").exists()
    code, _, err = stopped.told(*words, *short(6))
    assert code == 0, err
    assert "resumes at step 4" in err
    assert_same_runs(folder, straight(*words, *short(6)))
    named = {name for line in losses(folder) for name in line}
    assert {"loss/critic/source", "loss/critic/target", "loss/target/adversarial"} <= named


KILL = """
import os, signal, sys
from rgbt.run import main
from rgbt.schemes.adversarial import Adversarial
phase, calls, at = Adversarial._discriminator_phase, [], int(sys.argv.pop(1))
def kill(self, seen):
    calls.append(1)
    if len(calls) == at:
        os.kill(os.getpid(), signal.SIGKILL)
    return phase(self, seen)
Adversarial._discriminator_phase = kill
main()
"""


@pytest.mark.slow
@pytest.mark.parametrize("case", ["one head", "heatnet"])
def test_killed_in_the_critics_phase_and_continued(
    run: Runs, elsewhere: Callable[[str], Runs], case: str
) -> None:
    words, at = RESUMED[case][0](run), RESUMED[case][1]
    killed, straight = elsewhere("killed"), elsewhere("straight")
    process = subprocess.run(
        [sys.executable, "-c", KILL, str(at), *killed.words(*words, *short(6))],
        cwd=ROOT,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
        capture_output=True,
        check=False,
    )
    assert process.returncode == -signal.SIGKILL, process.stderr
    code, _, err = killed.told(*words, *short(6))
    assert code == 0, err
    assert "resumes at step 4" in err
    assert_same_runs(killed.folder(*words, *short(6)), straight(*words, *short(6)))


@pytest.mark.slow
def test_a_step_of_two_batches_is_of_one_phase(run: Runs) -> None:
    folder = run("heatnet_no_teacher", "trainer.accumulate=2", *short(4))
    for number, line in enumerate(losses(folder)):
        assert ("loss/critic/source" in line) == (number % 2 == 0)
        assert ("loss/source/cross_entropy" in line) == (number % 2 == 1)


# ---- what does not fit ----------------------------------------------------------------------


def labels_of(place: Path, **changes: Any) -> Path:
    """A folder that says of itself that it holds pseudo-labels."""
    from rgbt.data.pseudo_labels import FORMAT

    place.mkdir(parents=True)
    said = {"format": FORMAT, "digest": "abc", "classes": ["road", "car"], **changes}
    (place / "pseudo_labels.json").write_text(json.dumps(said))
    return place


BAD: dict[str, tuple[list[str], str]] = {
    "no teacher's folder": (
        ["sh_both", "domains.target.labels=/no/such"],
        "domains.target.labels=/no/such: expected given, none, experiment:NAME/best.pt",
    ),
    "teacher of other classes": (
        ["sh_both", "domains.target.labels=FOLDER"],
        "have the classes road, car, but synth_freiburg has road, sidewalk",
    ),
    "no target": (
        ["sh_source", "scheme=adversarial_thesis"],
        "Adversarial requires num_domains=2 of the domains, Domains provides num_domains=1; choo",
    ),
    "no scheme for a target": (
        ["sh_both", "scheme=supervised"],
        "requires num_domains=2 of the scheme, Supervised provides num_domains=1; choose scheme=",
    ),
    "labels missing": (
        ["sh_adversarial", "scheme.supervise_target=true"],
        "with scheme.supervise_target=true requires target_labels=true of the domains",
    ),
    "labels not read": (
        ["sh_adversarial", "domains.target.labels=given"],
        "with scheme.supervise_target=false requires target_labels=false of the domains",
    ),
    "source without labels": (
        ["sh_source", "domains.source.labels=none"],
        "domains.source.labels=none, but every scheme reads labels of the source",
    ),
    "no such head": (
        ["multi_head_thermal_stage1", "domains.source.head=left"],
        "domains.source.head=left requires heads=left of the model, DeepLabV2 provides heads=sou",
    ),
    "heads of a network with one": (
        ["multi_head_thermal_stage1", "model.heads=[main]"],
        "domains.source.head=source requires heads=source of the model, DeepLabV2 provides heads=m",
    ),
    "a head that nothing trains": (
        ["sh_source", "model.heads=[source,target]"],
        "DeepLabV2 requires heads=source,target of the domains, Domains provides heads=",
    ),
    "network without scores": (
        ["sh_both", "model=mask2former_tiny", "loss=set_criterion"],
        "requires outputs=scores of the model, Mask2Former provides outputs=masks; choose model=",
    ),
    "loss that reads masks": (
        ["sh_both", "loss=set_criterion"],
        "requires outputs=masks of the model, DeepLabV2 provides outputs=scores; choose loss=cro",
    ),
    "masker that hides": (
        ["sh_both", "masker=square"],
        "requires hides_cells=false of the masker, Masker provides hides_cells=true; choose mask",
    ),
    "a view the network has not": (
        ["heatnet_no_teacher", "domains.source.view=thermal"],
        "Domains with domains.source.view=thermal requires views=thermal of the model, PSPNet",
    ),
    "an unknown split": (["sh_source", "domains.source.split=dusk"], "no split 'dusk'"),
    "batch above the target": (
        ["sh_both", "domains.target.split=train_night", "scale.batch_size=6"],
        "data.batch_size is 6 but split 'train_night' of synth_freiburg has only 5",
    ),
    "scheme that knows no domains": (
        ["sh_both", "scheme=temporal_paper", "loss=temporal_paper"],
        "Domains requires num_domains=2 of the scheme, Temporal provides num_domains=1; choose ",
    ),
    "found before earlier runs are trained": (
        ["multi_head_night", "scheme.weight=-1"],
        "'scheme.weight' must be a number from 0",
    ),
    "found before a teacher is trained": (
        ["multi_head_night_stage1", "masker=square"],
        "requires hides_cells=false of the masker",
    ),
    "confidence that is not read": (
        ["heatnet_no_teacher", "scheme.weighed_by_confidence=true"],
        "requires target_confidence=true of the domains, Domains provides target_confidence=false",
    ),
}


@pytest.mark.parametrize(("words", "sentence"), BAD.values(), ids=BAD)
def test_what_does_not_fit_is_one_sentence_and_leaves_nothing(
    elsewhere: Callable[[str], Runs], tmp_path: Path, words: list[str], sentence: str
) -> None:
    folder = labels_of(tmp_path / "labels")
    bad = elsewhere("bad")
    code, _, err = bad.told(*(word.replace("FOLDER", str(folder)) for word in words))
    assert code == 2, err
    assert_one_sentence(err, sentence)
    assert not list(bad.runs.glob("*/*")), "nothing is left behind"


def test_an_empty_target_split_is_told_before_its_teacher_is_trained(
    elsewhere: Callable[[str], Runs], place: Path, tmp_path: Path, run: Runs
) -> None:
    words = run.words("sh_source")
    dataset = build(compose(words).dataset)
    root = tmp_path / "freiburg"
    shutil.copytree(dataset.root, root)
    for path in [*root.rglob("*night*")]:
        if path.is_dir() and "train" in path.parts:
            shutil.rmtree(path, ignore_errors=True)
    bad = elsewhere("bad")
    own = ["dataset=freiburg", f"dataset.root={root}", "dataset.crop=[1,97,48,240]"]
    given = [
        word for word in bad.words("multi_head_night_stage1") if not word.startswith("dataset")
    ]
    from rgbt.run import main

    code, _, err = bad.call(main, *given, *own)
    assert code == 2, err
    assert_one_sentence(err, "train_night")
    assert not list(bad.runs.glob("*/*"))
