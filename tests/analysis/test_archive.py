"""Archived runs: unpacked they are equal, and their command still asks for them."""

from __future__ import annotations

import lzma
import re
import shutil
import zipfile
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from omegaconf import OmegaConf

from analysis import packing
from analysis.archive import _compared, add, archived, entry, key_of, unpack
from rgbt.checks import InputError
from rgbt.files.plain_files import write_json
from rgbt.metrics import measurement
from rgbt.metrics.counts import Counts
from rgbt.runs.folder import RunFolder, read_result
from rgbt.runs.naming import describe
from rgbt.runs.result import RunResult, check_result
from tests.analysis.counts import counts_of, result_of
from tests.analysis.robust_runs import SCORES, measured
from tests.commands import Call
from tests.composed import specified
from tests.measured import remeasured, store

WORDS = ("+experiment=crm", "+debug=smoke")


DATA = "abc"
LABELLED = 3600  # pixels of every label in every region and image


def some(seed: int, **changed: object) -> Counts:
    """Counts of one set of labels, with predictions of their own."""
    counts = np.random.default_rng(seed).integers(0, 900, (12, 5, 4, 4))
    counts[..., 3] = LABELLED - counts[..., :3].sum(-1)
    return counts_of(counts, **{"dataset": DATA, **changed})


PAIRS = counts_of(np.random.default_rng(9).integers(0, 9, (12, 15, 4, 4)), partition="aligned3")


# No table reads these.
NOT_ARCHIVED = ("counts_val.npz", "evaluations/val_rgb.npz")


def finish(folder: Path, counts: Counts) -> None:
    """Write the counts of a run, and the result that they give."""
    counts.save(folder / "counts_test.npz")
    RunFolder(folder).finish(result_of(folder.name, counts))


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> RunResult:
    """A finished run folder without weights, as a training writes it, and its archive."""
    root = tmp_path_factory.mktemp("made")
    spec = specified((*WORDS, f"runs_dir={root}/runs"))
    folder = RunFolder(spec.folder)
    folder.write_config(OmegaConf.to_yaml(OmegaConf.create(dict(spec.plain))))
    folder.describe(describe(spec))
    folder.add_provenance({"git_commit": "a" * 40, "cwd": "/home/me", "packages": {"torch": "2"}})
    store(folder.path, some(0), split="val")
    store(folder.path, some(0), split="val", view="rgb")
    store(folder.path, some(1), view="rgb")
    store(folder.path, PAIRS)
    for counts, fields_ in measured(SCORES):
        if fields_:
            store(folder.path, counts, **fields_)
    finish(folder.path, some(0, run=spec.key))
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
    for name in names:
        if not name.endswith(".npz"):
            continue
        path = run.folder / name
        first, again = Counts.load(path), unpacked.counts(name)
        assert np.array_equal(first.counts, again.counts)
        assert first.counts.dtype == again.counts.dtype
        others = [field.name for field in fields(Counts) if field.name != "counts"]
        assert [getattr(first, field) for field in others] == [
            getattr(again, field) for field in others
        ]
        assert first.measurement.to_json() == again.measurement.to_json()
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
    finish(run.folder, some(2, run=run.key))
    other = add(run, archive)
    assert key_of(other) == run.key
    assert unpack(other, tmp_path / "unpacked").counts().measurement.run == run.key
    assert archived(archive) == [archive / f"{run.key}.zip", other]  # the first is read


@pytest.mark.parametrize("name", ["rgb", "aligned3"])
def test_one_pixel_of_any_counts_makes_other_results(
    run: RunResult, tmp_path: Path, name: str
) -> None:
    """Predicted as the class 1 instead of 0. The counts of the run's own test stay the same."""
    path = run.folder / f"evaluations/test_{name}.npz"
    stored = Counts.load(path)
    counts = stored.counts.copy()
    counts[0, 0, 1] += [-1, 1] + [0] * (counts.shape[-1] - 2)
    replace(stored, counts=counts).save(path)
    first = archived_in(tmp_path)
    other = add(run, tmp_path / "results")
    assert archived(tmp_path / "results") == [first, other]
    changed, unpacked = f"evaluations/{path.name}", tmp_path / "unpacked"
    for file, expected in ((first, stored.counts), (other, counts)):
        assert np.array_equal(unpack(file, unpacked).counts(changed).counts, expected)


