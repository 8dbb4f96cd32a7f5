"""Weights from a file, where a user names them: training, evaluating, predicting, the run's key."""

from __future__ import annotations

import json
import shutil
from itertools import product
from pathlib import Path

import numpy as np
import pytest
import torch

from rgbt import evaluate
from rgbt.metrics.counts import Counts
from rgbt.runs.specify import specify
from rgbt.weights import entry as weights_main
from tests.commands import Call, Trained, assert_one_sentence, only_run, short, train
from tests.models.golden import SHARED, compose

EVALUATE = evaluate.entry
REAL = SHARED / "realdata"
ONE = ("+experiment=mfnet", "masker.patch_size=null", *short(1))


@pytest.mark.parametrize("fresh", [(), ("model.fresh=[decode1.]", "seed=7")])
def test_a_run_starts_from_another_runs_weights(
    call: Call, data: Path, trained: Trained, tmp_path: Path, fresh: tuple[str, ...]
) -> None:
    first = trained(*ONE)
    still = ("optimizer.lr=1.0e-30", f"model.weights={first}", *fresh)
    code, _, err = train(call, data, tmp_path / "second", *ONE, *still)
    assert code == 0, err
    before, after = (
        torch.load(folder / "best.pt", weights_only=True)["model"]
        for folder in (first, only_run(tmp_path / "second"))
    )
    moved = [key for key in before if not torch.equal(before[key], after[key])]
    # The step of a training moves running statistics, and at this rate nothing else.
    named = [key for key in moved if "running" not in key and "num_batches" not in key]
    assert all(key.startswith("decode1.") for key in named)
    assert ("decode1.conv.weight" in named) == bool(fresh)
    code, _, err = call(EVALUATE, f"run={only_run(tmp_path / 'second')}")
    assert code == 0, err


def test_weights_are_scored_without_a_run(
    call: Call, data: Path, trained: Trained, tmp_path: Path
) -> None:
    folder = trained(*ONE)
    named = (
        *("model=mfnet_tiny", f"model.weights={folder}", f"dataset.root={data}"),
        *(f"runs_dir={tmp_path}", "data.num_workers=0", "trainer.threads=1"),
    )
    code, out, err = call(EVALUATE, *named)
    assert code == 0, err
    assert "mIoU" in out
    (written,) = tmp_path.glob("evaluations/*/test_ring5_*.npz")
    stored = Counts.load(folder / "counts_test.npz")
    assert np.array_equal(Counts.load(written).counts, stored.counts)


@pytest.mark.slow
def test_other_inputs_are_reported(
    call: Call, data: Path, trained: Trained, tmp_path: Path
) -> None:
    first = trained(*ONE)
    # An export carries what it was fed with; the released layout of MFNet has no room for that.
    exported = tmp_path / "mine.safetensors"
    words = ("export", f"run={first}", "format=safetensors", f"out={exported}")
    assert call(weights_main, *words)[0] == 0
    for number, (weights, inputs) in enumerate(product((first, exported), ("unit", "crm"))):
        words = (f"model.weights={weights}", f"model/inputs={inputs}")
        code, _, err = train(call, data, tmp_path / str(number), *ONE, *words)
        assert code == 0, err
        assert ("but this network has other settings" in err) == (inputs == "crm")


@pytest.mark.parametrize(
    ("words", "key"),
    [
        (("model.weights={run}", "model.fresh=[decode1]"), "initial values (decode1."),
        (("model.weights={run}", "checkpoint=last"), "checkpoint"),
        (("model.weights=nowhere.pth",), "nowhere.pth"),
        ((), "run"),
    ],
)
def test_wrong_weights_are_not_scored(
    call: Call, data: Path, trained: Trained, words: tuple[str, ...], key: str
) -> None:
    named = [word.format(run=trained(*ONE)) for word in words]
    code, _, err = call(EVALUATE, "model=mfnet_tiny", f"dataset.root={data}", *named)
    assert code == 2
    assert key in err


@pytest.mark.parametrize("word", ["model.weights=nowhere.pth", "model.fresh=[decode1]"])
def test_wrong_weights_are_not_trained(call: Call, data: Path, tmp_path: Path, word: str) -> None:
    code, _, err = train(call, data, tmp_path, "+experiment=mfnet", word)
    assert code == 2
    assert_one_sentence(err, word.partition("=")[2 * ("weights" in word)])


def test_a_network_of_one_image_is_scored_from_it(call: Call, data: Path, tmp_path: Path) -> None:
    words = ("+experiment=mfnet", "model=heatnet_tiny", "model.modalities=rgb")
    code, _, err = train(call, data, tmp_path, *words, "masker.patch_size=null", *short(1))
    assert code == 0, err
    folder = only_run(tmp_path)
    code, _, err = call(EVALUATE, f"run={folder}")
    assert code == 0, err
    assert Counts.load(folder / "counts_test.npz").measurement.view == "rgb"
    assert not (folder / "evaluations").exists(), "it was measured before"
    code, _, err = call(EVALUATE, f"run={folder}", "modality=thermal")
    assert code == 2
    assert_one_sentence(err, "modality")


def test_key_follows_the_content_of_the_file(tmp_path: Path) -> None:
    first, copy, other = (tmp_path / name for name in ("a.pth", "b.pth", "c.pth"))
    first.write_bytes(b"weights")
    shutil.copy(first, copy)
    other.write_bytes(b"other weights")
    keys = [specify(compose(f"model.weights={path}")).key for path in (first, copy, other)]
    assert keys[0] == keys[1] != keys[2]
    assert specify(compose()).key not in keys
    assert specify(compose(f"model.weights={first}", "model.fresh=[head]")).key not in keys


@pytest.mark.slow
@pytest.mark.skipif(not (REAL / "mfnet_weights").is_dir(), reason="real data is not here")
def test_released_weights_give_the_known_counts(call: Call, tmp_path: Path) -> None:
    code, _, err = call(
        EVALUATE,
        "model=mfnet",
        f"model.weights={REAL / 'mfnet_weights' / 'final.pth'}",
        f"dataset.root={REAL / 'mfnet200'}",
        "dataset.splits.test=val.txt",
        "split=val",
        f"out={tmp_path / 'counts.npz'}",
        "data.num_workers=0",
    )
    assert code == 0, err
    known = json.loads((REAL / "mfnet_weights" / "expected_confusions.json").read_text())
    expected = np.array(known["MFNet_final_pth/val"]["confusion"])
    found = Counts.load(tmp_path / "counts.npz").whole()
    assert np.abs(found - expected).sum() // 2 == 0, "pixels that differ"
