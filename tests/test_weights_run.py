"""Weights from a file, where a user names them: training, evaluating, predicting, the run's key."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch

from rgbt import evaluate, predict
from rgbt.metrics.counts import Counts
from rgbt.spec.specify import specify
from rgbt.weights import entry as weights_main
from tests.commands import Call, Trained, assert_one_sentence, only_run, short, train
from tests.models.golden import SHARED, compose

EVALUATE = evaluate.entry
REAL = SHARED / "realdata"


ONE = ("+experiment=mfnet", "masker.patch_size=null", *short(1))
"""One step of a small network."""


def test_a_run_starts_from_another_runs_weights(
    call: Call, data: Path, trained: Trained, tmp_path: Path
) -> None:
    first = trained(*ONE)
    still = ("optimizer.lr=1.0e-30", f"model.weights={first}")
    code, _, err = train(call, data, tmp_path / "second", *ONE, *still)
    assert code == 0, err
    second = only_run(tmp_path / "second")
    before, after = (
        torch.load(folder / "best.pt", weights_only=True)["model"] for folder in (first, second)
    )
    moved = [key for key in before if not torch.equal(before[key], after[key])]
    # The step of a training moves running statistics, and at this rate nothing else.
    assert all("running" in key or "num_batches" in key for key in moved)


def test_fresh_parts_keep_their_random_start(
    call: Call, data: Path, trained: Trained, tmp_path: Path
) -> None:
    first = trained(*ONE)
    other = (f"model.weights={first}", "model.fresh=[decode1.]", "optimizer.lr=1.0e-30", "seed=7")
    code, _, err = train(call, data, tmp_path / "second", *ONE, *other)
    assert code == 0, err
    assert "named in model.fresh" in err
    before, after = (
        torch.load(folder / "best.pt", weights_only=True)["model"]
        for folder in (first, only_run(tmp_path / "second"))
    )
    assert not torch.equal(before["decode1.conv.weight"], after["decode1.conv.weight"])
    assert torch.equal(before["decode2.conv.weight"], after["decode2.conv.weight"])


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
    (written,) = tmp_path.glob("evaluations/*/mfnet_test_rgbt_ring5.npz")
    stored = Counts.load(folder / "counts_test.npz")
    assert np.array_equal(Counts.load(written).counts, stored.counts)

    code, out, err = call(predict.entry, *named, "input=test", f"out={tmp_path / 'out'}")
    assert code == 0, err
    assert len(list((tmp_path / "out").glob("*_overlay.png"))) == len(stored.names)


@pytest.mark.slow
def test_other_inputs_are_reported(
    call: Call, data: Path, trained: Trained, tmp_path: Path
) -> None:
    first = trained(*ONE)
    for runs, inputs in (("same", "unit"), ("other", "crm")):
        words = (f"model.weights={first}", f"model/inputs={inputs}")
        code, _, err = train(call, data, tmp_path / runs, *ONE, *words)
        assert code == 0, err
        assert ("but this network has other settings" in err) == (inputs == "crm")

    # An export carries what it was fed with; the released layout of MFNet has no room for that.
    exported = tmp_path / "mine.safetensors"
    words = ("export", f"run={first}", "format=safetensors", f"out={exported}")
    assert call(weights_main, *words)[0] == 0
    for runs, inputs in (("third", "unit"), ("fourth", "crm")):
        words = (f"model.weights={exported}", f"model/inputs={inputs}")
        code, _, err = train(call, data, tmp_path / runs, *ONE, *words)
        assert code == 0, err
        assert ("but this network has other settings" in err) == (inputs == "crm")

    state = torch.load(first / "best.pt", weights_only=True)["model"]
    torch.save(state, tmp_path / "final.pth")
    named = ("model=mfnet_tiny", f"model.weights={tmp_path / 'final.pth'}", f"dataset.root={data}")
    small = (f"runs_dir={tmp_path}", "data.num_workers=0", "trainer.threads=1")
    for change in ("model.final_activation=true", "model.final_activation=false"):
        code, _, err = call(EVALUATE, *named, *small, change)
        assert code == 0, err
        said = "was trained with model.final_activation=true" in err
        assert said == change.endswith("false")


def test_networks_with_random_parts_are_not_scored(
    call: Call, data: Path, trained: Trained, tmp_path: Path
) -> None:
    named = (
        *("model=mfnet_tiny", f"model.weights={trained(*ONE)}", f"dataset.root={data}"),
        *("model.fresh=[decode1]", "data.num_workers=0", "trainer.threads=1"),
    )
    code, _, err = call(EVALUATE, *named)
    assert code == 2
    assert "does not hold all parameters of the network, and the others would be random" in err
    code, _, err = call(EVALUATE, *named, "checkpoint=last")
    assert code == 2
    assert_one_sentence(err, "checkpoint=last selects a checkpoint of a run")
    code, _, err = train(call, data, tmp_path, "+experiment=mfnet", "model.fresh=[decode1]")
    assert code == 2
    assert_one_sentence(err, "or omit model.fresh")


def test_a_network_of_one_image_is_scored_from_it(call: Call, data: Path, tmp_path: Path) -> None:
    words = ("+experiment=mfnet", "model=heatnet_tiny", "model.modalities=rgb")
    code, _, err = train(call, data, tmp_path, *words, "masker.patch_size=null", *short(1))
    assert code == 0, err
    folder = only_run(tmp_path)
    code, _, err = call(EVALUATE, f"run={folder}")
    assert code == 0, err
    assert (folder / "evaluations" / "mfnet_test_rgb_ring5.npz").exists()
    code, _, err = call(EVALUATE, f"run={folder}", "modality=thermal")
    assert code == 2
    assert_one_sentence(err, "'thermal' is not a valid choice")


def test_weights_that_are_not_there_are_named(call: Call, data: Path, tmp_path: Path) -> None:
    code, _, err = train(call, data, tmp_path, "+experiment=mfnet", "model.weights=nowhere.pth")
    assert code == 2
    assert_one_sentence(err, "the file nowhere.pth does not exist")
    code, _, err = call(EVALUATE, "model=mfnet_tiny", f"dataset.root={data}")
    assert code == 2
    assert_one_sentence(err, "'run' has no value")
    code, _, err = train(call, data, tmp_path, "+experiment=mfnet", "model.fresh=decode1")
    assert code == 2
    assert_one_sentence(err, "model.fresh")


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
@pytest.mark.parametrize("split", ["train", "val"])
def test_released_weights_give_the_known_counts(call: Call, tmp_path: Path, split: str) -> None:
    code, _, err = call(
        EVALUATE,
        *("model=mfnet", f"model.weights={REAL / 'mfnet_weights' / 'final.pth'}"),
        *(f"dataset.root={REAL / 'mfnet200'}", "dataset.splits.test=val.txt", f"split={split}"),
        *(f"out={tmp_path / 'counts.npz'}", "data.num_workers=0"),
    )
    assert code == 0, err
    known = json.loads((REAL / "mfnet_weights" / "expected_confusions.json").read_text())
    expected = np.array(known[f"MFNet_final_pth/{split}"]["confusion"])
    found = Counts.load(tmp_path / "counts.npz").whole()
    assert np.abs(found - expected).sum() // 2 == 0, "pixels that differ"
