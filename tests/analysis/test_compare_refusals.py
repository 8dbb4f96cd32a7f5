"""What ``rgbt compare`` refuses: one sentence, exit code 2."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from analysis.compare import entry
from rgbt.metrics.counts import Counts
from tests.analysis.test_compare import FAST, pair
from tests.analysis.test_results import make_run
from tests.commands import Call, assert_one_sentence


@pytest.fixture
def files(tmp_path: Path) -> tuple[str, str]:
    a, b = pair()
    a.save(tmp_path / "crm.npz")
    b.save(tmp_path / "grbm.npz")
    return f"a={tmp_path}/crm.npz", f"b={tmp_path}/grbm.npz"


def spoilt(kind: str, b: Counts) -> Counts:
    changed = b.counts.copy()
    changed[3, 0, 0, 0] += 1
    return {
        "images": replace(b, names=tuple(f"1{name}" for name in b.names)),
        "classes": replace(b, classes=("road", "car", "person", "tree")),
        "number": replace(b, classes=("road", "car", "cone"), counts=b.counts[:, :, :3, :3]),
        "partition": replace(b, partition="vertical2"),
        "regions": replace(b, partition="ring1", counts=b.counts[:, :1]),
        "labels": replace(b, counts=changed),
        "few": b.select(b.names[:5]),
    }[kind]


@pytest.mark.parametrize(
    ("kind", "sentence"),
    [
        ("images", "the counts are of different images: such as"),
        ("classes", "counts of the classes road, car, person, cone cannot be compared"),
        ("number", "counts of the classes road, car, person, cone cannot be compared"),
        ("partition", "counts by ring2 cannot be compared with counts by vertical2"),
        ("regions", "counts by ring2 cannot be compared with counts by ring1"),
        ("labels", "'00003D' holds other labels in the one than in the other counts (1 images do)"),
    ],
)
def test_counts_that_cannot_be_compared(call: Call, tmp_path: Path, kind: str, sentence: str):
    a, b = pair()
    a.save(tmp_path / "a.npz")
    spoilt(kind, b).save(tmp_path / "b.npz")
    code, out, err = call(entry, f"a={tmp_path}/a.npz", f"b={tmp_path}/b.npz", *FAST)
    assert (code, out) == (2, "")
    assert_one_sentence(err, sentence)


@pytest.mark.parametrize(
    ("kind", "sentence"), [("images", "no image is in all counts"), ("few", "5 single images")]
)
def test_too_little_in_common(call: Call, tmp_path: Path, kind: str, sentence: str):
    a, b = pair()
    a.save(tmp_path / "a.npz")
    spoilt(kind, b).save(tmp_path / "b.npz")
    arguments = f"a={tmp_path}/a.npz", f"b={tmp_path}/b.npz", "missing=leave_out"
    code, out, err = call(entry, *arguments, *FAST)
    assert (code, out) == (2, "")
    assert sentence in err.splitlines()[-1]
    assert "Traceback" not in err


@pytest.mark.parametrize(
    ("argument", "sentence"),
    [
        ("metrics=mIuo", "'mIuo' is not a metric; did you mean 'mIoU'?"),
        ("metrics=", "'': expected metrics, with commas between them."),
        ("metrics=region/9", "the counts have the regions 1 to 2"),
        ("metrics=class/cat", "did you mean 'car'?"),
        ("metrics=night/mIoU", "does not hold images of day and of night"),
        ("metric=mIoU", "'metric' has no effect here; did you mean 'metrics'?"),
        ("mIoU", "'mIoU': expected key=value"),
        ("level=2", "level must lie in [0.5, 0.999], got 2"),
        ("level=nan", "'level' must be a number"),
        ("level=high", "'level' must be a number"),
        ("resamples=5", "'resamples' must be a whole number from 100 to 1000000, got 5"),
        ("resamples=nan", "'resamples' must be a whole number"),
        ("resamples=inf", "'resamples' must be a whole number"),
        ("resamples=200.5", "'resamples' must be a whole number"),
        ("seed=x", "'seed' must be a whole number"),
        ("seed=0.5", "'seed' must be a whole number"),
        ("blocks=abc", "'blocks' must be 'auto'"),
        ("seed=-1", "'seed' must be a whole number"),
        ("blocks=0", "'blocks' must be 'auto'"),
        ("blocks=-3", "'blocks' must be 'auto'"),
        ("blocks=20", "blocks=20: 40 images make 2 blocks"),
        ("blocks=sequence", "blocks=sequence: 40 images make 1 sequences"),
        ("method=t", "'method' must be"),
        ("absent=zero", "'absent' must be"),
        ("missing=foo", "'missing' must be"),
    ],
)
def test_bad_arguments(call: Call, files: tuple[str, str], argument: str, sentence: str):
    code, out, err = call(entry, *files, *FAST, argument)
    assert (code, out) == (2, "")
    assert_one_sentence(err, sentence)


def test_the_same_file_twice(call: Call, files: tuple[str, str]):
    a = files[0].partition("=")[2]
    code, _, err = call(entry, f"a={a}", f"b={a}", *FAST)
    assert code == 2
    assert_one_sentence(err, "a and b both hold ")
    code, _, err = call(entry, f"a={a},{a}", files[1], *FAST)
    assert code == 2
    assert_one_sentence(err, "twice; one training counts once")


def test_no_such_run_group_or_folder(call: Call, files: tuple[str, str], tmp_path: Path):
    make_run(tmp_path / "runs", "aaa0", "crm", 0)
    (tmp_path / "empty").mkdir()
    place = f"runs_dir={tmp_path}/runs"
    for b, sentence in (
        ("b=crn", "'crn' is no run folder, config key or MLflow run id"),
        ("b=crn", "did you mean 'crm'?"),
        (f"b={tmp_path}/empty", "holds neither a run (config.yaml) nor counts"),
        (f"b={tmp_path}/none.npz", "there is no file of counts"),
        ("b=", "'b' has no value; give a run, a file of counts, or a group of runs. Groups in"),
        ("b=", ": crm."),
        ("b=crm,", "expected runs, files of counts or a group"),
    ):
        code, out, err = call(entry, files[0], b, place, *FAST)
        assert (code, out) == (2, "")
        assert_one_sentence(err, sentence)


def test_both_sides_must_be_given(call: Call, files: tuple[str, str]):
    code, _, err = call(entry, files[0])
    assert code == 2
    assert_one_sentence(err, "'b' has no value")


def test_out_that_is_a_file(call: Call, files: tuple[str, str], tmp_path: Path):
    (tmp_path / "taken").write_text("")
    code, _, err = call(entry, *files, *FAST, f"out={tmp_path}/taken")
    assert code == 2
    assert_one_sentence(err, "taken")


def test_a_file_of_another_split(call: Call, files: tuple[str, str]):
    code, _, err = call(entry, *files, "split=val")
    assert code == 2
    assert_one_sentence(err, "is of split 'test', not of split=val")
