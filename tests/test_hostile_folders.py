"""A run folder of a stranger: links out of it and pipes are refused, nothing outside changes."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import pytest

import rgbt
from analysis.results import finished_runs, open_counts
from rgbt import consistency, evaluate, predict, robustness
from rgbt.checks import InputError
from rgbt.config.compose import compose, resolved
from rgbt.files.atomic import holding, is_held, write_atomic
from rgbt.files.plain_files import check_links
from rgbt.files.yaml_files import read_yaml
from rgbt.runs.folder import RunFolder, find_run, read_result, runs_in
from rgbt.runs.result import RunResult
from rgbt.runs.specify import load_spec
from tests.commands import Call, Trained, short, train

ONE = ("+experiment=crm", *short(1))
SECRET = "secret: hunter2\n"

LINKS = (
    *("config.yaml", "result.json", "run.json", "metrics.jsonl", "lock", "best.pt", "last.pt"),
    *("counts_test.npz", "tables.json", "dataset.json", "checkpoints", "evaluations", "figures"),
)


@pytest.fixture
def victim(tmp_path: Path) -> Path:
    """A folder of the user, with files whose names a run folder has."""
    place = tmp_path / "victim"
    (place / "3").mkdir(parents=True)
    for name in ("secret", "3/work.txt", ".notes.json.98", "last.pt"):
        (place / name).write_text(SECRET)
        os.utime(place / name, (0, 0))
    return place


@pytest.fixture
def hostile(trained: Trained, tmp_path: Path) -> Path:
    done = trained(*ONE)
    shutil.copytree(done, tmp_path / "runs" / done.name)
    return tmp_path / "runs" / done.name


def replace_by_link(path: Path, victim: Path) -> None:
    target = victim if not path.suffix and path.name != "lock" else victim / "secret"
    shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)
    path.symlink_to(target)


def state(place: Path) -> dict[Path, tuple[str, float]]:
    files = (path for path in place.rglob("*") if path.is_file())
    return {path: (path.read_text(), path.stat().st_mtime) for path in files}


def found_by_key(folder: Path) -> Path:
    return find_run(folder.name, folder.parent)


@pytest.mark.parametrize("name", LINKS)
def test_a_link_out_of_a_run_folder_is_refused(hostile: Path, victim: Path, name: str) -> None:
    replace_by_link(hostile / name, victim)
    before = state(victim)
    for use in (RunFolder, RunResult, rgbt.load_run, check_links, found_by_key):
        with pytest.raises(InputError, match=f"{name} is a link that leads out") as refused:
            use(hostile)
        assert "hunter2" not in str(refused.value)
    with pytest.raises(InputError):
        open_counts(str(hostile))
    assert state(victim) == before


@pytest.mark.parametrize("name", ["config.yaml", "lock", "checkpoints", "evaluations", "last.pt"])
def test_commands_on_a_hostile_folder_change_nothing_outside(
    call: Call, data: Path, hostile: Path, victim: Path, tmp_path: Path, name: str
) -> None:
    replace_by_link(hostile / name, victim)
    before = state(victim)
    for entry in (evaluate.entry, consistency.entry, robustness.entry, predict.entry):
        more = ("input=test", f"out={tmp_path / 'out'}") if entry is predict.entry else ()
        code, out, err = call(entry, f"run={hostile}", *more)
        assert (code, f"{name} is a link that leads out" in err) == (2, True), err
        assert "hunter2" not in out + err
    (hostile / "result.json").unlink()
    code, _, err = train(call, data, hostile.parent, *ONE)
    assert (code, f"{name} is a link" in err) == (2, True), err
    assert state(victim) == before


def test_hostile_run_is_left_out_of_its_folder(
    hostile: Path, victim: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (hostile / "copy.npz").symlink_to(hostile / "counts_test.npz")
    assert RunResult(hostile).counts("copy.npz").split == "test", "links inside are followed"
    (hostile / "copy.npz").unlink()
    shutil.copytree(hostile, hostile.with_name("fine"))
    replace_by_link(hostile / "config.yaml", victim)
    assert [run.path.name for run in runs_in(hostile.parent)] == ["fine"]
    assert [run.key for run in finished_runs(hostile.parent, victim)] == ["fine"]
    assert "is left out" in capsys.readouterr().err


def test_files_read_alone_are_not_followed_out(tmp_path: Path, victim: Path) -> None:
    folder = tmp_path / "own"
    folder.mkdir()
    replace_by_link(folder / "result.json", victim)
    with pytest.raises(InputError, match="leads out"):
        read_result(folder)
    replace_by_link(folder / "lock", victim)
    with pytest.raises(OSError, match="lock"), holding(folder / "lock"):
        pass
    replace_by_link(folder / f".new.json.{os.getpid()}", victim)
    before = state(victim)
    write_atomic(folder / "new.json", b"{}")
    assert state(victim) == before


@pytest.mark.parametrize("name", ["config.yaml", "result.json", "lock", "counts_val.npz"])
def test_pipe_in_place_of_file_is_refused_at_once(hostile: Path, name: str) -> None:
    (hostile / name).unlink(missing_ok=True)
    os.mkfifo(hostile / name)
    for use in (RunFolder, RunResult):
        with pytest.raises(InputError, match=f"{name} is not a regular file"):
            use(hostile)
    assert not is_held(hostile / name)
    with pytest.raises(InputError, match="not a regular file"):
        read_yaml(hostile / name)


def test_a_stored_configuration_names_no_folder_to_write_into(
    tmp_path: Path,
    victim: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "own"))
    sizes = [f"dataset.num_{split}=1" for split in ("train", "val", "test")]
    sizes += ["dataset.height=48", "dataset.width=64", "dataset.num_classes=9"]
    settings = resolved(compose(["+experiment=crm", "scale=demo", "tracking=none", *sizes]))
    settings["dataset"] |= {"cache_dir": str(victim), "name": "../../victim/x"}
    settings["data"]["cache"] = str(victim / "decoded")
    settings["runs_dir"] = settings["out"] = str(victim / "runs")
    inner = {**settings["dataset"], "name": "inner"}
    settings["transform"] = {key: inner[key] for key in inner if key != "absent"}
    before, spec = state(victim), load_spec(settings)
    for part in spec.build("dataset", "transform").values():
        assert part.root.parent == tmp_path / "own" / "rgbt"
    assert state(victim) == before
    assert capsys.readouterr().err.count("of the stored configuration is not used") == 3
    typed = load_spec(settings, [f"dataset.cache_dir={tmp_path / 'typed'}", "data.cache=auto"])
    assert typed.dataset.plain["cache_dir"] == str(tmp_path / "typed")
    assert (typed.data.cache, spec.data.cache) == ("auto", None)


def test_images_are_written_inside_the_folder_that_is_named(
    call: Call, data: Path, trained: Trained, tmp_path: Path
) -> None:
    """A line of a list may begin with "../", as long as the image is in the data set."""
    stranger = Path(shutil.copytree(data, tmp_path / "in" / "stranger"))
    name = (stranger / "test.txt").read_text().split()[0]
    (stranger / "test.txt").write_text(f"../../stranger/images/{name}\n")
    run, out = trained(*ONE), tmp_path / "x" / "out"
    words = (f"run={run}", f"dataset.root={stranger}", "input=test", f"out={out}")
    code, _, err = call(predict.entry, *words)
    assert (code, "leads out of" in err) == (2, True), err
    assert not (tmp_path / "stranger").exists()


def test_a_file_that_another_process_removes_is_no_pipe(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A checkpoint of a run that continues: it was there when the folder was listed."""
    monkeypatch.setattr(os, "walk", lambda folder: [(str(folder), [], ["next_5"])])
    monkeypatch.setattr(Path, "exists", lambda _: True)  # and a moment later, but then not
    check_links(tmp_path)
