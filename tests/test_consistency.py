"""TC and CA of runs and of predictions of any method, on virtual and on true second frames."""

from __future__ import annotations

import csv
import json
import re
import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from omegaconf import OmegaConf

from rgbt import consistency, predict
from rgbt.files.plain_files import read_json
from rgbt.metrics.counts import Counts
from rgbt.metrics.named import value
from rgbt.metrics.pairs import ca, ca_released, frames, tc, triples
from rgbt.randomness import numpy_generator
from rgbt.runs.result import RunResult
from rgbt.transforms.views import read_angles
from tests.commands import SPLITS, Call, Trained, logged, only_run, short, train
from tests.conftest import pair, write_png

TEMPORAL = ("+experiment=temporal_con", "masker.patch_size=null", *short(2))
ALIGNED, RELEASED = "test_aligned3.npz", "test_released3.npz"
SCORES = ("TC/aligned", "CA/aligned", "TC/released", "CA/released")
SYNTH = (
    *("dataset=synth", "dataset.num_train=1", "dataset.num_val=2", "dataset.num_test=3"),
    *("dataset.height=48", "dataset.width=64"),
)


@pytest.fixture
def folder(trained: Trained, tmp_path: Path) -> Path:
    """A copy of a run of temporal_con that measured its consistency."""
    done = trained(*TEMPORAL)
    return Path(shutil.copytree(done, tmp_path / "runs" / done.name))


@pytest.fixture
def plain(trained: Trained, tmp_path: Path) -> Path:
    """A copy of the same run without the measurement."""
    done = trained(*TEMPORAL, "consistency=none")
    return Path(shutil.copytree(done, tmp_path / "plain" / "runs" / done.name))


def measure(call: Call, *arguments: str) -> str:
    """Output of the command."""
    code, out, err = call(consistency.entry, *arguments)
    assert code == 0, err
    return out


def refused(call: Call, named: str, *arguments: str) -> None:
    code, _, err = call(consistency.entry, *arguments)
    assert (code, named in " ".join(err.split())) == (2, True), err


def read(folder: Path, name: str) -> Any:
    return read_json(folder / name, dict[str, Any], "")


def assert_same_counts(folder: Path, other: Path) -> None:
    for name in (ALIGNED, RELEASED):
        mine, theirs = (Counts.load(place / name) for place in (folder, other))
        assert np.array_equal(mine.counts, theirs.counts)
        for key in ("names", "night", "classes", "partition", "dataset", "split", "absent"):
            assert getattr(mine, key) == getattr(theirs, key)


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

    absent = OmegaConf.load(folder / "config.yaml").metric.absent
    expected = {
        "TC/aligned": tc(frames(aligned.by_region()), absent),
        "CA/aligned": ca(triples(aligned.by_region()), absent),
        "TC/released": tc(frames(released.by_region()), absent),
        "CA/released": ca_released(triples(released.by_region()), absent),
    }
    result, table = read(folder, "result.json"), read(folder, "tables.json")["consistency"]
    assert not [name for name in result["val"] if name.startswith(("TC", "CA"))]
    for name, by_class in expected.items():
        score, protocol = name.split("/")
        assert result["test"][name] == pytest.approx(by_class.mean(), abs=1e-12)
        assert logged(folder, "test")[0]["values"][name] == result["test"][name]
        assert table[score.lower()][protocol] == pytest.approx(by_class, abs=1e-12)


