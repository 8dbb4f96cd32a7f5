"""TC and CA of runs, during training and afterwards, on virtual and on true second frames."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from omegaconf import OmegaConf

from rgbt import consistency, evaluate
from rgbt.config.compose import compose
from rgbt.files.budgets import read_json
from rgbt.metrics import names, scores
from rgbt.metrics.counts import Counts
from rgbt.metrics.pairs import ca, ca_released, tc
from rgbt.spec.naming import describe
from rgbt.spec.specify import specify
from rgbt.tracking.run_result import RunResult
from tests.commands import (
    SPLITS,
    Call,
    Trained,
    assert_one_sentence,
    logged,
    only_run,
    short,
    train,
)
from tests.conftest import pair, write_data, write_png

TEMPORAL = ("+experiment=temporal_con", "masker.patch_size=null", *short(2))
UNMEASURED = (*TEMPORAL, "consistency=none")
ALIGNED, RELEASED = "consistency_aligned_test.npz", "consistency_released_test.npz"
SCORES = ("TC/aligned", "CA/aligned", "TC/released", "CA/released")
SYNTH = (
    *("dataset=synth", "dataset.num_train=1", "dataset.num_val=2", "dataset.num_test=3"),
    *("dataset.height=48", "dataset.width=64"),
)


def copied(trained: Trained, tmp_path: Path, *overrides: str) -> Path:
    done = trained(*TEMPORAL, *overrides)
    return Path(shutil.copytree(done, tmp_path / "runs" / done.name))


@pytest.fixture
def folder(trained: Trained, tmp_path: Path) -> Path:
    """A copy of a run of temporal_con that measured its consistency."""
    return copied(trained, tmp_path)


@pytest.fixture
def plain(trained: Trained, tmp_path: Path) -> Path:
    """A copy of the same run without the measurement."""
    return copied(trained, tmp_path / "plain", "consistency=none")


def measure(call: Call, *arguments: str) -> str:
    """Output of the command."""
    code, out, err = call(consistency.entry, *arguments)
    assert code == 0, err
    return out


def read(folder: Path, name: str) -> Any:
    return read_json(folder / name, dict[str, Any], "")


def counts_of(path: Path) -> np.ndarray:
    return Counts.load(path).counts


# ---- what a run measures --------------------------------------------------------------------


def test_run_measures_its_consistency(trained: Trained) -> None:
    folder = trained(*TEMPORAL)
    aligned, released = (Counts.load(folder / "evaluations" / n) for n in (ALIGNED, RELEASED))
    assert (aligned.partition, released.partition) == ("aligned3", "released3")
    for counts in (aligned, released):
        assert counts.counts.shape == (3, 3 * 10, 9, 9)
        assert (counts.names, counts.split) == (tuple(SPLITS["test"]), "test")
        assert counts.night == (False, True, False)
    whole = released.counts.reshape(3, 3, 10, 9, 9)
    assert (whole.sum((2, 3, 4)) == 48 * 64).all()  # every pixel counts
    by_set = aligned.counts.reshape(3, 3, 10, 9, 9)
    assert not by_set[:, :, 9].any()  # no pixel without a label
    assert (by_set.sum((2, 3, 4)) > 0.97 * 48 * 64).all()
    # The same labels and second predictions, whatever is done with the first one.
    assert (by_set.sum(3) <= whole.sum(3)).all()
    assert (folder / "figures" / "pairs.png").stat().st_size > 1000

    absent = OmegaConf.load(folder / "config.yaml").metric.absent
    expected = {
        "TC/aligned": tc(aligned.by_region(), absent),
        "CA/aligned": ca(aligned.by_region(), absent),
        "TC/released": tc(released.by_region(), absent),
        "CA/released": ca_released(released.by_region(), absent),
    }
    result, table = read(folder, "result.json"), read(folder, "tables.json")["consistency"]
    assert not [name for name in result["val"] if name.startswith(("TC", "CA"))]
    (last,) = logged(folder, "test")
    for name, by_class in expected.items():
        score, protocol = name.split("/")
        assert result["test"][name] == pytest.approx(by_class.mean(), abs=1e-12)
        assert last["values"][name] == result["test"][name]
        assert table[score.lower()][protocol] == pytest.approx(by_class, abs=1e-12)
        assert table[f"mean_{score.lower()}"][protocol] == result["test"][name]
    assert result["test"]["CA/aligned"] <= result["test"]["TC/aligned"]


@pytest.mark.slow
@pytest.mark.usefixtures("pictures")
def test_run_measures_its_best_checkpoint_and_draws_it(
    call: Call, data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    summary, validated = scores.summary, 0

    def falling(*given: Any) -> dict[str, float]:
        nonlocal validated
        validated += 1
        return {**summary(*given), names.MIOU: 1 / validated}

    with monkeypatch.context() as patch:
        patch.setattr(scores, "summary", falling)
        words = (*TEMPORAL, "trainer.eval_every=1", "scale.lr=0.05")
        code, _, err = train(call, data, tmp_path / "runs", *words)
    assert code == 0, err
    folder = only_run(tmp_path / "runs")
    result = read(folder, "result.json")
    assert (result["best_step"], result["steps"]) == (1, 2)
    for checkpoint in ("best", "last"):
        place = f"out={tmp_path / checkpoint}"
        measure(call, f"run={folder}", f"checkpoint={checkpoint}", place)
    for name in (ALIGNED, RELEASED):
        mine = counts_of(folder / "evaluations" / name)
        assert np.array_equal(mine, counts_of(tmp_path / "best" / name))
        last = tmp_path / "last" / name.replace("_test", "_test_last")
        assert not np.array_equal(mine, counts_of(last))
    picture = (folder / "figures" / "pairs.png").read_bytes()
    assert picture == (tmp_path / "best" / "pairs_aligned_test.png").read_bytes()
    assert picture != (tmp_path / "last" / "pairs_aligned_test_last.png").read_bytes()


@pytest.mark.slow
def test_run_val_is_the_split_of_the_selection(call: Call, data: Path, tmp_path: Path) -> None:
    words = (*TEMPORAL, "trainer.selection_split=train", "consistency.splits=[val]")
    code, _, err = train(call, data, tmp_path / "runs", *words)
    assert code == 0, err
    folder = only_run(tmp_path / "runs")
    found = Counts.load(folder / "evaluations" / "consistency_aligned_train.npz")
    assert (found.split, found.names) == ("train", tuple(SPLITS["train"]))
    assert not list((folder / "evaluations").glob("*_val.npz"))
    before = read(folder, "result.json")
    assert set(SCORES) <= set(before["val"])
    assert not set(SCORES) & set(before["test"])
    # Measured later, too, and the split that is merely called val is none of the result.
    for split in ("train", "val"):
        measure(call, f"run={folder}", f"split={split}")
        assert read(folder, "result.json") == before


def test_run_image_of_another_shape_does_not_cost_the_training(
    call: Call, data: Path, tmp_path: Path
) -> None:
    name = SPLITS["test"][1]
    rgb, thermal, label = pair(name, (48, 48))
    write_png(data / "images" / f"{name}.png", np.dstack([rgb, thermal]))
    write_png(data / "labels" / f"{name}.png", label)
    words = (*TEMPORAL, "scale.eval_batch_size=1", "consistency.splits=[test,val]")
    code, _, err = train(call, data, tmp_path / "runs", *words)
    assert code == 0, err
    folder = only_run(tmp_path / "runs")
    assert_one_sentence(err, f"consistency.view, image '{name}': ")
    assert "Consistency was not measured; measure it later with `rgbt consistency`" in err
    result = read(folder, "result.json")
    assert result["test"]["mIoU"] is not None
    assert not set(SCORES) & set(result["test"])
    assert set(SCORES) <= set(result["val"])
    assert read(folder, "tables.json")["consistency"] is None
    assert not [*folder.rglob("consistency_*_test.npz"), *folder.rglob("pairs*.png")]


# ---- what is measured of a finished run -----------------------------------------------------


def test_consistency_of_a_finished_run_equals_its_own(
    call: Call, trained: Trained, folder: Path, plain: Path
) -> None:
    """Measured later, also of a run from before there was any consistency, it is the same."""
    assert plain.name == folder.name  # the same key
    config = OmegaConf.load(plain / "config.yaml")
    del config["consistency"]
    OmegaConf.save(config, plain / "config.yaml")
    tables = read(plain, "tables.json")
    assert tables.pop("consistency") is None
    (plain / "tables.json").write_text(json.dumps(tables))
    code, _, err = call(evaluate.entry, f"run={plain}")
    assert code == 0, err
    before, expected = read(plain, "result.json"), read(folder, "result.json")
    out = measure(call, f"run={plain.name}", f"runs_dir={plain.parent}")
    for column in ("TC aligned", "CA aligned", "TC released", "CA released", "color_cone"):
        assert column in out
    for name in (ALIGNED, RELEASED):
        mine, theirs = (Counts.load(each / "evaluations" / name) for each in (plain, folder))
        assert np.array_equal(mine.counts, theirs.counts)
        assert (mine.names, mine.partition, mine.dataset) == (
            *(theirs.names, theirs.partition, theirs.dataset),
        )
    found, new = read(plain, "result.json"), {name: expected["test"][name] for name in SCORES}
    assert found == {**before, "test": {**before["test"], **new}}
    own = read(folder, "tables.json")["consistency"]
    assert read(plain, "tables.json") == {**tables, "consistency": own}
    measure(call, f"run={plain}")  # once more is the same
    assert read(plain, "result.json") == found

    assert "val/TC/aligned" not in RunResult(plain).scores()
    measure(call, f"run={plain}", "split=val")
    stored = read(plain, "result.json")["val"]
    for name in SCORES:
        assert RunResult(plain).scores()[f"val/{name}"] == pytest.approx(100 * stored[name])


ASIDE = {
    "another place": ("out={tmp}/out",),
    "last checkpoint": ("checkpoint=last",),
    "a named modality": ("modality=rgbt",),
    "a set": ("consistency.sets=[released_1]",),
    "a camera": ("consistency.view.camera.fx=500",),
    "another split": ("split=train",),
    "other images": ("dataset=mfnet", "dataset.root={tmp}/other", "dataset.name=other"),
}


@pytest.mark.parametrize("words", ASIDE.values(), ids=ASIDE)
def test_consistency_with_other_views_replaces_nothing(
    call: Call, folder: Path, data: Path, tmp_path: Path, words: tuple[str, ...]
) -> None:
    shutil.copytree(data, tmp_path / "other")
    (tmp_path / "other" / "test.txt").write_text("00202N\n")
    files = ("result.json", "tables.json", "metrics.jsonl", f"evaluations/{ALIGNED}")
    before = [(folder / name).read_bytes() for name in files]
    measure(call, f"run={folder}", *(word.format(tmp=tmp_path) for word in words))
    assert [(folder / name).read_bytes() for name in files] == before


@pytest.mark.slow
def test_consistency_of_user_views_has_a_separate_file(
    call: Call, trained: Trained, tmp_path: Path
) -> None:
    mine = tmp_path / "mine.csv"
    mine.write_text("yaw,pitch,roll\n3,2,1\n-4,0,2\n")
    camera = "consistency.view.camera.fx=500"
    run = copied(trained, tmp_path, f"consistency.sets=[{mine}]", camera)
    (path,) = (run / "evaluations").glob("consistency_aligned*_test.npz")
    before = Counts.load(path)
    assert path.name != ALIGNED
    assert before.counts.shape == (3, 10, 9, 9)
    assert before.partition.startswith("aligned1-")
    # The same views, measured afterwards: the same counts in the same place.
    (run / "evaluations").rename(run / "kept")
    measure(call, f"run={run}", f"consistency.sets=[{mine.rename(tmp_path / 'moved.csv')}]", camera)
    after = Counts.load(path)
    assert np.array_equal(after.counts, before.counts)
    assert after.partition == before.partition


@pytest.mark.slow
def test_consistency_of_split_checkpoint_and_modality_have_files(
    call: Call, trained: Trained, tmp_path: Path
) -> None:
    folder, out = trained("+experiment=crm", *short(1)), tmp_path / "out"
    requested = (
        "modality=default",
        "modality=rgb",
        "modality=thermal",
        "checkpoint=last",
        "split=val",
    )
    for word in requested:
        measure(call, f"run={folder}", f"out={out}", word)
    ends = ("test", "test_rgb", "test_thermal", "test_last", "val")
    expected = {f"consistency_{p}_{end}.npz" for p in ("aligned", "released") for end in ends}
    assert {path.name for path in out.glob("*.npz")} == expected
    found = [counts_of(out / f"consistency_aligned_{end}.npz") for end in ends]
    assert not np.array_equal(found[0], found[1])
    assert not np.array_equal(found[1], found[2])
    val = Counts.load(out / "consistency_aligned_val.npz")
    assert (val.split, val.names) == ("val", tuple(SPLITS["val"]))


def test_consistency_of_weights_from_a_file(call: Call, folder: Path, data: Path) -> None:
    out = measure(
        call,
        *("model=cmx_tiny", f"model.weights={folder}", f"runs_dir={folder.parent}"),
        *("dataset=mfnet", f"dataset.root={data}", "scale=demo", "scale.test_short_edge=48"),
        *("trainer.accelerator=cpu", "transform=flip", "model/inputs=temporal"),
    )
    assert "TC aligned" in out
    (path,) = (folder.parent / "evaluations").glob(f"*/{ALIGNED}")
    assert np.array_equal(counts_of(path), counts_of(folder / "evaluations" / ALIGNED))


def test_consistency_of_true_second_frames(call: Call, folder: Path, tmp_path: Path) -> None:
    where = (f"run={folder}", "frames=next", *SYNTH, f"dataset.cache_dir={tmp_path / 'cache'}")
    aside = (*where, "split=val", f"out={tmp_path / 'out'}")
    code, _, err = call(consistency.entry, *aside)
    assert code == 2
    assert_one_sentence(err, "dataset=synth writes it with dataset.ego_forward_m=0.5")
    assert not (tmp_path / "out").exists()
    out = measure(call, *aside, "dataset.ego_forward_m=0.5")
    assert "TC next" in out
    assert "TC aligned" not in out
    counts = Counts.load(tmp_path / "out" / "consistency_next_val.npz")
    assert re.fullmatch("next1-[0-9a-f]{6}", counts.partition)
    assert counts.counts.shape == (2, 10, 9, 9)
    assert 0.5 * 2 * 48 * 64 < counts.counts.sum() < 2 * 48 * 64  # what both frames show
    assert (tmp_path / "out" / "pairs_next_val.png").exists()


@pytest.mark.slow
def test_consistency_on_another_motion_replaces_no_counts(
    call: Call, plain: Path, tmp_path: Path
) -> None:
    path = plain / "evaluations" / "consistency_next_test.npz"
    where = (f"run={plain}", "frames=next", *SYNTH, f"dataset.cache_dir={tmp_path / 'cache'}")
    measure(call, *where, "dataset.ego_forward_m=0.5")
    before, result = path.read_bytes(), (plain / "result.json").read_bytes()
    code, _, err = call(consistency.entry, *where, "dataset.ego_forward_m=0.7")
    assert code == 2, err
    assert_one_sentence(err, f"{path} holds counts for second frames of another motion")
    assert path.read_bytes() == before
    # The same motion again, and the other one in a place of its own.
    kept = counts_of(path)
    measure(call, *where, "dataset.ego_forward_m=0.5")
    assert np.array_equal(counts_of(path), kept)
    measure(call, *where, "dataset.ego_forward_m=0.7", f"out={tmp_path / 'out'}")
    other = Counts.load(tmp_path / "out" / path.name)
    assert other.partition != Counts.load(path).partition
    assert (plain / "result.json").read_bytes() == result


def test_consistency_counts_are_kept_where_no_picture_can_be_drawn(
    call: Call, folder: Path, tmp_path: Path
) -> None:
    listed = [f"{number:05d}D" for number in range(301, 309)]
    data = write_data(tmp_path / "other", {**SPLITS, "test": listed}, (48, 64))
    for name in listed[:6]:
        (data / "images" / f"{name}.png").write_bytes(b"")
    more = ("dataset=mfnet", f"dataset.root={data}", "data.on_error=skip")
    measure(call, f"run={folder}", f"out={tmp_path / 'out'}", *more)
    assert Counts.load(tmp_path / "out" / ALIGNED).names == tuple(listed[6:])


@pytest.mark.parametrize(
    ("measured", "requested", "reported"),
    [
        (("consistency=none",), (), True),
        (("consistency=none",), ("consistency=none",), False),
        ((), (), False),
        ((), ("consistency.splits=[val,test]",), True),
        ((), ("consistency.sets=[released_1]",), True),
    ],
    ids=["nothing measured", "nothing requested", "measured", "another split", "other views"],
)
def test_finished_run_reports_missing_measurements(
    call: Call,
    trained: Trained,
    data: Path,
    tmp_path: Path,
    measured: tuple[str, ...],
    requested: tuple[str, ...],
    reported: bool,
) -> None:
    folder = copied(trained, tmp_path, *measured)
    before, known = sorted(folder.rglob("*")), read(folder, "run.json")
    code, _, err = train(call, data, folder.parent, *TEMPORAL, *requested)
    assert code == 0, err
    lines = [line for line in err.splitlines() if "has not been measured" in line]
    assert len(lines) == reported
    assert all(f"rgbt consistency run={folder} split=..." in line for line in lines)
    assert sorted(folder.rglob("*")) == before
    assert read(folder, "run.json") == known


@pytest.mark.slow
def test_mlflow_gets_what_was_added_once(call: Call, data: Path, tmp_path: Path) -> None:
    from mlflow.tracking import MlflowClient

    code, _, err = train(call, data, tmp_path, *UNMEASURED, "tracking=mlflow")
    assert code == 0, err
    folder = only_run(tmp_path)
    run_id = read(folder, "mlflow.json")["run_id"]
    client = MlflowClient(f"sqlite:///{tmp_path / 'mlflow.db'}")
    before = client.get_run(run_id).data.metrics
    assert not [key for key in before if "TC" in key or "CA" in key]
    measure(call, f"run={folder}", "checkpoint=last")
    assert client.get_run(run_id).data.metrics == before

    for split in ("val", "test", "test", "val"):
        measure(call, f"run={folder}", f"split={split}")
    found, result = client.get_run(run_id), read(folder, "result.json")
    assert found.info.status == "FINISHED"
    for kind, prefix in (("val", "val/"), ("test", "")):
        for name in SCORES:
            (point,) = client.get_metric_history(run_id, f"{prefix}{name}")
            assert point.value == pytest.approx(100 * result[kind][name], abs=0.005)
            assert point.step == 0
    assert found.data.metrics.items() >= before.items()
    assert len(found.data.metrics) == len(before) + 8
    assert "TC aligned" in found.data.tags["mlflow.note.content"]
    sent = {item.path for item in client.list_artifacts(run_id, "evaluations")}
    assert f"evaluations/{ALIGNED}" in sent

    # A store that is away does not cost what was measured.
    state = read(folder, "mlflow.json")
    (folder / "mlflow.json").write_text(json.dumps({**state, "uri": "http://127.0.0.1:9"}))
    code, _, err = call(consistency.entry, f"run={folder}")
    assert code == 0, err
    assert_one_sentence(err, f"rgbt sync run={folder}")


def test_name_of_a_run_omits_measurements() -> None:
    def named(*words: str) -> tuple[str, str]:
        overrides = ["+experiment=temporal_con", *words]
        found = describe(specify(compose(overrides), overrides))
        return found.name, found.tags["rgbt.group"]

    plain = ("seed=0 · temporal_con", "temporal_con")
    for words in (
        ("consistency=none",),
        ("consistency.view.camera.fx=500",),
        ("camera@consistency.view.camera=synth",),
    ):
        assert named(*words) == plain
    assert named("scheme.view.camera.fx=500")[1] == "temporal_con fx=500"
    assert named("camera@scheme.view.camera=synth")[1] != "temporal_con"
