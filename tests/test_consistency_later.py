"""Consistency around a run: its checkpoint and split, what is added to it later, what is not."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rgbt.config.compose import compose
from rgbt.files.budgets import read_json
from rgbt.metrics import names, scores
from rgbt.metrics.counts import Counts
from rgbt.spec.naming import describe
from rgbt.spec.specify import specify
from rgbt.tracking.run_result import RunResult
from tests.commands import SPLITS, Call, Trained, assert_one_sentence, only_run, train
from tests.conftest import pair, write_png
from tests.test_consistency import ALIGNED, RELEASED, TEMPORAL, copied, measure

SCORES = ("TC/aligned", "CA/aligned", "TC/released", "CA/released")
UNMEASURED = (*TEMPORAL, "consistency=none")


def read(folder: Path, name: str) -> Any:
    return read_json(folder / name, dict[str, Any], "")


def counts_of(path: Path) -> np.ndarray:
    return Counts.load(path).counts


@pytest.fixture
def plain(trained: Trained, tmp_path: Path) -> Path:
    """A copy of a run of temporal_con that did not measure its consistency."""
    return copied(trained, tmp_path, "consistency=none")


# ---- what a run measures --------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.usefixtures("pictures")
def test_a_run_measures_its_best_checkpoint_and_draws_it(
    call: Call, data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    summary, validated = scores.summary, 0

    def falling(*given: Any) -> dict[str, float]:
        nonlocal validated
        validated += 1
        return {**summary(*given), names.MIOU: 1 / validated}

    words = (*TEMPORAL, "trainer.eval_every=1", "scale.lr=0.05")
    with monkeypatch.context() as patch:
        patch.setattr(scores, "summary", falling)
        code, _, err = train(call, data, tmp_path / "runs", *words)
    assert code == 0, err
    folder = only_run(tmp_path / "runs")
    result = read(folder, "result.json")
    assert (result["best_step"], result["steps"]) == (1, 2)

    for checkpoint in ("best", "last"):
        place = f"out={tmp_path / checkpoint}"
        code, _, err = measure(call, f"run={folder}", f"checkpoint={checkpoint}", place)
        assert code == 0, err
    for name in (ALIGNED, RELEASED):
        mine = counts_of(folder / "evaluations" / name)
        assert np.array_equal(mine, counts_of(tmp_path / "best" / name))
        last = tmp_path / "last" / name.replace("_test", "_test_last")
        assert not np.array_equal(mine, counts_of(last))
    picture = (folder / "figures" / "pairs.png").read_bytes()
    assert picture == (tmp_path / "best" / "pairs_aligned_test.png").read_bytes()
    assert picture != (tmp_path / "last" / "pairs_aligned_test_last.png").read_bytes()


@pytest.mark.slow
def test_val_is_the_split_that_the_checkpoint_is_selected_by(
    call: Call, data: Path, tmp_path: Path
) -> None:
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
        code, _, err = measure(call, f"run={folder}", f"split={split}")
        assert code == 0, err
        assert read(folder, "result.json") == before


@pytest.mark.parametrize("splits", ["[val,test]", "[test,val]"])
def test_an_image_of_another_shape_does_not_cost_the_training(
    call: Call, data: Path, tmp_path: Path, splits: str
) -> None:
    name = SPLITS["test"][1]
    rgb, thermal, label = pair(name, (48, 48))
    write_png(data / "images" / f"{name}.png", np.dstack([rgb, thermal]))
    write_png(data / "labels" / f"{name}.png", label)
    words = (*TEMPORAL, "scale.eval_batch_size=1", f"consistency.splits={splits}")
    code, _, err = train(call, data, tmp_path / "runs", *words)
    assert code == 0, err
    folder = only_run(tmp_path / "runs")
    assert_one_sentence(err, f"consistency.view, image '{name}': ")
    assert "intrinsics of another image size" in err
    assert "Consistency is left out; rgbt consistency measures it later" in err
    result = read(folder, "result.json")
    assert result["test"]["mIoU"] is not None
    assert not set(SCORES) & set(result["test"])
    assert set(SCORES) <= set(result["val"])
    assert read(folder, "tables.json")["consistency"] is None
    assert not list(folder.rglob("consistency_*_test.npz"))
    assert not list(folder.rglob("pairs*.png"))


# ---- what is added to a finished run --------------------------------------------------------


@pytest.mark.slow
def test_what_is_measured_later_is_the_runs(
    call: Call, trained: Trained, plain: Path, tmp_path: Path
) -> None:
    both = trained(*TEMPORAL, "consistency.splits=[val,test]")
    expected, before = read(both, "result.json"), read(plain, "result.json")
    tables = read(plain, "tables.json")
    for split in ("val", "test"):
        code, _, err = measure(call, f"run={plain}", f"split={split}")
        assert code == 0, err
        found = read(plain, "result.json")
        for kind in ("val", "test"):
            new = {name: expected[kind][name] for name in SCORES}
            measured = kind == split or kind == "val"
            assert found[kind] == {**before[kind], **(new if measured else {})}
        rest = {"val": None, "test": None}
        assert {**found, **rest} == {**before, **rest}
        shown = read(plain, "tables.json")
        own = read(both, "tables.json")["consistency"] if split == "test" else None
        assert shown == {**tables, "consistency": own}
    # Once more is the same.
    code, _, err = measure(call, f"run={plain}")
    assert code == 0, err
    assert read(plain, "result.json") == found


def test_a_search_finds_what_was_added(call: Call, plain: Path) -> None:
    assert "val/TC/aligned" not in RunResult(plain).scores()
    code, _, err = measure(call, f"run={plain}", "split=val")
    assert code == 0, err
    found = RunResult(plain).scores()
    result = read(plain, "result.json")["val"]
    for name in SCORES:
        assert found[f"val/{name}"] == pytest.approx(100 * result[name])
        assert f"test/{name}" not in found


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
def test_what_is_measured_otherwise_is_not_added(
    call: Call, plain: Path, data: Path, tmp_path: Path, words: tuple[str, ...]
) -> None:
    shutil.copytree(data, tmp_path / "other")
    (tmp_path / "other" / "test.txt").write_text("00202N\n")
    files = ("result.json", "tables.json", "metrics.jsonl")
    before = [(plain / name).read_bytes() for name in files]
    code, _, err = measure(call, f"run={plain}", *(word.format(tmp=tmp_path) for word in words))
    assert code == 0, err
    assert [(plain / name).read_bytes() for name in files] == before


@pytest.mark.slow
def test_mlflow_is_told_of_what_was_added_once(call: Call, data: Path, tmp_path: Path) -> None:
    from mlflow.tracking import MlflowClient

    code, _, err = train(call, data, tmp_path, *UNMEASURED, "tracking=mlflow")
    assert code == 0, err
    folder = only_run(tmp_path)
    run_id = read(folder, "mlflow.json")["run_id"]
    client = MlflowClient(f"sqlite:///{tmp_path / 'mlflow.db'}")
    before = client.get_run(run_id).data.metrics
    assert not [key for key in before if "TC" in key or "CA" in key]
    for words in (
        ["checkpoint=last"],
        ["consistency.sets=[released_1]"],
        [f"out={tmp_path / 'o'}"],
    ):
        code, _, err = measure(call, f"run={folder}", *words)
        assert code == 0, err
    assert client.get_run(run_id).data.metrics == before

    for split in ("val", "test", "test", "val"):
        code, _, err = measure(call, f"run={folder}", f"split={split}")
        assert code == 0, err
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


@pytest.mark.slow
def test_a_store_that_is_away_does_not_cost_what_was_measured(
    call: Call, data: Path, tmp_path: Path
) -> None:
    code, _, err = train(call, data, tmp_path, *UNMEASURED, "tracking=mlflow")
    assert code == 0, err
    folder = only_run(tmp_path)
    sent = read(folder, "mlflow.json")
    (folder / "mlflow.json").write_text(json.dumps({**sent, "uri": "http://127.0.0.1:9"}))
    code, _, err = measure(call, f"run={folder}")
    assert code == 0, err
    assert_one_sentence(err, f"rgbt sync run={folder}")
    assert set(SCORES) <= set(read(folder, "result.json")["test"])


# ---- what is not replaced, and what is told -------------------------------------------------


@pytest.mark.slow
def test_counts_on_another_motion_are_not_replaced(call: Call, plain: Path, tmp_path: Path) -> None:
    synth = (
        *("dataset=synth", f"dataset.cache_dir={tmp_path / 'cache'}", "dataset.num_train=1"),
        *("dataset.num_val=1", "dataset.num_test=2", "dataset.height=48", "dataset.width=64"),
    )
    path = plain / "evaluations" / "consistency_next_test.npz"
    where = (f"run={plain}", "frames=next", *synth)
    code, _, err = measure(call, *where, "dataset.ego_forward_m=0.5")
    assert code == 0, err
    before, result = path.read_bytes(), (plain / "result.json").read_bytes()
    code, _, err = measure(call, *where, "dataset.ego_forward_m=0.7")
    assert code == 2, err
    assert_one_sentence(err, f"{path} holds counts on second frames of another motion")
    assert path.read_bytes() == before
    # The same motion again, and the other one in a place of its own.
    kept = counts_of(path)
    code, _, err = measure(call, *where, "dataset.ego_forward_m=0.5")
    assert code == 0, err
    assert np.array_equal(counts_of(path), kept)
    code, _, err = measure(call, *where, "dataset.ego_forward_m=0.7", f"out={tmp_path / 'out'}")
    assert code == 0, err
    other = Counts.load(tmp_path / "out" / path.name)
    assert other.partition != Counts.load(path).partition
    assert (plain / "result.json").read_bytes() == result


@pytest.mark.parametrize(
    ("measured", "asked", "told"),
    [
        (("consistency=none",), (), True),
        (("consistency=none",), ("consistency=none",), False),
        ((), (), False),
        ((), ("consistency.splits=[val,test]",), True),
        ((), ("consistency.sets=[released_1]",), True),
    ],
    ids=["nothing measured", "nothing asked", "measured", "another split", "other views"],
)
def test_a_finished_run_says_what_was_not_measured(
    call: Call,
    trained: Trained,
    data: Path,
    tmp_path: Path,
    measured: tuple[str, ...],
    asked: tuple[str, ...],
    told: bool,
) -> None:
    folder = copied(trained, tmp_path, *measured)
    before, known = sorted(folder.rglob("*")), read(folder, "run.json")
    code, _, err = train(call, data, folder.parent, *TEMPORAL, *asked)
    assert code == 0, err
    assert "is finished; showing its result" in err
    lines = [line for line in err.splitlines() if "has not been measured" in line]
    assert len(lines) == told
    assert all(f"rgbt consistency run={folder} split=..." in line for line in lines)
    assert sorted(folder.rglob("*")) == before
    assert read(folder, "run.json") == known


def test_sets_without_a_split_are_refused(call: Call, data: Path, tmp_path: Path) -> None:
    words = (*TEMPORAL, "consistency.splits=[]")
    code, _, err = train(call, data, tmp_path / "runs", *words)
    assert code == 2, err
    assert_one_sentence(err, "consistency.splits is empty")
    assert not (tmp_path / "runs").exists()


def test_what_is_measured_is_no_part_of_a_name() -> None:
    def named(*words: str) -> tuple[str, str]:
        overrides = ["+experiment=temporal_con", *words]
        found = describe(specify(compose(overrides), overrides))
        return found.name, found.tags["rgbt.group"]

    plain = named()
    assert plain == ("seed=0 · temporal_con", "temporal_con")
    for words in (
        ("consistency=none",),
        ("consistency.splits=[val,test]",),
        ("consistency.view.camera.fx=500",),
        ("view@consistency.view=paper",),
        ("camera@consistency.view.camera=synth",),
    ):
        assert named(*words) == plain
    assert named("scheme.view.camera.fx=500")[1] == "temporal_con fx=500"
    assert named("camera@scheme.view.camera=synth")[1] != "temporal_con"
