"""Counts of external rows: made by the commands, kept by content, beside a row of ours."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from analysis import score as score_command
from rgbt import consistency, evaluate, predict
from rgbt.checks import InputError
from rgbt.metrics.counts import Counts
from rgbt.metrics.pairs import tc
from rgbt.runs.result import RunResult
from sweeps.point import Outcome, Point
from sweeps.table import external_runs
from sweeps.table.external import external_rows
from sweeps.table.external_runs import check_external, run_external
from sweeps.table.load_table import load_table
from sweeps.table.scoring import score
from sweeps.table.table import Column, Row, Table
from sweeps.worker.command_process import run_command
from tests.commands import SMALL, SPLITS, Call, Trained, code_of, only_run, short, train
from tests.conftest import pair, write_data

ROOT = Path(__file__).resolve().parents[3]
SHARED = Path(os.environ.get("RGBT_SHARED", ROOT.parent / "shared"))
REAL = SHARED / "realdata"
ENTRIES = {
    "rgbt.evaluate": evaluate.entry,
    "rgbt.consistency": consistency.entry,
    "analysis.score": score_command.entry,
}
ONE = ("+experiment=mfnet", "masker.patch_size=null", *short(1))
COLUMNS = (
    Column(name="mIoU", metric="mIoU"),
    Column(name="no RGB", metric="mIoU", corruption="removed:rgb"),
    Column(name="TC", metric="TC", frames="aligned"),
)
TABLE = Table(
    paper="my",
    number="1",
    caption="c",
    data="d",
    columns=COLUMNS,
    rows=(
        Row(label="CMNeXt"),
        Row(label="MFNet", experiment="mfnet", overrides=ONE[1:]),
        Row(label="RTFNet", network=("model=rtfnet_tiny",)),
    ),
)
Commands = list[tuple[str, ...]]


@pytest.fixture
def commands(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> Commands:
    """The commands that are called, in this process and not in one of their own."""
    called: Commands = []

    def run(command: Sequence[str], log: Path) -> str:
        called.append(tuple(command))
        module, *words = command
        code = code_of(ENTRIES[module], words)
        _, err = capfd.readouterr()
        return err.strip().splitlines()[-1].removeprefix("rgbt: ") if code else ""

    monkeypatch.setattr(external_runs, "run_command", run)
    return called


@pytest.fixture
def predictions(data: Path, tmp_path: Path) -> Path:
    """Labels of split test with the left third taken for class 0."""
    folder = tmp_path / "method"
    folder.mkdir()
    for name in SPLITS["test"]:
        prediction = pair(name, (48, 64))[2].copy()
        prediction[:, :21] = 0
        cv2.imwrite(str(folder / f"{name}.png"), prediction)
    return folder


Runs = Callable[..., dict[str, Outcome]]


@pytest.fixture
def runs_of(data: Path, tmp_path: Path) -> Runs:
    def run(*words: str, table: Table = TABLE, **options: Any) -> dict[str, Outcome]:
        place = ("dataset=mfnet", f"dataset.root={data}", "data.num_workers=0")
        rows, extra = external_rows([*place, *SMALL, *words], table)
        settings: dict[str, Any] = {"scale": "demo", "form": "paper", "extra": extra}
        base = ["tracking=none"]
        runs_dir = tmp_path / "runs"
        return dict(run_external(rows, table, base=base, runs_dir=runs_dir, **settings, **options))

    return run


@pytest.mark.slow
def test_predictions_have_the_counts_of_rgbt_score(
    call: Call, commands: Commands, runs_of: Runs, data: Path, predictions: Path, tmp_path: Path
) -> None:
    for regions, file in (("as trained", "ring5"), ("ring9", "ring9"), ("vertical5", "vertical5")):
        table = replace(TABLE, regions=regions)
        run = runs_of(f"predictions.cmnext={predictions}", table=table)["CMNeXt"]
        assert run.state == "finished"
        (result,) = run.results
        path = (
            "counts_test.npz"
            if regions == "as trained"
            else f"evaluations/table_default_{regions}.npz"
        )
        words = (f"predictions={predictions}", "dataset=mfnet", f"dataset.root={data}")
        out = tmp_path / f"scored_{file}"
        shape = (f"partition={file.rstrip('59')}", f"regions={file[-1]}", "resamples=0")
        assert call(score_command.entry, *words, *shape, f"out={out}")[0] == 0
        expected = Counts.load(out / f"counts_{file}.npz")
        found = result.counts(path)
        assert np.array_equal(found.counts, expected.counts)
        assert (found.dataset, found.partition) == (expected.dataset, file)
        other = f"evaluations/table_default_{regions.replace(' ', '-')}_rgb_removed.npz"
        assert "needs the network: predictions of a folder are of" in run.missing[other]
        pairs = "evaluations/consistency_aligned_test.npz"
        assert "needs predictions of both frames and pairs.json" in run.missing[pairs]
    assert [command[0] for command in commands] == ["analysis.score"] * 3


def test_weights_have_the_counts_of_the_run_that_trained_them(
    trained: Trained, commands: Commands, runs_of: Runs
) -> None:
    run = trained(*ONE)
    found = runs_of(f"weights.MFNet={run / 'best.pt'}")["MFNet"].results[0]
    expected = RunResult(run).counts()
    assert np.array_equal(found.counts().counts, expected.counts)
    assert found.counts().dataset == expected.dataset
    without = found.counts("evaluations/table_default_as-trained_rgb_removed.npz")
    assert not np.array_equal(without.counts, expected.counts)
    assert without.partition == expected.partition == "ring5"
    pairs = found.counts("evaluations/consistency_aligned_test.npz")
    scored = score(
        "my/1",
        TABLE,
        {("MFNet", 0): Outcome(Point("MFNet", ()), "finished", results=(found,))},
        scale="demo",
    )
    mean = 100 * tc(pairs.by_region(), "released").mean()
    assert scored.cells["MFNet", "TC"].mean == pytest.approx(mean)
    assert scored.cells["MFNet", "no RGB"].reason == ""
    assert found.folder.joinpath("evaluations/consistency_released_test.npz").is_file()
    assert len(commands) == 3  # both protocols in one call


@pytest.mark.slow
def test_predictions_of_exported_pairs_have_a_consistency(
    call: Call,
    commands: Commands,
    runs_of: Runs,
    trained: Trained,
    data: Path,
    tmp_path: Path,
) -> None:
    run, pairs, folder = trained(*ONE), tmp_path / "pairs", tmp_path / "written"
    place = ("dataset=mfnet", f"dataset.root={data}")
    assert call(consistency.entry, f"export={pairs}", *place)[0] == 0
    assert call(predict.entry, f"run={run}", f"input={pairs}", f"out={folder}")[0] == 0
    shutil.copy(pairs / "pairs.json", folder)
    (found,) = runs_of(f"predictions.CMNeXt={folder}")["CMNeXt"].results
    (network,) = runs_of(f"weights.MFNet={run / 'best.pt'}")["MFNet"].results
    for path in ("counts_test.npz", "evaluations/consistency_aligned_test.npz"):
        assert np.array_equal(found.counts(path).counts, network.counts(path).counts)


@pytest.mark.slow
def test_a_second_call_reads_what_is_there_unless_content_changes(
    commands: Commands, runs_of: Runs, predictions: Path, tmp_path: Path
) -> None:
    word = f"predictions.CMNeXt={predictions}"
    assert runs_of(word, dry_run=True)["CMNeXt"].state == "waiting"
    assert not (tmp_path / "runs").exists()
    (first,) = runs_of(word)["CMNeXt"].results
    moved = predictions.rename(tmp_path / "moved")
    word = f"predictions.CMNeXt={moved}"
    (second,) = runs_of(word)["CMNeXt"].results
    assert (second.folder, len(commands)) == (first.folder, 1)
    assert runs_of(word, dry_run=True)["CMNeXt"].results == (second,)
    noted = json.loads((first.folder / "external.json").read_text())
    assert noted["path"] == str(tmp_path / "method")
    # A damaged file of counts is made again.
    (first.folder / "counts_test.npz").write_bytes(b"damaged")
    runs_of(word)
    assert len(commands) == 2
    assert first.counts().counts.sum() == 3 * 48 * 64
    cv2.imwrite(str(moved / "00201D.png"), np.zeros((48, 64), np.uint8))
    (third,) = runs_of(word)["CMNeXt"].results
    assert third.folder != first.folder
    assert len(commands) == 3
    # A plain column alone asks for no more than it needs.
    runs_of(word, table=replace(TABLE, columns=COLUMNS[:1]))
    assert len(commands) == 3


def test_an_interrupted_call_leaves_no_counts(
    commands: Commands, runs_of: Runs, predictions: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = external_runs.run_command

    def interrupted(command: Sequence[str], log: Path) -> str:
        run(command, log)
        raise KeyboardInterrupt

    word = f"predictions.CMNeXt={predictions}"
    with monkeypatch.context() as patch:
        patch.setattr(external_runs, "run_command", interrupted)
        with pytest.raises(KeyboardInterrupt):
            runs_of(word)
    folder = predictions.parent / "runs" / "external"
    assert not list(folder.rglob("*.npz"))
    assert runs_of(word)["CMNeXt"].state == "finished"
    assert len(commands) == 2
    assert not list(folder.rglob("partial"))


def test_weights_of_another_network_are_refused(
    trained: Trained, commands: Commands, runs_of: Runs
) -> None:
    runs = runs_of(f"weights.RTFNet={trained(*ONE) / 'best.pt'}")
    assert runs["RTFNet"].state == "failed"
    assert "cannot be loaded into RTFNet" in runs["RTFNet"].reason
    with pytest.raises(InputError, match=r"^row 'RTFNet': .*cannot be loaded into RTFNet"):
        check_external(runs)
    assert len(commands) == 1  # its other columns are not tried


def test_predictions_of_another_data_set_are_refused(
    commands: Commands, runs_of: Runs, predictions: Path
) -> None:
    for path in sorted(predictions.glob("*.png")):
        path.rename(path.with_stem(f"1{path.stem}"))
    runs = runs_of(f"predictions.CMNeXt={predictions}")
    assert runs["CMNeXt"].state == "failed"
    with pytest.raises(InputError, match=r"^row 'CMNeXt': none of the 3 images of split 'test'"):
        check_external(runs)
    label = predictions.parent / "mf" / "labels" / "00201D.png"
    for name in SPLITS["test"]:  # the right names of images of another size
        cv2.imwrite(str(predictions / f"{name}.png"), np.zeros((10, 10), np.uint8))
    runs = runs_of(f"predictions.CMNeXt={predictions}")
    assert "is 10x10 pixels but its label is 48x64" in runs["CMNeXt"].reason
    assert label.is_file()


def test_a_wrong_data_set_stops_before_any_command(
    commands: Commands, runs_of: Runs, predictions: Path
) -> None:
    with pytest.raises(InputError, match="dataset"):
        runs_of(f"predictions.CMNeXt={predictions}", "dataset.root=/nowhere")
    assert not commands


def test_run_command_gives_the_reason_of_a_failure(tmp_path: Path) -> None:
    log = tmp_path / "logs" / "a.log"
    log.parent.mkdir()
    log.write_text("rgbt: the reason of an earlier command\n")
    reason = run_command(("analysis.score", "predictions=nothing"), log)
    assert reason.startswith("no data set is named; set dataset=mfnet")
    assert log.read_text().count("rgbt: ") == 2


# ---- the 20 real test pairs -------------------------------------------------------------------

METHODS = ("LASNet", "SGFNet", "MMSMCNet")
REAL_TABLE = """
paper: my
number: TABLE I
caption: Published methods beside ours.
data: 20 test pairs of MFNet
columns:
  - {name: all, metric: mIoU}
  - {name: day, metric: day/mIoU}
  - {name: night, metric: night/mIoU}
  - {name: centre, metric: region/1}
  - {name: edge, metric: region/5}
