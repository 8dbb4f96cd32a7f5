"""Archived runs: unpacked they are equal, and their command still asks for them."""

from __future__ import annotations

import shutil
import zipfile
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from omegaconf import OmegaConf

from analysis.archive import add, archived, entry, key_of, unpack
from rgbt.checks import InputError
from rgbt.files.plain_files import write_json
from rgbt.metrics.counts import Counts
from rgbt.runs.folder import RunFolder
from rgbt.runs.naming import describe
from rgbt.runs.result import RunResult
from tests.analysis.counts import counts_of
from tests.analysis.robust_runs import SCORES, write_levels
from tests.commands import Call
from tests.composed import specified

WORDS = ("+experiment=crm", "+debug=smoke")


def some(seed: int, **changed: object) -> Counts:
    return counts_of(np.random.default_rng(seed).integers(0, 900, (12, 5, 4, 4)), **changed)


PAIRS = counts_of(np.random.default_rng(9).integers(0, 9, (12, 15, 4, 4)), partition="aligned3")


# No table reads these.
NOT_ARCHIVED = ("counts_test_source_head.npz", "counts_val.npz", "evaluations/val_rgb.npz")


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> RunResult:
    """A finished run folder without weights, as a training writes it, and its archive."""
    root = tmp_path_factory.mktemp("made")
    spec = specified((*WORDS, f"runs_dir={root}/runs"))
    folder = RunFolder(spec.folder)
    folder.write_config(OmegaConf.to_yaml(OmegaConf.create(dict(spec.plain))))
    folder.describe(describe(spec))
    folder.add_provenance({"git_commit": "a" * 40, "cwd": "/home/me", "packages": {"torch": "2"}})
    some(0, run=spec.key).save(folder.path / "counts_test.npz")
    some(0, run=spec.key).save(folder.path / "counts_test_source_head.npz")
    (folder.path / "evaluations").mkdir()
    for name in NOT_ARCHIVED[1:]:
        some(0, run=spec.key, split="val").save(folder.path / name)
    replace(some(1), night=(True, False) * 6).save(folder.path / "evaluations/test_rgb.npz")
    PAIRS.save(folder.path / "evaluations/consistency_aligned_test.npz")
    write_levels(folder.path / "evaluations/robustness/test", SCORES)
    folder.finish({"key": spec.key, "dataset": "abc", "test": {"mIoU": 0.5}})
    add(RunResult(folder.path), root / "results")
    return RunResult(folder.path)


@pytest.fixture
def run(made: RunResult, tmp_path: Path) -> RunResult:
    """A copy in ``runs/``; its archive is in ``results/``."""
    shutil.copytree(made.folder.parents[1] / "results", tmp_path / "results")
    return RunResult(Path(shutil.copytree(made.folder, tmp_path / "runs" / made.key)))


def archived_in(folder: Path) -> Path:
    (path,) = archived(folder / "results")
    return path


def test_unpacked_run_has_equal_counts(run: RunResult, tmp_path: Path) -> None:
    unpacked = unpack(archived_in(tmp_path), tmp_path / "unpacked")
    paths = [path for end in ("npz", "json") for path in sorted(run.folder.rglob(f"*.{end}"))]
    names = {path.relative_to(run.folder).as_posix() for path in paths} - {*NOT_ARCHIVED}
    assert names == {
        path.relative_to(unpacked.folder).as_posix()
        for path in unpacked.folder.rglob("*.*")
        if path.suffix in (".npz", ".json")
    }
    for name in (each for each in names if each.endswith(".npz")):
        path = run.folder / name
        first, again = Counts.load(path), unpacked.counts(name)
        assert np.array_equal(first.counts, again.counts)
        assert first.counts.dtype == again.counts.dtype
        others = [field.name for field in fields(Counts) if field.name != "counts"]
        assert [getattr(first, each) for each in others] == [getattr(again, e) for e in others]
    assert (unpacked.key, unpacked.commit) == (run.key, "a" * 10)
    assert unpacked.recorded_scores() == run.recorded_scores()
    assert unpacked.description == replace(run.description, params={})
    assert unpacked.lists == "trained on train, selected on val"
    assert "cwd" not in unpacked.provenance[0]


def test_same_results_are_one_file_and_others_are_kept(run: RunResult, tmp_path: Path) -> None:
    archive = tmp_path / "results"
    own = run.folder / "counts_test.npz"
    assert add(run, archive) == add(run, archive)
    first = own.read_bytes()
    further = ("evaluations/a.npz", "evaluations/b.npz")
    for name in further:  # of two machines
        (run.folder / name).write_bytes(first)
        assert add(run, archive) == archive / f"{run.key}.zip"
        (run.folder / name).unlink()
    whole = unpack(archive / f"{run.key}.zip", tmp_path / "unpacked").folder
    assert all((whole / name).is_file() for name in further)
    some(2, run=run.key).save(run.folder / "counts_test.npz")
    other = add(run, archive)
    assert key_of(other) == run.key
    assert unpack(other, tmp_path / "unpacked").counts().run == run.key
    assert archived(archive) == [archive / f"{run.key}.zip", other]  # the first is read


