"""TC and CA of runs, during training and afterwards, on virtual and on true second frames."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from omegaconf import OmegaConf

from rgbt.metrics.counts import Counts
from rgbt.metrics.pairs import ca, ca_released, tc
from tests.commands import SPLITS, Call, Trained, assert_one_sentence, only_run, short, train
from tests.conftest import write_data

TEMPORAL = ("+experiment=temporal_con", "masker.patch_size=null", *short(2))
ALIGNED, RELEASED = "consistency_aligned_test.npz", "consistency_released_test.npz"


@pytest.fixture
def folder(trained: Trained, tmp_path: Path) -> Path:
    """A copy of a run of temporal_con that measured its consistency."""
    return copied(trained, tmp_path)


def copied(trained: Trained, tmp_path: Path, *overrides: str) -> Path:
    done = trained(*TEMPORAL, *overrides)
    return Path(shutil.copytree(done, tmp_path / "runs" / done.name))


def measure(call: Call, *arguments: str) -> tuple[int, str, str]:
    from rgbt import consistency

    return call(consistency.entry, *arguments)


def pair_counts(path: Path) -> Counts:
    return Counts.load(path)


def test_a_run_measures_its_consistency(folder: Path) -> None:
    aligned, released = (pair_counts(folder / "evaluations" / n) for n in (ALIGNED, RELEASED))
    assert (aligned.partition, released.partition) == ("aligned3", "released3")
    for counts in (aligned, released):
        assert counts.counts.shape == (3, 3 * 10, 9, 9)
        assert counts.counts.dtype == np.int32
        assert counts.names == tuple(SPLITS["test"])
        assert counts.split == "test"
        assert counts.night == (False, True, False)
    by_set = released.counts.reshape(3, 3, 10, 9, 9).sum((2, 3, 4))
    assert (by_set == 48 * 64).all()  # every pixel counts
    by_set = aligned.counts.reshape(3, 3, 10, 9, 9)
    assert not by_set[:, :, 9].any()  # no pixel without a label
    assert (by_set.sum((2, 3, 4)) > 0.97 * 48 * 64).all()
    # The same labels and second predictions, whatever is done with the first one.
    whole = released.counts.reshape(3, 3, 10, 9, 9)
    assert (by_set.sum(3) <= whole.sum(3)).all()
    assert (folder / "figures" / "pairs.png").stat().st_size > 1000


def test_scores_stand_in_the_tables_and_in_the_result(folder: Path) -> None:
    aligned, released = (pair_counts(folder / "evaluations" / n) for n in (ALIGNED, RELEASED))
    config = OmegaConf.load(folder / "config.yaml")
    absent = config.metric.absent
    expected = {
        "TC/aligned": tc(aligned.by_region(), absent),
        "CA/aligned": ca(aligned.by_region(), absent),
        "TC/released": tc(released.by_region(), absent),
        "CA/released": ca_released(released.by_region(), absent),
    }
    result = json.loads((folder / "result.json").read_text())
    table = json.loads((folder / "tables.json").read_text())["consistency"]
    assert not [name for name in result["val"] if name.startswith(("TC", "CA"))]
    lines = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    assert lines[-1]["kind"] == "test"
    for name, by_class in expected.items():
        score, protocol = name.split("/")
        assert 0 <= by_class.mean() <= 1
        assert result["test"][name] == pytest.approx(by_class.mean(), abs=1e-12)
        assert lines[-1]["values"][name] == result["test"][name]
        assert table[score.lower()][protocol] == pytest.approx(by_class, abs=1e-12)
        assert table[f"mean_{score.lower()}"][protocol] == result["test"][name]
    assert result["test"]["CA/aligned"] <= result["test"]["TC/aligned"]


def test_the_tables_are_shown(call: Call, folder: Path) -> None:
    code, out, err = measure(call, f"run={folder}")
    assert code == 0, err
    for column in ("TC aligned", "CA aligned", "TC released", "CA released", "color_cone"):
        assert column in out
    assert "Traceback" not in err


def test_measuring_afterwards_gives_the_same_counts(call: Call, folder: Path) -> None:
    before = {name: pair_counts(folder / "evaluations" / name) for name in (ALIGNED, RELEASED)}
    shutil.rmtree(folder / "evaluations")
    code, _, err = measure(call, f"run={folder.name}", f"runs_dir={folder.parent}")
    assert code == 0, err
    for name, counts in before.items():
        again = pair_counts(folder / "evaluations" / name)
        assert np.array_equal(again.counts, counts.counts)
        assert (again.names, again.partition, again.dataset) == (
            *(counts.names, counts.partition, counts.dataset),
        )


@pytest.mark.slow
def test_a_run_that_measured_nothing_is_the_same_run(
    call: Call, trained: Trained, folder: Path, tmp_path: Path
) -> None:
    plain = copied(trained, tmp_path / "plain", "consistency=none")
    assert plain.name == folder.name  # the same key
    assert not (plain / "evaluations").exists()
    assert json.loads((plain / "tables.json").read_text())["consistency"] is None
    result = json.loads((plain / "result.json").read_text())
    assert not [name for name in result["test"] if name.startswith(("TC", "CA"))]
    code, _, err = measure(call, f"run={plain}")
    assert code == 0, err
    for name in (ALIGNED, RELEASED):
        mine, theirs = (pair_counts(each / "evaluations" / name) for each in (plain, folder))
        assert np.array_equal(mine.counts, theirs.counts)


def test_a_run_of_before_there_was_any_consistency(
    call: Call, trained: Trained, folder: Path, tmp_path: Path
) -> None:
    from rgbt import evaluate

    old = copied(trained, tmp_path / "old", "consistency=none")
    config = OmegaConf.load(old / "config.yaml")
    del config["consistency"]
    OmegaConf.save(config, old / "config.yaml")
    tables = json.loads((old / "tables.json").read_text())
    del tables["consistency"], tables["crc32"]
    (old / "tables.json").write_text(json.dumps(tables))

    code, _, err = call(evaluate.entry, f"run={old}")
    assert code == 0, err
    code, _, err = measure(call, f"run={old}")
    assert code == 0, err
    mine, theirs = (pair_counts(each / "evaluations" / ALIGNED) for each in (old, folder))
    assert np.array_equal(mine.counts, theirs.counts)


@pytest.mark.slow
def test_views_of_ones_own_have_a_file_of_their_own(
    call: Call, trained: Trained, tmp_path: Path
) -> None:
    mine = tmp_path / "mine.csv"
    mine.write_text("yaw,pitch,roll\n3,2,1\n-4,0,2\n")
    own = (f"consistency.sets=[{mine}]", "consistency.view.camera.fx=500")
    run = copied(trained, tmp_path, *own)
    (path,) = (run / "evaluations").glob("consistency_aligned*_test.npz")
    assert path.name != ALIGNED
    before = pair_counts(path)
    assert before.counts.shape == (3, 10, 9, 9)
    assert before.partition.startswith("aligned1-")

    # The same views, measured afterwards: the same counts in the same place.
    (run / "evaluations").rename(run / "kept")
    moved = mine.rename(tmp_path / "moved.csv")
    again = (f"consistency.sets=[{moved}]", own[1])
    code, _, err = measure(call, f"run={run}", *again)
    assert code == 0, err
    after = pair_counts(path)
    assert np.array_equal(after.counts, before.counts)
    assert after.partition == before.partition


@pytest.mark.parametrize(
    "asked",
    [("consistency.sets=[released_1]",), ("consistency.view.camera.fx=500",), ("dataset",)],
    ids=["sets", "camera", "dataset"],
)
def test_other_views_or_images_do_not_replace_the_counts_of_the_run(
    call: Call, folder: Path, data: Path, asked: tuple[str, ...]
) -> None:
    if asked == ("dataset",):
        (data / "test.txt").write_text("00202N\n")
        asked = ("dataset=mfnet", f"dataset.root={data}", "dataset.name=other")
    before = pair_counts(folder / "evaluations" / ALIGNED)
    code, _, err = measure(call, f"run={folder}", *asked)
    assert code == 0, err
    after = pair_counts(folder / "evaluations" / ALIGNED)
    assert np.array_equal(after.counts, before.counts)


def test_a_finished_run_that_is_asked_for_consistency_says_where_to_get_it(
    call: Call, data: Path, tmp_path: Path
) -> None:
    code, _, err = train(call, data, tmp_path / "runs", *TEMPORAL, "consistency=none")
    assert code == 0, err
    code, out, err = train(call, data, tmp_path / "runs", *TEMPORAL)
    assert code == 0, err
    assert "is finished" in err
    assert "TC aligned" in out or "rgbt consistency run=" in err


@pytest.mark.slow
def test_split_checkpoint_and_place_have_their_own_files(
    call: Call, folder: Path, tmp_path: Path
) -> None:
    before = (folder / "evaluations" / ALIGNED).read_bytes()
    out = tmp_path / "out"
    for more in (["split=val"], ["checkpoint=last"], ["modality=rgbt"]):
        code, _, err = measure(call, f"run={folder}", f"out={out}", *more)
        assert code == 0, err
    assert {path.name for path in out.glob("*.npz")} == {
        f"consistency_{protocol}_{rest}.npz"
        for protocol in ("aligned", "released")
        for rest in ("val", "test_last", "test_rgbt")
    }
    val = pair_counts(out / "consistency_aligned_val.npz")
    assert (val.split, val.names) == ("val", tuple(SPLITS["val"]))
    assert (folder / "evaluations" / ALIGNED).read_bytes() == before
    rgbt = pair_counts(out / "consistency_aligned_test_rgbt.npz")
    assert np.array_equal(rgbt.counts, pair_counts(folder / "evaluations" / ALIGNED).counts)


def test_a_run_can_measure_its_selection_split(call: Call, data: Path, tmp_path: Path) -> None:
    code, _, err = train(call, data, tmp_path, *TEMPORAL, "consistency.splits=[val,test]")
    assert code == 0, err
    folder = only_run(tmp_path)
    result = json.loads((folder / "result.json").read_text())
    val = pair_counts(folder / "evaluations" / "consistency_aligned_val.npz")
    absent = OmegaConf.load(folder / "config.yaml").metric.absent
    expected = tc(val.by_region(), absent).mean()
    assert result["val"]["TC/aligned"] == pytest.approx(expected, abs=1e-12)
    assert {"TC/aligned", "CA/aligned", "TC/released", "CA/released"} <= set(result["test"])
    assert result["val"]["TC/aligned"] != result["test"]["TC/aligned"]


@pytest.mark.slow
def test_one_branch_of_a_network_is_measured(call: Call, trained: Trained, tmp_path: Path) -> None:
    done = trained("+experiment=crm", *short(1))
    folder = Path(shutil.copytree(done, tmp_path / done.name))
    for modality in ("default", "rgb", "thermal"):
        code, _, err = measure(call, f"run={folder}", f"modality={modality}")
        assert code == 0, err
    names = ("", "_rgb", "_thermal")
    found = [pair_counts(folder / "evaluations" / f"{ALIGNED[:-4]}{n}.npz") for n in names]
    assert all(each.counts.shape == (3, 30, 9, 9) for each in found)
    assert not np.array_equal(found[0].counts, found[1].counts)
    assert not np.array_equal(found[1].counts, found[2].counts)


def test_weights_from_a_file_are_measured(call: Call, folder: Path, data: Path) -> None:
    code, out, err = measure(
        call,
        *("model=cmx_tiny", f"model.weights={folder}", f"runs_dir={folder.parent}"),
        *("dataset=mfnet", f"dataset.root={data}", "scale=demo", "scale.test_short_edge=48"),
        *("trainer.accelerator=cpu", "transform=flip", "model/inputs=temporal"),
    )
    assert code == 0, err
    assert "TC aligned" in out
    (path,) = (folder.parent / "evaluations").glob(f"*/{ALIGNED}")
    theirs = pair_counts(folder / "evaluations" / ALIGNED)
    assert np.array_equal(pair_counts(path).counts, theirs.counts)


def test_true_second_frames_are_measured(call: Call, folder: Path, tmp_path: Path) -> None:
    synth = (
        *("dataset=synth", f"dataset.cache_dir={tmp_path / 'cache'}", "dataset.num_train=1"),
        *("dataset.num_val=2", "dataset.num_test=3", "dataset.height=48", "dataset.width=64"),
    )
    where = (f"run={folder}", "frames=next", "split=val", f"out={tmp_path / 'out'}")
    code, _, err = measure(call, *where, *synth)
    assert code == 2
    assert_one_sentence(err, "dataset=synth writes them with dataset.ego_forward_m=0.5")
    assert not (tmp_path / "out").exists()
    code, out, err = measure(call, *where, *synth, "dataset.ego_forward_m=0.5")
    assert code == 0, err
    assert "TC next" in out
    assert "TC aligned" not in out
    (path,) = (tmp_path / "out").glob("*.npz")
    assert path.name == "consistency_next_val.npz"
    counts = pair_counts(path)
    assert re.fullmatch("next1-[0-9a-f]{6}", counts.partition)
    assert counts.counts.shape == (2, 10, 9, 9)
    assert 0.5 * 2 * 48 * 64 < counts.counts.sum() < 2 * 48 * 64  # what both frames show
    assert (tmp_path / "out" / "pairs_next_val.png").exists()


def test_counts_are_written_where_no_image_of_the_picture_can_be_read(
    call: Call, folder: Path, tmp_path: Path
) -> None:
    names = [f"{number:05d}D" for number in range(301, 309)]
    data = write_data(tmp_path / "other", {**SPLITS, "test": names}, (48, 64))
    for name in names[:6]:
        (data / "images" / f"{name}.png").write_bytes(b"")
    more = ("dataset=mfnet", f"dataset.root={data}", "data.on_error=skip")
    code, _, err = measure(call, f"run={folder}", f"out={tmp_path / 'out'}", *more)
    assert code == 0, err
    assert pair_counts(tmp_path / "out" / ALIGNED).names == tuple(names[6:])


REFUSED = {
    "no such frames": (["frames=nxt"], "did you mean 'next'?"),
    "no second frames": (["frames=next"], "has no second frames: expected the folder next/"),
    "no views": (["consistency=none"], "consistency.sets is empty"),
    "empty sets": (["consistency.sets=[]"], "consistency.sets is empty"),
    "another size": (["transform.test_short_edge=96"], "name a folder for these counts with out="),
    "another precision": (["trainer.precision=bf16-mixed"], "changes how the run is measured"),
    "no such split": (["split=tset"], "no split 'tset'; did you mean 'test'?"),
    "no such modality": (["modality=rgb"], "modality: 'rgb' is not a choice"),
    "no such checkpoint": (["checkpoint=first"], "'checkpoint' must be 'best' or 'last'"),
    "no such set": (["consistency.sets=[released_4]"], "did you mean 'released_3'?"),
    "misspelt key": (["consistency.veiw.mode=both"], "did you mean 'view'?"),
    "no such file": (["consistency=veiws"], "there is no consistency 'veiws'"),
    "no such camera": (["camera@consistency.view.camera=no"], "there is no camera 'no'"),
    "centre outside": (
        ["consistency.view.camera.cx=900"],
        "intrinsics of another image size",
    ),
    "another aspect": (
        ["consistency.view.camera.height=1024", "consistency.view.camera.width=1280"],
        "intrinsics of another image size",
    ),
    "views of training": (["scheme.view.mode=rotation"], "cannot be changed of a finished run"),
}


@pytest.mark.parametrize(("asked", "sentence"), REFUSED.values(), ids=REFUSED)
def test_what_cannot_be_measured_is_one_sentence(
    call: Call, trained: Trained, asked: list[str], sentence: str
) -> None:
    folder = trained(*TEMPORAL)
    before = sorted(path.name for path in folder.rglob("*"))
    code, _, err = measure(call, f"run={folder}", *asked)
    assert code == 2, err
    assert_one_sentence(err, sentence)
    assert sorted(path.name for path in folder.rglob("*")) == before


def test_without_a_run_and_without_weights(call: Call, tmp_path: Path) -> None:
    code, _, err = measure(call)
    assert code == 2
    assert_one_sentence(err, "'run' has no value")
    code, _, err = measure(call, "run=nowhere", f"runs_dir={tmp_path}")
    assert code == 2
    assert_one_sentence(err, "run=nowhere: neither a run folder")


@pytest.mark.slow
def test_mlflow_is_sent_percent(call: Call, data: Path, tmp_path: Path) -> None:
    from mlflow.tracking import MlflowClient

    code, _, err = train(call, data, tmp_path, *TEMPORAL, "tracking=mlflow")
    assert code == 0, err
    folder = only_run(tmp_path)
    sent = json.loads((folder / "mlflow.json").read_text())
    client = MlflowClient(f"sqlite:///{tmp_path / 'mlflow.db'}")
    metrics = client.get_run(sent["run_id"]).data.metrics
    result = json.loads((folder / "result.json").read_text())["test"]
    for name in ("TC/aligned", "CA/aligned", "TC/released", "CA/released"):
        (key,) = (key for key in metrics if key.endswith(name))
        assert metrics[key] == pytest.approx(100 * result[name], abs=0.005)
