"""Rows of weights and of predictions: their words, commands, counts and folders."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from analysis import score as score_command
from analysis.uncertainty.contrasts import FIXED
from rgbt import consistency, evaluate, predict
from rgbt.checks import InputError
from rgbt.metrics.counts import Counts
from rgbt.metrics.pairs import frames, tc
from rgbt.runs.result import RunResult
from sweeps.plan.measurement import counts_of, stored_at
from sweeps.plan.request import TableRequest, external_rows
from sweeps.plan.table import Column, Row, Table
from sweeps.point import Outcome
from sweeps.score import external
from sweeps.score.cells import score
from sweeps.score.external import content_hash, evaluate_external
from tests.commands import SMALL, SPLITS, Call, Trained, code_of, short
from tests.conftest import pair
from tests.sweeps.tabled import table as table_of

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
ROWS = (
    Row(label="CMNeXt"),
    Row(label="MFNet", experiment="mfnet", overrides=ONE[1:]),
    Row(label="RTFNet", network=("model=rtfnet_tiny",)),
)
TABLE = table_of(ROWS, COLUMNS)


def test_content_hash_covers_names_and_contents(tmp_path: Path) -> None:
    folder = tmp_path / "predicted"
    folder.mkdir()
    seen = {content_hash(folder)}
    for name, content in (("a.png", b"1"), ("b.png", b"1"), ("b.png", b"2"), ("c.png", b"")):
        (folder / name).write_bytes(content)
        seen.add(content_hash(folder))
    assert len(seen) == 5
    (folder / "a.png").rename(folder / "aa.png")
    seen.add(before := content_hash(folder))
    assert len(seen) == 6
    (folder / ".DS_Store").write_bytes(b"")
    assert content_hash(folder.rename(tmp_path / "moved")) == before


Commands = list[tuple[str, ...]]
Runs = Callable[..., dict[str, Outcome]]


@pytest.fixture
def commands(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> Commands:
    """The commands that are called, in this process and not in one of their own."""
    called: Commands = []

    def run(command: Sequence[str], log: Path) -> str:
        called.append(tuple(command))
        module, *words = command
        code = code_of(ENTRIES[module], [word for word in words if word != "trust=my_lab"])
        _, err = capfd.readouterr()
        return err.strip().splitlines()[-1].removeprefix("rgbt: ") if code else ""

    monkeypatch.setattr(external, "run_command", run)
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


@pytest.fixture
def runs_of(data: Path, tmp_path: Path) -> Runs:
    def run(*words: str, table: Table = TABLE, trust: str = "") -> dict[str, Outcome]:
        place = ("dataset=mfnet", f"dataset.root={data}", "data.num_workers=0")
        every = (*place, *SMALL, *words)
        given, extra = external_rows(every, table)
        request = TableRequest("my/t", table, "demo", (0,), tuple(extra), external=tuple(given))
        made = evaluate_external(request, ("tracking=none",), tmp_path / "runs", trust)
        assert {seed for _, seed in made} == {FIXED}
        return {label: outcome for (label, _), outcome in made.items()}

    return run


@pytest.mark.slow
@pytest.mark.parametrize("regions", ["as trained", "ring9", "vertical5"])
def test_predictions_have_the_counts_of_rgbt_score(
    call: Call,
    commands: Commands,
    runs_of: Runs,
    data: Path,
    predictions: Path,
    tmp_path: Path,
    regions: str,
) -> None:
    run = runs_of(f"predictions.CMNeXt={predictions}", table=replace(TABLE, regions=regions))
    (result,) = run["CMNeXt"].results
    file = "ring5" if regions == "as trained" else regions
    words = (f"predictions={predictions}", "dataset=mfnet", f"dataset.root={data}")
    shape = (f"regions={file[-1]}", "resamples=0")
    assert call(score_command.entry, *words, *shape, f"out={tmp_path / 'out'}")[0] == 0
    expected = Counts.load(tmp_path / "out" / f"counts_{file}.npz")
    cut = () if regions == "as trained" else (f"regions={regions}",)
    found = counts_of(result, cut)
    assert np.array_equal(found.counts, expected.counts)
    assert (found.dataset, found.partition) == (expected.dataset, file)
    assert run["CMNeXt"].missing == {
        (*cut, "corruption=removed:rgb"): external.NEEDS_NETWORK,
        ("frames=aligned",): external.NEEDS_PAIRS,
    }
    # Plain images first, with which others are compared.
    assert [command[0] for command in commands] == ["analysis.score"] * (1 + len(cut))


def test_weights_have_the_counts_of_their_training_run(
    trained: Trained, commands: Commands, runs_of: Runs
) -> None:
    run = trained(*ONE)
    outcome = runs_of(f"weights.MFNet={run / 'best.pt'}", trust="my_lab")["MFNet"]
    (found,), expected = outcome.results, RunResult(run).counts()
    assert np.array_equal(found.counts().counts, expected.counts)
    assert found.counts().dataset == expected.dataset
    without = counts_of(found, ("corruption=removed:rgb",))
    assert not np.array_equal(without.counts, expected.counts)
    assert without.partition == expected.partition == "ring5"
    pairs = counts_of(found, ("frames=aligned",))
    scored = score("my/1", TABLE, {("MFNet", 0): outcome}, scale="demo")
    mean = 100 * tc(frames(pairs.by_region()), "released").mean()
    assert scored.cells["MFNet", "TC"].mean == pytest.approx(mean)
    assert scored.cells["MFNet", "no RGB"].reason == ""
    assert stored_at(found, ("frames=released",)), "both protocols in one call"
    assert len(commands) == 3
    assert all("trust=my_lab" in command for command in commands)


@pytest.mark.slow
def test_predictions_of_exported_pairs_have_a_consistency(
    call: Call, commands: Commands, runs_of: Runs, trained: Trained, data: Path, tmp_path: Path
) -> None:
    run, pairs, folder = trained(*ONE), tmp_path / "pairs", tmp_path / "written"
    place = ("dataset=mfnet", f"dataset.root={data}")
    assert call(consistency.entry, f"export={pairs}", *place)[0] == 0
    assert call(predict.entry, f"run={run}", f"input={pairs}", f"out={folder}")[0] == 0
    shutil.copy(pairs / "pairs.json", folder)
    (found,) = runs_of(f"predictions.CMNeXt={folder}")["CMNeXt"].results
    (network,) = runs_of(f"weights.MFNet={run / 'best.pt'}")["MFNet"].results
    for words in ((), ("frames=aligned",)):
        mine, theirs = (counts_of(result, words).counts for result in (found, network))
        assert np.array_equal(mine, theirs)


def test_counts_are_made_once_unless_content_changes(
    commands: Commands, runs_of: Runs, predictions: Path, tmp_path: Path
) -> None:
    (first,) = runs_of(f"predictions.CMNeXt={predictions}")["CMNeXt"].results
    moved = predictions.rename(tmp_path / "moved")
    word = f"predictions.CMNeXt={moved}"
    (second,) = runs_of(word)["CMNeXt"].results
    assert (second.folder, len(commands)) == (first.folder, 1)
    cv2.imwrite(str(moved / "00201D.png"), np.zeros((48, 64), np.uint8))
    (third,) = runs_of(word)["CMNeXt"].results
    assert third.folder != first.folder
    assert len(commands) == 2


def test_interrupted_call_leaves_no_counts(
    commands: Commands, runs_of: Runs, predictions: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = external.run_command

    def interrupted(command: Sequence[str], log: Path) -> str:
        run(command, log)
        raise KeyboardInterrupt

    word = f"predictions.CMNeXt={predictions}"
    with monkeypatch.context() as patch:
        patch.setattr(external, "run_command", interrupted)
        with pytest.raises(KeyboardInterrupt):
            runs_of(word)
    assert not list((predictions.parent / "runs" / "external").rglob("*.npz"))
    assert runs_of(word)["CMNeXt"].state == "finished"


def test_weights_of_another_network_fail_once(
    trained: Trained, commands: Commands, runs_of: Runs
) -> None:
    with pytest.raises(InputError, match="row 'RTFNet': .*does not fit this network"):
        runs_of(f"weights.RTFNet={trained(*ONE) / 'best.pt'}")
    assert len(commands) == 1