def test_images_are_stored_once_for_all_runs(run: RunResult, tmp_path: Path) -> None:
    wrong = some(0).counts.copy()
    wrong[..., 0, 1] += 1  # another prediction of a pixel with the same label
    wrong[..., 0, 3] -= 1
    before = len(list((tmp_path / "results/shared").iterdir()))
    finish(run.folder, replace(some(0), counts=wrong))
    wrong = PAIRS.counts.copy()
    wrong[:, 1, 3, 2] += wrong[:, 1, 1, 1]  # of pixels with label 1 in both frames
    wrong[:, 1, 1, 1] = 0
    store(run.folder, replace(PAIRS, counts=wrong))
    add(run, tmp_path / "results")
    assert len(list((tmp_path / "results/shared").iterdir())) == before == 4


@pytest.mark.parametrize("damage", [0, -1, "shared", "/tmp/outside.txt", "../outside.txt"])
def test_damaged_archive_is_refused(run: RunResult, tmp_path: Path, damage: int | str) -> None:
    path = archived_in(tmp_path)
    shared, other = sorted((tmp_path / "results/shared").glob("*.npz.xz"))[:2]
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


def test_archive_that_fills_the_memory_is_refused(
    run: RunResult, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = archived_in(tmp_path)
    with zipfile.ZipFile(path) as members:
        total = sum(member.file_size for member in members.infolist())
    for most in (total - 1, total):  # members; texts, which are longer
        monkeypatch.setattr(packing, "MOST", most)
        with pytest.raises(InputError, match=f"damaged .it unpacks to more than {most} bytes"):
            unpack(path, tmp_path / "unpacked")
    assert packing._decompressed(lzma.compress(bytes(total))) == bytes(total)
    with pytest.raises(ValueError, match="unpacks to more"):
        packing._decompressed(lzma.compress(bytes(total + 1)))


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
    for path in folder.rglob("*.npz"):
        remeasured(Counts.load(path), run=folder.name).save(path)
    finish(folder, some(0, run=folder.name))
    add(RunResult(folder), archive)
    code, out, _ = call(entry, "check", f"archive={archive}")
    assert code == 1
    assert state in out
    assert reason in out
    assert call(entry, "rekey", f"archive={archive}")[0] == 0
    (only,) = archived(archive)
    assert only.stem == (run.key if state == "added" else "0123456789ab")
    unpacked = unpack(only, tmp_path / "unpacked").measurements()
    assert {of.run for of in unpacked.values()} == {only.stem}
    assert len(unpacked) == 7
    assert call(entry, "check", f"archive={archive}")[0] == (0 if state == "added" else 1)


def test_settings_of_the_trainer_without_a_name_today_change_nothing(
    run: RunResult, tmp_path: Path
) -> None:
    plain = dict(specified(WORDS).plain)
    plain["trainer"] = {**plain["trainer"], "saved_every": 3}
    (run.folder / "config.yaml").write_text(OmegaConf.to_yaml(OmegaConf.create(plain)))
    add(run, tmp_path)
    assert [(state, why) for _, state, why, _ in _compared(tmp_path)] == [("same", "")]


def test_command_adds_all_finished_runs(call: Call, run: RunResult, tmp_path: Path) -> None:
    archive = tmp_path / "new"
    words = (f"runs_dir={run.folder.parent}", f"archive={archive}")
    assert call(entry, "add", "run=all", *words)[0] == 0
    assert [path.stem for path in archived(archive)] == [run.key]
    code, out, err = call(entry, "check", f"archive={archive}")
    assert (code, err.strip()) == (0, "")
    assert "1 runs, 1 have the scores of their counts and today's key" in out


def moved_pixel() -> Counts:
    """`some(0)` with one wrong pixel more; every label has as many pixels."""
    counts = some(0).counts.copy()
    counts[0, 0, 1, 1] -= 1
    counts[0, 0, 1, 2] += 1
    return replace(some(0), counts=counts)


def below_zero() -> Counts:
    counts = some(0).counts.copy()
    counts[0, 0, 0, 0] = -2_130_706_432
    return replace(some(0), counts=counts)


def other_label() -> Counts:
    """`some(0)` with a pixel of another label."""
    counts = some(0).counts.copy()
    counts[0, 0, :2, 0] += [1, -1]
    return replace(some(0), counts=counts)


CODES = "\x1b[31m<script>alert(1)</script>"
# What was changed -> the file with other counts, and the message.
TAMPERED: dict[str, tuple[str, Callable[[], Counts], str]] = {
    "below_zero": ("counts_test.npz", below_zero, "-2130706432"),
    "too_many": (
        "counts_test.npz",
        lambda: replace(some(0), counts=some(0).counts << 40),
        "numbers of",
    ),
    "another_count": ("counts_test.npz", moved_pixel, "but its counts give"),
    "other_images": ("counts_test.npz", lambda: some(0, dataset="d"), "other images than the run"),
    "other_names": (
        *("evaluations/test_rgb.npz", lambda: some(1, names=tuple("abcdefghijkl"))),
        "other images than counts_test",
    ),
    "other_labels": ("evaluations/test_rgb.npz", other_label, "other labels than counts_test"),
    "other_regions": ("counts_test.npz", lambda: some(0, partition="vertical5"), "of vertical5"),
    "fewer_regions": ("counts_test.npz", lambda: some(0, partition="ring9"), "expected 9 rows"),
    "markup": ("counts_test.npz", lambda: some(0, partition=CODES[1:]), "letters, digits"),
    "codes": ("counts_test.npz", lambda: some(0, partition=f"ring5{CODES}"), "has control"),
    "codes_of_split": ("counts_test.npz", lambda: some(0, split=CODES), "has control"),
    "codes_of_title": ("evaluations/test_rgb.npz", lambda: some(1, title=CODES), "has control"),
    "codes_of_class": (
        *("counts_test.npz", lambda: some(0, classes=(CODES, "b", "c", "d"))),
        "without control",
    ),
}


def skipped() -> Counts:
    return some(1).select(some(1).names[1:])


def at_another_size() -> Counts:
    return replace(some(1), counts=some(1).counts * 4)


# What evaluations of the same run may write beside its counts.
FITTING: dict[str, tuple[str, Callable[[], Counts]]] = {
    "unreadable image": ("evaluations/test_rgb.npz", skipped),
    "counted at another size": ("evaluations/test_rgb.npz", at_another_size),
    "files that changed later": ("counts_val.npz", lambda: some(1, split="val", dataset="before")),
    "name of a split": ("evaluations/night rain.npz", lambda: some(1, split="night rain")),
    "other regions": ("evaluations/test_rgb_ring9.npz", lambda: some(1, partition="own")),
}


@pytest.mark.parametrize("kind", FITTING)
def test_what_evaluations_write_is_read(run: RunResult, kind: str) -> None:
    file, counts = FITTING[kind]
    counts().save(run.folder / file)
    assert run.counts(file).counts.sum() == counts().counts.sum()
    check_result(run)


def test_names_of_images_may_have_any_space(tmp_path: Path) -> None:
    names = tuple(f"shot {n}\u202fPM\u3000\u200d" for n in range(12))
    some(0, names=names).save(tmp_path / "a.npz")
    assert Counts.load(tmp_path / "a.npz").names == names


def test_rows_that_pairs_cannot_have_are_refused(run: RunResult) -> None:
    odd = replace(some(0), counts=some(0).counts[:, :4])
    store(run.folder, odd, partition="aligned3")
    with pytest.raises(InputError, match="other rows than aligned3"):
        check_result(run)


@pytest.mark.parametrize("kind", [*TAMPERED, "no_key", "score", "no_score", "settings"])
def test_changed_numbers_are_no_result(
    call: Call, run: RunResult, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str
) -> None:
    file, counts, message = TAMPERED.get(kind, ("", PAIRS, ""))
    result = read_result(run.folder) or {}
    if file:
        counts().save(run.folder / file)
    elif kind == "settings":
        write_settings(run, sampler="bernoulli")
        message = "masker.sampler"
    else:
        scores = {"score": {"mIoU": 0.99}, "no_score": {"Var": None}}.get(kind, {})
        changed = {**result, "test": {**result["test"], **scores}}
        write_json(
            run.folder / "result.json",
            {name: value for name, value in changed.items() if (kind, name) != ("no_key", "key")},
        )
        message = "names no run" if kind == "no_key" else "but its counts give"
    if kind != "settings":
        with pytest.raises(InputError, match=re.escape(message)):
            check_result(run)
        with pytest.raises(InputError):
            add(run, tmp_path / "other")
    with monkeypatch.context() as patch:  # a stranger packs without our checks
        patch.setattr(Counts, "check", lambda _: None)
        patch.setattr(measurement, "CONTROL", re.compile("(?!)"))
        patch.setattr("analysis.archive.check_result", lambda _: None)
        add(run, tmp_path / "other")
    code, out, _ = call(entry, "check", f"archive={tmp_path / 'other'}")
    assert (code, "damaged" in out or kind == "settings", " same " in out) == (1, True, False)
    assert message.split()[-1] in out
    assert not {"\x1b", "<script>"} & {word for word in ("\x1b", "<script>") if word in out}
    if file == "counts_test.npz" and kind != "another_count" and kind != "other_regions":
        with pytest.raises(InputError):  # refused where it is read, as by a report
            run.counts()
