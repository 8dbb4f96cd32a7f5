"""Damaged files of every kind that is read: the same value or one sentence, never another value."""

from __future__ import annotations

import json
import operator
import re
import resource
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from rgbt.checks import InputError, RunError
from rgbt.files.budgets import sealed
from tests.commands import Call, Trained, short, train
from tests.damage import damaged

WORDS = ("+experiment=grbm", *short(4))

HEADROOM = 2**30
"""Bytes that reading a small damaged file may ask for at most."""


@dataclass(frozen=True)
class Kind:
    """A kind of file.

    Attributes:
        name: of the file.
        make: writes it, and what it needs beside it, into a folder; returns its path.
        read: what is loaded of it.
        fits: whether what was loaded of a damaged file is right, given what was loaded of the whole
            one: equal; or `part_of` it; or `anything`, of files without check sums.
    """

    name: str
    make: Callable[[Path], Path]
    read: Callable[[Path], Any]
    fits: Callable[[Any, Any], bool] = operator.eq


def part_of(value: Any, expected: Any) -> bool:
    """Entries of the whole file, in their order, none twice."""
    rest = iter(expected)
    return all(any(each == other for other in rest) for each in value)


def part_of_some(value: Any, expected: Any) -> bool:
    """Entries of the whole file, in any order: a file that is followed is not judged as a whole."""
    return all(each in expected for each in value)


def anything(value: Any, expected: Any) -> bool:
    """Values may be others of the same form."""
    return True


def counts(folder: Path) -> Path:
    from rgbt.metrics.counts import Counts

    rng = np.random.default_rng(0)
    Counts(
        counts=rng.integers(0, 99, (4, 3, 5, 5)),
        names=("a", "b", "c", "d"),
        night=(True, False, True, False),
        classes=("background", "car", "person", "bike", "curve"),
        partition="ring3",
        dataset="0123456789abcdef",
        split="test",
        unscored=("curve",),
    ).save(folder / "counts_test.npz")
    return folder / "counts_test.npz"


def old_counts(folder: Path) -> Path:
    """As written before archives had a digest."""
    path = counts(folder)
    with np.load(path) as stored:
        values = {key: stored[key] for key in stored.files if key != "digest"}
    np.savez_compressed(path, **values)
    return path


def pair_counts(folder: Path) -> Path:
    from rgbt.metrics.counts import Counts

    rng = np.random.default_rng(0)
    classes = ("background", "car", "person")
    found = rng.integers(0, 9, (2, 8, 3, 3))
    Counts(
        counts=found,
        names=("a", "b"),
        night=None,
        classes=classes,
        partition="aligned2",
        dataset="0123",
        split="val",
    ).save(folder / "consistency_aligned_val.npz")
    return folder / "consistency_aligned_val.npz"


def statistics(folder: Path) -> Path:
    from analysis.statistics.data import SpatialStatistics

    rng = np.random.default_rng(0)
    SpatialStatistics(
        dataset="mfnet",
        fingerprint="0123",
        split="train",
        classes=("background", "car"),
        background=("background",),
        palette=np.array([[0, 0, 0], [1, 2, 3]], np.uint8),
        partition="ring2",
        region_map=rng.integers(0, 2, (6, 8), dtype=np.uint8),
        kernel="four",
        names=("a", "b", "c"),
        night=np.array([True, False, False]),
        labels=rng.integers(0, 9, (3, 2, 2)),
        ignored=rng.integers(0, 9, (3, 2)),
        parts=("day", "night"),
        occupied=rng.integers(0, 3, (2, 2, 6, 8), dtype=np.int32),
        laplacian=rng.random((3, 2, 2)),
        mean=rng.random((3, 2, 2)),
        noise={"std": rng.random((3, 2, 2))},
    ).save(folder / "statistics.npz")
    return folder / "statistics.npz"


def pixel_maps(folder: Path) -> Path:
    from analysis.predictions.maps import PixelMaps

    rng = np.random.default_rng(0)
    PixelMaps(
        intersection=rng.integers(0, 9, (2, 6, 8), dtype=np.int32),
        union=rng.integers(9, 20, (2, 6, 8), dtype=np.int32),
        images=3,
        classes=("background", "car"),
        palette=((0, 0, 0), (1, 2, 3)),
        dataset="0123",
        split="test",
        name="method",
    ).save(folder / "maps.npz")
    return folder / "maps.npz"


def load_counts(path: Path) -> Any:
    from rgbt.metrics.counts import Counts

    return plain(Counts.load(path))