def test_images_are_stored_once_for_all_runs(run: RunResult, tmp_path: Path) -> None:
    wrong = some(0).counts.copy()
    wrong[..., 0, 1] += 1  # another prediction of a pixel with the same label
    wrong[..., 0, 0] -= 1
    before = len(list((tmp_path / "results/shared").iterdir()))
    replace(some(0), counts=wrong).save(run.folder / "counts_test.npz")
    wrong = PAIRS.counts.copy()
    wrong[:, 1, 3, 2] += wrong[:, 1, 1, 1]  # of pixels with label 1 in both frames
    wrong[:, 1, 1, 1] = 0
    replace(PAIRS, counts=wrong).save(run.folder / "evaluations/consistency_aligned_test.npz")
    add(run, tmp_path / "results")
    assert len(list((tmp_path / "results/shared").iterdir())) == before == 5


@pytest.mark.parametrize("damage", [0, -1, "shared", "/tmp/outside.txt", "../outside.txt"])
def test_damaged_archive_is_refused(run: RunResult, tmp_path: Path, damage: int | str) -> None:
    path = archived_in(tmp_path)
    shared, other = sorted((tmp_path / "results/shared").iterdir())[:2]
    if isinstance(damage, int):
        with zipfile.ZipFile(path) as archive:
            member = archive.infolist()[damage]
        content = bytearray(path.read_bytes())
        # Within the member, which follows a header of 30 bytes and its name.
        content[member.header_offset + 30 + len(member.filename) + member.compress_size // 2] ^= 255
        path.write_bytes(content)
    elif damage == "shared":  # arrays of other images
        shared.write_bytes(other.read_bytes())
    else:
        with zipfile.ZipFile(path, "a") as archive:
            archive.writestr(damage, "x")
    word = "damaged .*does not match its digest" if damage == "shared" else "damaged"
    with pytest.raises(InputError, match=word):
        unpack(path, tmp_path / "unpacked")
    assert list((tmp_path / "unpacked").iterdir()) == []
    assert not (tmp_path / "outside.txt").exists()


def test_archive_of_another_run_is_refused(run: RunResult, tmp_path: Path) -> None:
    path = archived_in(tmp_path)
    path.rename(path.with_name("0123456789ab.zip"))
    with pytest.raises(InputError, match=f"holds the run {run.key}"):
        unpack(path.with_name("0123456789ab.zip"), tmp_path / "unpacked")
    (run.folder / "result.json").unlink()
    with pytest.raises(InputError, match="is not finished"):
        add(run, tmp_path / "results")


def write_settings(run: RunResult, **changed: object) -> None:
    """Give a run the settings of its command, with changes of its masker, and another key."""
    plain = dict(specified(WORDS).plain)
    removed = [name for name, value in changed.items() if value is None]
    masker = {**plain["masker"], **changed}
    plain["masker"] = {name: masker[name] for name in masker if name not in removed}
    (run.folder / "config.yaml").write_text(OmegaConf.to_yaml(OmegaConf.create(plain)))


@pytest.mark.parametrize(
    ("changed", "state", "reason"),
    [
        ({"sampler": None}, "added", "masker.sampler"),
        ({"sampler": "bernoulli"}, "changed", "masker.sampler"),
        ({}, "changed", "a run that it depends on"),
    ],
)
def test_check_reports_changed_keys(
    call: Call, run: RunResult, tmp_path: Path, changed: dict[str, object], state: str, reason: str
) -> None:
    archive = tmp_path / "other"
    folder = run.folder.rename(run.folder.with_name("0123456789ab"))
    write_settings(RunResult(folder), **changed)
    some(0, run="0123456789ab").save(folder / "counts_test.npz")
    write_json(folder / "result.json", {"dataset": "abc"})
    add(RunResult(folder), archive)
    code, out, _ = call(entry, "check", f"archive={archive}")
    assert code == 1
    assert state in out
    assert reason in out
    assert call(entry, "rekey", f"archive={archive}")[0] == 0
    (only,) = archived(archive)
    assert only.stem == (run.key if state == "added" else "0123456789ab")
    assert unpack(only, tmp_path / "unpacked").counts().run == only.stem
    assert call(entry, "check", f"archive={archive}")[0] == (0 if state == "added" else 1)


def test_command_adds_all_finished_runs(call: Call, run: RunResult, tmp_path: Path) -> None:
    archive = tmp_path / "new"
    words = (f"runs_dir={run.folder.parent}", f"archive={archive}")
    assert call(entry, "add", "run=all", *words)[0] == 0
    assert [each.stem for each in archived(archive)] == [run.key]
    code, out, err = call(entry, "check", f"archive={archive}")
    assert (code, err) == (0, "")
    assert "1 runs, 1 have the key of their command" in out