def test_image_of_another_shape_does_not_end_the_training(
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
    assert f"consistency.view, image '{name}': " in " ".join(err.split())
    result = read(folder, "result.json")
    assert not set(SCORES) & set(result["test"])
    assert set(SCORES) <= set(result["val"])
    assert [path.name for path in folder.rglob("test_*.npz")] == []
    assert (folder / "evaluations" / "val_aligned3.npz").is_file()


def test_consistency_of_a_finished_run_equals_its_own(
    call: Call, folder: Path, plain: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And contacts no address that the run folder names."""
    called: list[object] = []
    monkeypatch.setattr("socket.socket.connect", lambda *given: called.append(given))
    address = json.dumps({"uri": "http://127.0.0.1:9", "run_id": "a"})
    (plain / "mlflow.json").write_text(address)
    assert plain.name == folder.name  # the same key
    before, expected = read(plain, "result.json"), read(folder, "result.json")
    assert "CA released" in measure(call, f"run={plain.name}", f"runs_dir={plain.parent}")
    assert_same_counts(plain / "evaluations", folder / "evaluations")
    new = {name: expected["test"][name] for name in SCORES}
    assert read(plain, "result.json") == {**before, "test": {**before["test"], **new}}
    own = read(folder, "tables.json")["consistency"]
    assert read(plain, "tables.json")["consistency"] == own
    measure(call, f"run={plain}", "split=val")
    stored, scores = read(plain, "result.json")["val"], RunResult(plain).recorded_scores()
    assert all(scores[f"val/{name}"] == pytest.approx(100 * stored[name]) for name in SCORES)
    assert not called
    assert (plain / "mlflow.json").read_text() == address


ASIDE = {
    "another place": ("out={tmp}/out",),
    "last checkpoint": ("checkpoint=last",),
    "a set": ("consistency.sets=[released_1]",),
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


def test_consistency_on_another_motion_replaces_no_counts(
    call: Call, plain: Path, tmp_path: Path
) -> None:
    place = plain / "evaluations"
    where = (f"run={plain}", "frames=next", *SYNTH, f"dataset.cache_dir={tmp_path / 'cache'}")
    refused(call, "", *where)  # without second frames
    assert not place.exists()
    assert "TC next" in measure(call, *where, "dataset.ego_forward_m=0.5")
    (path,) = place.glob("*.npz")
    counts, before = Counts.load(path), path.read_bytes()
    assert re.fullmatch(r"test_next1-[0-9a-f]{6}_synth-[0-9a-f]{8}_[0-9a-f]{8}\.npz", path.name)
    assert re.fullmatch("next1-[0-9a-f]{6}", counts.partition)
    assert counts.counts.shape == (3, 10, 9, 9)
    assert 0.5 * 3 * 48 * 64 < counts.counts.sum() < 3 * 48 * 64  # what both frames show
    measure(call, *where, "dataset.ego_forward_m=0.7")
    assert path.read_bytes() == before
    (beside,) = {*place.glob("*.npz")} - {path}
    other = Counts.load(beside)
    assert other.partition != counts.partition
    assert not np.array_equal(other.counts, counts.counts)
    # Where the other counts have that name, they are not replaced either.
    shutil.copy(beside, path)
    refused(call, f"{path} holds another measurement", *where, "dataset.ego_forward_m=0.5")
    assert path.read_bytes() == beside.read_bytes()


@pytest.fixture
def exported(call: Call, data: Path, tmp_path: Path) -> Path:
    folder = tmp_path / "pairs"
    measure(call, f"export={folder}", "dataset=mfnet", f"dataset.root={data}")
    return folder


@pytest.fixture
def predicted(exported: Path, tmp_path: Path) -> Path:
    """Predictions of a method that sees class 1 where red is bright."""
    for path in (exported / "rgb").glob("*.png"):
        red = cv2.imread(str(path))[..., 2]
        write_png(tmp_path / "predicted" / path.name, (red > 127).astype(np.uint8))
    shutil.copy(exported / "pairs.json", tmp_path / "predicted")
    return tmp_path / "predicted"


def test_export_writes_frames_and_list_of_every_pair(exported: Path, data: Path) -> None:
    for name in (f"{name}{view}" for name in SPLITS["test"] for view in ("", "_view1", "_view3")):
        for kind, shape in (("rgb", (48, 64, 3)), ("thermal", (48, 64))):
            path = exported / kind / f"{name}.png"
            assert cv2.imread(str(path), cv2.IMREAD_UNCHANGED).shape == shape
    packed = cv2.imread(str(data / "images" / "00202N.png"), cv2.IMREAD_UNCHANGED)
    assert np.array_equal(cv2.imread(str(exported / "rgb" / "00202N.png")), packed[..., :3])
    listed = read(exported, "pairs.json")
    assert (listed["split"], listed["frames"], listed["views"]) == ("test", "virtual", "published")
    assert listed["sets"] == ["released_1", "released_2", "released_3"]
    assert len(listed["pairs"]) == 3 * len(SPLITS["test"])
    angles = read_angles("released_2")[2].tolist()  # of the third image
    assert list(listed["pairs"][7].values()) == ["00203D", "00203D_view2", 2, *angles]


def test_predictions_of_a_network_count_as_the_network_does(
    call: Call, trained: Trained, exported: Path, data: Path, tmp_path: Path
) -> None:
    run, written, out = trained(*TEMPORAL), tmp_path / "written", tmp_path / "counts"
    code, _, err = call(predict.entry, f"run={run}", f"input={exported}", f"out={written}")
    assert code == 0, err
    words = (f"predictions={written}", f"pairs={exported}", f"out={out}")
    measure(call, *words, "dataset=mfnet", f"dataset.root={data}")
    assert_same_counts(out, run / "evaluations")


HW = (48, 64)
STEP = 4
"""Columns by which everything moves to the left from frame to frame."""

NUMBERS = range(1, 5)
PIXELS = numpy_generator(0, "scene").integers(0, 256, (HW[0], HW[1] + STEP * 10))
NOISE = cv2.GaussianBlur(PIXELS.astype(np.float32), (0, 0), 2.0)
SCENE = (255 * (NOISE - NOISE.min()) / np.ptp(NOISE)).astype(np.uint8)
CLASSES = np.broadcast_to(np.arange(NOISE.shape[1]) // 12 % 3, NOISE.shape).astype(np.uint8)


def shown(image: np.ndarray, number: int) -> np.ndarray:
    return np.ascontiguousarray(image[:, STEP * number : STEP * number + HW[1]])


@pytest.fixture
def drive(tmp_path: Path) -> Path:
    """A video of four frames, of which the third is labelled."""
    for number in NUMBERS:
        write_png(tmp_path / "drive" / f"{number}.png", np.dstack([shown(SCENE, number)] * 4))
    write_png(tmp_path / "drive" / "label" / "3.png", shown(CLASSES, 3))
    return tmp_path / "drive"


def of_video(drive: Path) -> tuple[str, ...]:
    return (
        *("frames=video", "dataset=video", f"dataset.root={drive}", "dataset.num_classes=3"),
        *("dataset.classes=[a,b,c]", "dataset.rgb='{name}.png'", "dataset.thermal='{name}.png'"),
        *("dataset.label='label/{name}.png'", "dataset.absent=released"),
    )


def predict_video(folder: Path, *, wrong: tuple[int, ...] = ()) -> Path:
    for number in NUMBERS:
        found = shown(CLASSES, number)
        write_png(folder / f"{number}.png", (found + (number in wrong)).astype(np.uint8) % 3)
    return folder


def measure_video(call: Call, drive: Path, folder: Path, *more: str) -> dict[str, Counts]:
    out = folder.parent / f"{folder.name}_out"
    given = (f"predictions={folder}", *of_video(drive), f"out={out}", *more)
    assert "Flow of 3 pairs" in measure(call, *given)
    paths = {name: out / f"test_{name}1.npz" for name in ("flow", "triples")}
    return {name: Counts.load(path) for name, path in paths.items()}


def test_predictions_that_follow_the_motion_are_consistent(
    call: Call, drive: Path, tmp_path: Path
) -> None:
    found = measure_video(call, drive, predict_video(tmp_path / "right"))
    assert found["flow"].names == ("2", "3", "4")
    assert found["triples"].names == ("3", "4")
    # The flow is rounded to whole pixels, so that a column beside a border may differ.
    assert min(value(name, found["flow"], "released") for name in ("TC", "CA")) > 97
    assert value("warping_error", found["flow"], "released") < 1.5
    assert value("flicker", found["triples"], "released") < 1
    # Only the third frame has a label; all count for TC.
    labelled = found["flow"].counts[:, :3].sum((1, 2, 3))
    assert labelled.tolist() == [0, found["flow"].counts[1].sum(), 0]
    assert labelled[1] > 0.6 * HW[0] * HW[1]
    records = list(csv.DictReader((tmp_path / "right_out" / "test_flow1.csv").open()))
    assert [record["name"] for record in records] == ["2", "3", "4"]
    for record in records:
        assert float(record["displacement_px"]) == pytest.approx(STEP, abs=0.3)
        assert 0.6 < float(record["used"]) < 1 - STEP / HW[1] + 0.02
    assert (tmp_path / "right_out" / "pairs_test_flow1.png").is_file()


def test_a_frame_that_is_wrong_alone_flickers(call: Call, drive: Path, tmp_path: Path) -> None:
    found = measure_video(call, drive, predict_video(tmp_path / "wrong", wrong=(2,)))
    by_pair = [value("warping_error", found["flow"].select([n]), "released") for n in ("2", "3")]
    assert min(by_pair) > 97
    assert value("warping_error", found["flow"].select(["4"]), "released") < 1.5
    # Frames 1, 2, 3 change and change back; frames 2, 3, 4 only change.
    assert value("flicker", found["triples"].select(["3"]), "released") > 97
    assert value("flicker", found["triples"].select(["4"]), "released") < 1.5
    # Another source of the flow has files of its own.
    measure_video(call, drive, tmp_path / "wrong", "flow=thermal")
    (path,) = (tmp_path / "wrong_out").glob("test_flow1-*.npz")
    assert path.stem == f"test_{Counts.load(path).partition}"