def load_statistics(path: Path) -> Any:
    from analysis.statistics.data import SpatialStatistics

    return plain(SpatialStatistics.load(path))


def load_maps(path: Path) -> Any:
    from analysis.predictions.maps import PixelMaps

    return plain(PixelMaps.load(path))


def picture(hw: tuple[int, int], channels: int, dtype: str = "uint8") -> np.ndarray:
    """Smooth, as photographs are, with a little noise."""
    rng = np.random.default_rng(0)
    rows, columns = np.indices(hw)
    top = np.iinfo(dtype).max
    shape = (*hw, channels) if channels > 1 else hw
    waves = (np.sin(rows / 7) + np.cos(columns / 9) + 2) / 4
    noise = rng.random(shape) / 20
    return ((waves[..., None] if channels > 1 else waves) * 0.9 * top + noise * top).astype(dtype)


def image(name: str, channels: int, dtype: str = "uint8") -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        assert cv2.imwrite(str(folder / name), picture((40, 56), channels, dtype))
        return folder / name

    return make


def label(folder: Path) -> Path:
    content = (np.indices((40, 56)).sum(0) // 8 % 5).astype(np.uint8)
    assert cv2.imwrite(str(folder / "label.png"), content)
    return folder / "label.png"


def palette_label(folder: Path) -> Path:
    from PIL import Image

    content = (np.indices((40, 56)).sum(0) // 8 % 5).astype(np.uint8)
    shown = Image.fromarray(content, "P")
    shown.putpalette([value for n in range(5) for value in (n, 2 * n, 3 * n)])
    shown.save(folder / "palette.png")
    return folder / "palette.png"


def decode(path: Path) -> Any:
    from rgbt.data.files import decode as decoded

    return plain(decoded(path))


def read_label(path: Path) -> Any:
    from rgbt.data.labels import read_label as read

    return plain(read(path, 5))


def read_prediction(path: Path) -> Any:
    from rgbt.data.prediction_images import PredictionReader

    return plain(PredictionReader(tuple("abcde")).read(path))


def label_array(folder: Path) -> Path:
    np.save(folder / "label.npy", (np.indices((40, 56)).sum(0) // 8 % 5).astype(np.uint8))
    return folder / "label.npy"


def read_label_array(path: Path) -> Any:
    from rgbt.data.labels import read_label as read

    return plain(read(path, 5))


def run_folder(folder: Path) -> Any:
    from rgbt.tracking.run_files import Description
    from rgbt.tracking.run_folder import RunFolder
    from rgbt.tracking.tables import ClassTable, RegionTable, ResultTables

    run = RunFolder(folder)
    run.describe(Description("grbm seed=0", {"rgbt.seed": "0"}, {"seed": "0", "scale": "demo"}))
    for step in range(10, 60, 10):
        run.append(step, "train", {"loss": 1 / step, "learning_rate": 1e-4})
    run.append(50, "val", {"mIoU": 0.25, "class/bump": float("nan")})
    run.append(50, "test", {"mIoU": 0.5})
    run.write_tables(
        ResultTables(
            split="test",
            step=50,
            region_names=("ring_1",),
            regions=RegionTable("grbm", (0.5,), 0.5, 0.0),
            classes=ClassTable(("a",), (0.5,), (0.5,), ((0.5,),), {}),
        )
    )
    run.add_provenance({"command": "a", "git_commit": "0123456789", "diff": "", "cpu_usable": 2})
    scores = {"val": {"mIoU": 0.25}, "test": {"mIoU": 0.5, "Var": None}}
    run.finish(
        {
            **{"name": "grbm", "key": "0123", "dataset": "0123456789abcdef", "steps": 50},
            **{"best_step": 50, "best_score": 0.25, "seconds_of_last_process": 3.5, "skipped": []},
            **scores,
        }
    )
    return run


def sent(folder: Path) -> Path:
    from rgbt.tracking.mlflow_upload import UploadState, write_upload_state

    run = run_folder(folder)
    noted = UploadState("sqlite:///runs/mlflow.db", "rgbt", experiment_id="1", run_id="0f3a" * 8)
    write_upload_state(run, replace(noted, steps={"train": 50}, files={"config.yaml": "ab" * 32}))
    return Path(run.path / "mlflow.json")


def read_upload_state(path: Path) -> Any:
    from rgbt.tracking.mlflow_upload import read_upload_state as read
    from rgbt.tracking.run_folder import RunFolder

    return plain(read(RunFolder(path.parent)))


def in_run(name: str) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        return Path(run_folder(folder).path / name)

    return make


def by(reader: str) -> Callable[[Path], Any]:
    def read(path: Path) -> Any:
        from rgbt.tracking import run_files

        return plain(getattr(run_files, reader)(path.parent))

    return read


def read_provenance(path: Path) -> Any:
    from rgbt.tracking.run_files import read_provenance as read

    return plain(read(path))


def read_lines(path: Path) -> Any:
    from rgbt.tracking.run_folder import RunFolder

    return plain(RunFolder(path.parent).lines())


def resume(path: Path) -> Any:
    """What is left of the lines where a run resumes at step 30."""
    from rgbt.tracking.run_folder import RunFolder

    run = RunFolder(path.parent)
    run.truncate_after(30)
    lines = run.lines()
    steps = [(line.kind, line.step) for line in lines]
    assert steps == sorted(set(steps)), "lines are doubled or out of order"
    return plain(lines)


def marker(folder: Path) -> Path:
    run = run_folder(folder)
    run.mark({"names": "0123456789abcdef", "files": "fedcba9876543210"})
    return Path(run.path / "dataset.json")


def read_marker(path: Path) -> Any:

    from rgbt.tracking.run_files import read_marker as read

    return plain(read(path.parent))


def follow(path: Path) -> Any:
    from sweeps.worker.run_monitor import MetricsReader

    return plain(MetricsReader(path.parent).new_lines())


def result_of(path: Path) -> Any:
    from rgbt.tracking.run_result import RunResult

    run = RunResult(path.parent)
    return plain((run.dataset, run.commit, run.scores()))


def pseudo(folder: Path) -> Path:
    from rgbt.data.pseudo_labels import FORMAT

    (folder / "labels").mkdir(exist_ok=True)
    (folder / "confidence").mkdir(exist_ok=True)
    label(folder / "labels").rename(folder / "labels" / "a.png")
    image("a.png", 1, "uint16")(folder / "confidence")
    manifest = {
        **{"format": FORMAT, "teacher": "0123", "weights": "ab", "network": "cd", "view": None},
        **{"head": None, "label_map": None, "threshold": 0.9, "dataset": "mfnet"},
        **{"fingerprint": "0123", "split": "train", "classes": list("abcde"), "images": 1},
        **{"skipped": [], "kept": 0.5, "mean_confidence": 0.7, "digest": "ef" * 32},
        "by_class": {name: {"share": 0.2, "mean_confidence": 0.7} for name in "abcde"},
    }
    (folder / "pseudo_labels.json").write_text(json.dumps(sealed(manifest), indent=1))
    return folder / "pseudo_labels.json"


def read_pseudo(path: Path) -> Any:
    from rgbt.data.pseudo_labels import PseudoLabels
    from rgbt.spec.run_key import manifest_of

    folder = path if (path / "pseudo_labels.json").is_file() else path.parent
    if folder.name in ("labels", "confidence"):
        folder = folder.parent
    labels = PseudoLabels(folder)
    assert manifest_of("domains.target.labels", str(folder)) == labels.manifest
    return plain((labels.classes, labels.digest, *labels.read("a", 5)))


def split_list(folder: Path) -> Path:
    path = folder / "train.txt"
    path.write_text("".join(f"{n:05d}D\n" for n in range(100)))
    return path


def read_names(path: Path) -> Any:
    from rgbt.data.integrity import read_names as read

    return plain(read(path, "dataset.splits"))


def cache(folder: Path) -> Path:
    from rgbt.data.cache.sample_map import NewSample, write_map

    write_map(folder / "cache.frames", (NewSample(each, ()) for each in cached_samples()))
    return folder / "cache.frames"


def read_cache(path: Path) -> Any:
    from rgbt.data.cache.sample_map import SampleMap

    try:
        held = SampleMap(path)
    except ValueError as error:  # what is damaged is decoded again
        raise InputError(f"{error}.") from error
    if not held.is_intact(1, lambda *_: None):
        raise InputError("a sample is damaged.")
    return plain([held.read(name) for name in held.records])


def cached_samples() -> list[Any]:
    from rgbt.types import Sample

    rgb = picture((10, 12), 3)
    return [Sample(rgb // n, rgb[..., 0] // n, None, name=f"{n}") for n in (1, 2, 3)]


def journal(folder: Path) -> Path:
    import optuna

    from sweeps.worker.storage import open_storage

    opened = open_storage(None, folder)
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    study = optuna.create_study(study_name="s", storage=opened)
    for value in range(5):
        trial = study.ask()
        trial.suggest_float("x", 0, 1)
        study.tell(trial, value / 10)
    return folder / "studies.journal"


def read_journal(path: Path) -> Any:
    from sweeps.worker.storage import find_study

    study = find_study("s", None, path.parent)
    if study is None:
        raise InputError("there is no such study.")
    return plain([(trial.number, trial.params, trial.values) for trial in study.get_trials()])


def robustness(folder: Path) -> Path:
    from analysis.robustness import FORMAT

    counts(folder).rename(folder / "noise.npz")
    made = {"format": FORMAT, "row": "noise", "title": "Noise", "unit": "", "severity": 0.5}
    (folder / "noise.json").write_text(json.dumps(sealed(made)))
    return folder / "noise.json"


def read_robustness(path: Path) -> Any:
    from analysis.robustness import _level

    level = _level(path)
    return plain((level.row, level.title, level.unit, level.severity))


def angles(folder: Path) -> Path:
    (folder / "views.csv").write_text("yaw,pitch,roll\n1.5,2,3\n-4,5.25,6\n")
    return folder / "views.csv"


def read_angles(path: Path) -> Any:
    from rgbt.transforms.view_sets import read_angles as read

    return plain(read(str(path)).numpy())


def flow(folder: Path) -> Path:
    for each in ("images", "labels", "next/images", "next/labels", "next/flow"):
        (folder / each).mkdir(parents=True, exist_ok=True)
    np.save(folder / "next" / "flow" / "a.npy", np.zeros((10, 12, 2), np.float32))
    return folder / "next" / "flow" / "a.npy"


def read_flow(path: Path) -> Any:
    from rgbt.data.mfnet import MFNet
    from rgbt.data.next_frames import NextFrames

    first = MFNet(
        str(path.parents[2]),
        name="mfnet",
        num_classes=2,
        classes=("a", "b"),
        palette=((0, 0, 0), (1, 1, 1)),
        background=(),
    )
    return plain(NextFrames(first).source("a", (10, 12)))


KINDS = {
    kind.name: kind
    for kind in (
        Kind("counts", counts, load_counts),
        Kind("counts of before the digest", old_counts, load_counts),
        Kind("counts of pairs", pair_counts, load_counts),
        Kind("spatial statistics", statistics, load_statistics),
        Kind("pixel maps", pixel_maps, load_maps),
        Kind("PNG of 4 channels", image("a.png", 4), decode),
        Kind("PNG of 16 bits", image("b.png", 1, "uint16"), decode),
        Kind("JPEG", image("c.jpg", 3), decode, anything),
        Kind("TIFF", image("d.tiff", 1, "uint16"), decode, anything),
        Kind("BMP", image("e.bmp", 3), decode, anything),
        Kind("label PNG", label, read_label),
        Kind("label PNG with a palette", palette_label, read_label),
        Kind("label array", label_array, read_label_array, anything),
        Kind("flow array", flow, read_flow, anything),
        Kind("prediction PNG", label, read_prediction),
        Kind("prediction PNG with a palette", palette_label, read_prediction),
        Kind("metrics.jsonl", in_run("metrics.jsonl"), read_lines, part_of),
        Kind("metrics.jsonl of a resumed run", in_run("metrics.jsonl"), resume, part_of),
        Kind("metrics.jsonl of a sweep", in_run("metrics.jsonl"), follow, part_of_some),
        Kind("result.json", in_run("result.json"), by("read_result")),
        Kind("result.json of a sweep", in_run("result.json"), result_of),
        Kind("run.json", in_run("run.json"), by("read_description")),
        Kind("tables.json", in_run("tables.json"), by("read_tables")),
        Kind("provenance.json", in_run("provenance.json"), read_provenance),
        Kind("mlflow.json", sent, read_upload_state),
        Kind("dataset.json", marker, read_marker),
        Kind("pseudo_labels.json", pseudo, read_pseudo),
        Kind("pseudo-label", lambda f: pseudo(f).parent / "labels" / "a.png", read_pseudo),
        Kind("confidence", lambda f: pseudo(f).parent / "confidence" / "a.png", read_pseudo),
        Kind("split list", split_list, read_names, anything),
        Kind("image cache", cache, read_cache),
        Kind("journal of studies", journal, read_journal, anything),
        Kind("robustness.json", robustness, read_robustness),
        Kind("angles of views", angles, read_angles, anything),
    )
}


def plain(value: Any) -> Any:
    """A value that can be compared: arrays as type, shape and bytes, NaN equal to itself."""
    if isinstance(value, np.ndarray):
        return (value.dtype.str, value.shape, value.tobytes())
    if hasattr(value, "__dataclass_fields__"):
        return {field.name: plain(getattr(value, field.name)) for field in fields(value)}
    if isinstance(value, dict):
        return {key: plain(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [plain(each) for each in value]
    return repr(value)


@contextmanager
def limited(headroom: int) -> Iterator[None]:
    """Fail to allocate more than `headroom` bytes beyond what the process has."""
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    before = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + headroom, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, before)


def is_sentence(text: str) -> bool:
    return text.isprintable() and text.endswith(".") and len(text) < 800


def outcomes(kind: Kind, folder: Path, number: int) -> dict[str, list[str]]:
    """Variants by what became of them: "fits", "refused", "other value", "unreadable sentence",
    or the name of an exception.
    """
    path = kind.make(folder)
    content = path.read_bytes()
    beside = {each: each.read_bytes() for each in folder.rglob("*") if each.is_file()}
    expected = kind.read(path)
    seen: dict[str, list[str]] = {}
    with limited(HEADROOM):
        for name, variant in damaged(content, number):
            for each, original in beside.items():
                if not each.is_file() or each.read_bytes() != original:
                    each.write_bytes(original)
            path.write_bytes(variant)
            seen.setdefault(outcome(kind, path, expected), []).append(name)
    return seen


def outcome(kind: Kind, path: Path, expected: Any) -> str:
    try:
        value = kind.read(path)
    except (InputError, RunError) as error:
        return "refused" if is_sentence(str(error)) else f"unreadable sentence {str(error)!r}"
    except Exception as error:
        return f"{type(error).__name__}: {re.sub(r'[0-9]+', 'N', str(error))[:60]!r}"
    return "fits" if kind.fits(value, expected) else "other value"


def check(name: str, folder: Path, number: int) -> None:
    kind = KINDS[name]
    seen = outcomes(kind, folder, number)
    wrong = {what: names[:3] for what, names in seen.items() if what not in ("fits", "refused")}
    assert not wrong, {what: len(names) for what, names in seen.items()} | wrong
    assert sum(map(len, seen.values())) == number


@pytest.mark.parametrize("name", KINDS)
def test_fifty_damaged_files(name: str, tmp_path: Path) -> None:
    check(name, tmp_path, 50)


@pytest.mark.slow
@pytest.mark.parametrize("name", KINDS)
def test_a_thousand_damaged_files(name: str, tmp_path: Path) -> None:
    check(name, tmp_path, 1000)


@pytest.mark.slow
def test_run_resumes_with_damaged_lines_and_reports_them(
    call: Call, trained: Trained, tmp_path: Path
) -> None:
    made = trained("+experiment=grbm", *short(4))
    folder = tmp_path / "runs" / made.name
    shutil.copytree(made, folder)
    whole = (folder / "metrics.jsonl").read_text().splitlines(keepends=True)
    before = json.loads((folder / "result.json").read_text())
    (folder / "result.json").unlink()
    kept = [
        line.replace('"kind": "val"', '"kind": "vel"') for line in whole if '"test"' not in line
    ]
    (folder / "metrics.jsonl").write_text("".join(kept[:1] + kept))
    code, _, err = train(call, made.parents[1] / "mf", tmp_path / "runs", *WORDS)
    assert code == 0, err
    assert "metrics.jsonl was damaged (line 2: step 1 comes after 1 and 1 more); these lines" in err
    after = json.loads((folder / "result.json").read_text())
    assert {**after["val"]} == before["val"], "recomputed from the counts of the best checkpoint"
    assert after["test"] == before["test"]
    lines = (folder / "metrics.jsonl").read_text().splitlines(keepends=True)
    assert lines[:4] == [line for line in whole if '"train"' in line]


@pytest.mark.slow
def test_a_log_that_was_cut_off_is_reported(call: Call, trained: Trained, tmp_path: Path) -> None:
    made = trained("+experiment=grbm", *short(4))
    folder = tmp_path / "runs" / made.name
    shutil.copytree(made, folder)
    (folder / "result.json").unlink()
    first = (folder / "metrics.jsonl").read_text().splitlines(keepends=True)[0]
    (folder / "metrics.jsonl").write_text(first + first[:20])
    code, _, err = train(call, made.parents[1] / "mf", tmp_path / "runs", *WORDS)
    assert code == 0, err
    assert (
        "metrics.jsonl ends at step 1, but the checkpoint is of step 4. The lines in between" in err
    )
