"""What rows request is composed once for the same files, and never read after one has changed."""

from __future__ import annotations

import shutil
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from rgbt.config.compose import OWN_FOLDERS, conf_dir
from rgbt.runs.run_spec import RunSpec
from sweeps.plan import row_cache
from sweeps.plan.planner import Planner, specify_run

WORDS = ("runs_dir=none", "+experiment=grbm", "scale=bench")
SECOND = 10**9


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """An empty cache, and a copy of conf/ that this process has known from its start."""
    copy = tmp_path / "conf"
    shutil.copytree(conf_dir(), copy)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(row_cache, "conf_dir", lambda: copy)
    started(monkeypatch)
    yield copy
    row_cache._digest_of_files.cache_clear()


def started(monkeypatch: pytest.MonkeyPatch) -> None:
    """Begin another process, so to say."""
    monkeypatch.setattr(row_cache, "STARTED", time.time_ns() + SECOND)
    row_cache._digest_of_files.cache_clear()


def composed() -> RunSpec:
    return specify_run(WORDS, checked=False)


def refuse() -> RunSpec:
    raise AssertionError("it is stored")


def files(tmp_path: Path) -> list[Path]:
    return list(tmp_path.glob("cache/rgbt/rows/*/*.json"))


def test_a_stored_specification_is_the_composed_one(folder: Path) -> None:
    fresh = row_cache.requested(WORDS, composed)
    again = row_cache.requested(WORDS, refuse)
    assert len(again.dependencies) == 1  # the start of its network
    assert (again.plain, again.overrides, again.fresh) == (fresh.plain, fresh.overrides, False)
    for seed in (0, 3):
        assert again.with_seed(seed).key == fresh.with_seed(seed).key
        assert Planner().specify((*WORDS, f"seed={seed}"), checked=False).key == (
            specify_run((*WORDS, f"seed={seed}")).key
        )


def test_a_changed_file_gives_no_old_answer(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert row_cache.size(WORDS, lambda: 1.5) == row_cache.size(WORDS, lambda: 2.5) == 1.5
    file = folder / "masker" / "none.yaml"
    text = file.read_text()
    file.write_text(f"{text[:-1]} ")  # of the same size
    started(monkeypatch)
    assert row_cache.size(WORDS, lambda: 2.5) == 2.5
    file.write_text(text)
    started(monkeypatch)
    assert row_cache.size(WORDS, lambda: 3.5) == 1.5
    assert len(files(tmp_path)) == 2


def test_nothing_is_stored_of_files_that_changed_meanwhile(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def changed() -> float:
        monkeypatch.setattr(row_cache, "STARTED", time.time_ns() - 60 * SECOND)
        return 1.5

    assert row_cache.size(WORDS, changed) == 1.5
    assert files(tmp_path) == []
    row_cache._digest_of_files.cache_clear()
    assert row_cache.size(WORDS, lambda: 2.5) == 2.5
    assert files(tmp_path) == []


def test_what_depends_on_files_of_the_user_is_not_stored(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for word in ("hydra.searchpath=[mine]", "model.checkout=mine", "model._target_=mine.Network"):
        row_cache.size((*WORDS, word), lambda: 1.5)
    monkeypatch.setenv(OWN_FOLDERS, "mine")
    row_cache.size(WORDS, lambda: 1.5)
    assert files(tmp_path) == []


def test_a_damaged_file_is_written_again(folder: Path, tmp_path: Path) -> None:
    row_cache.size(WORDS, lambda: 1.5)
    (file,) = files(tmp_path)
    file.write_text(file.read_text().replace("1.5", "9.5"))
    assert row_cache.size(WORDS, lambda: 1.5) == 1.5
    assert row_cache.size(WORDS, lambda: 2.5) == 1.5


def test_what_json_would_change_is_not_stored(folder: Path, tmp_path: Path) -> None:
    plain = {"ids": {1: 2}}
    spec = row_cache.requested(WORDS, lambda: RunSpec(plain=plain))
    assert spec.plain == plain
    assert files(tmp_path) == []