rows:
  - {label: LASNet}
  - {label: SGFNet}
  - {label: MMSMCNet}
  - {label: MFNet (authors), network: [model=mfnet]}
  - label: Ours
    experiment: mfnet
    overrides: [masker.patch_size=null, trainer.max_steps=1, trainer.eval_every=1]
"""


@dataclass(frozen=True)
class OurRun:
    """A finished run of ours, as a sweep reports it."""

    results: Sequence[RunResult]
    state: str = "finished"
    reason: str = ""


def real_data(folder: Path) -> Path:
    """The 20 test pairs, with two pairs of noise to train on."""
    write_data(folder, {"train": ["1D", "2D"], "val": ["3D"]}, (48, 64))
    for kind in ("images", "labels"):
        shutil.copytree(REAL / "mfnet20" / kind, folder / kind, dirs_exist_ok=True)
    for name in ("test.txt", "test_day.txt", "test_night.txt"):
        shutil.copy(REAL / "mfnet20" / name, folder)
    return folder


@pytest.mark.slow
@pytest.mark.skipif(not (REAL / "predictions20").is_dir(), reason="real data is not here")
def test_published_methods_stand_beside_ours_with_their_known_counts(
    call: Call, tmp_path: Path
) -> None:
    data = real_data(tmp_path / "mf")
    (tmp_path / "table.yaml").write_text(REAL_TABLE)
    table = load_table(str(tmp_path / "table.yaml"))
    place = ["dataset=mfnet", f"dataset.root={data}", "data.num_workers=0"]
    place += ["trainer.accelerator=cpu", "trainer.threads=1"]
    weights = REAL / "mfnet_weights" / "final.pth"
    words = [f"predictions.{name}={REAL / 'predictions20' / name}" for name in METHODS]
    rows, extra = external_rows([*words, f"weights.MFNet={weights}", *place], table)
    settings: Any = {"scale": "demo", "form": "paper", "base": ["tracking=none"], "extra": extra}
    runs = dict(run_external(rows, table, runs_dir=tmp_path / "runs", **settings))
    check_external(runs)

    known = json.loads((REAL / "predictions20" / "expected_confusions.json").read_text())
    names = dict(
        zip(("LASNet", "SGFNet", "MMSMCNet", "MFNet (authors)"), [*METHODS, "MFNet_final_pth"])
    )
    for label, name in names.items():
        counts = runs[label].results[0].counts()
        assert (len(counts.names), counts.partition) == (20, "ring5")
        parts = {"test": counts, **{f"test_{key}": each for key, each in counts.parts().items()}}
        for split, part in parts.items():
            assert np.array_equal(part.whole(), known[f"{name}/{split}"]["confusion"])
        if label != "MFNet (authors)":  # the same with `rgbt score`
            out = tmp_path / name
            given = f"predictions={REAL / 'predictions20' / name}"
            code, _, err = call(score_command.entry, given, *place[:2], f"out={out}", "resamples=0")
            assert code == 0, err
            assert np.array_equal(counts.counts, Counts.load(out / "counts_ring5.npz").counts)
    out = tmp_path / "counts.npz"
    code, _, err = call(
        evaluate.entry, "model=mfnet", f"model.weights={weights}", *place, f"out={out}"
    )
    assert code == 0, err
    network = runs["MFNet (authors)"].results[0].counts()
    assert np.array_equal(network.counts, Counts.load(out).counts)

    code, _, err = train(call, data, tmp_path / "own", *table.overrides(table.rows[-1], "demo"))
    assert code == 0, err
    ours = RunResult(only_run(tmp_path / "own"))
    assert ours.counts().dataset == network.dataset
    cells: dict[tuple[str, int], Outcome] = {(label, 0): run for label, run in runs.items()}
    scored = score("my/1", table, {**cells, ("Ours", 0): OurRun([ours])}, scale="demo")
    for row in table.rows:
        for column in table.columns:
            assert scored.cells[row.label, column.name].seeds == 1
    assert scored.cells["SGFNet", "all"].mean == pytest.approx(40.28, abs=0.005)
