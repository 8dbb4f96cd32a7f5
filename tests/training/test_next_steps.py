"""The end of a run names commands that work as pasted into the shell that started it."""

from __future__ import annotations

import os
import re
import shlex
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from rgbt.metrics.counts import Counts
from rgbt.runs.folder import RunFolder
from rgbt.runs.naming import describe
from rgbt.runs.run_spec import RunSpec
from rgbt.terminal import shell_command
from rgbt.training.next_steps import next_steps
from sweeps.plan.planner import specify_run
from tests.measured import measurement

run_folder = partial(RunFolder, writes=False)

SMOKE = ("+debug=smoke", "trainer.accelerator=cpu", "dataset.num_test=12")
SCRIPT = Path(sys.executable).parent / "rgbt"


@pytest.fixture
def inactive(monkeypatch: pytest.MonkeyPatch) -> None:
    """A shell that does not find rgbt."""
    monkeypatch.setenv("PATH", "/usr/bin:/bin")


def test_command_is_short_where_the_shell_finds_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PATH", f"{SCRIPT.parent}:/usr/bin")
    monkeypatch.setenv("PWD", str(tmp_path))
    assert shell_command("ui", "runs_dir=my runs") == "rgbt ui 'runs_dir=my runs'"
    other = tmp_path / "rgbt"  # of another environment
    other.write_text("#!/bin/sh\n")
    other.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:{SCRIPT.parent}")
    assert shell_command("ui") == f"{shlex.quote(str(SCRIPT))} ui"


@pytest.mark.usefixtures("inactive")
def test_command_is_a_path_where_the_shell_does_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    binaries = tmp_path / "my env" / "bin"
    binaries.mkdir(parents=True)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PWD", str(tmp_path))
    monkeypatch.setattr(sys, "executable", str(binaries / "python"))
    assert shell_command("ui") == "'my env/bin/python' -m rgbt ui"  # not installed
    (binaries / "rgbt").touch()
    assert shell_command("ui") == "'my env/bin/rgbt' ui"
    monkeypatch.setenv("PWD", "/nowhere")
    assert shell_command("ui") == shlex.join([str(binaries / "rgbt"), "ui"])


def test_other_method_has_the_words_of_the_same_images_alone() -> None:
    words = ("+experiment=grbm", "masker.sigma_div=2", "dataset.num_train=9", "seed=3")
    run = specify_run((*words, "runs_dir=my runs", "tracking=none"), checked=False)
    steps = dict(next_steps(run, run_folder(run.folder)))
    expected = ["+experiment=baseline", "dataset.num_train=9", "seed=3", "runs_dir=my runs"]
    assert shlex.split(steps["compare with"])[-5:] == [*expected, "tracking=none"]
    assert "look at" not in steps, "there is no picture"
    baseline = specify_run(("+experiment=baseline",), checked=False)
    assert (
        "+experiment=crm" in dict(next_steps(baseline, run_folder(baseline.folder)))["compare with"]
    )


def test_password_of_the_store_is_not_printed() -> None:
    words = (
        "+experiment=grbm",
        "++trainer.max_steps=9",
        "tracking.uri=postgresql://me:secret@host/x",
    )
    run = specify_run(words, checked=False)
    steps = dict(next_steps(run, run_folder(run.folder)))
    assert shlex.split(steps["compare with"])[-2:] == [
        "++trainer.max_steps=9",
        "tracking.uri=postgresql://me:***@host/x",
    ]
    assert "secret" not in "".join(steps.values())


def test_run_to_compare_with_has_the_same_images_and_another_method(tmp_path: Path) -> None:
    def finished(*words: str) -> RunSpec:
        run = specify_run((*words, f"runs_dir={tmp_path}"), checked=False)
        run.folder.mkdir()
        folder = RunFolder(run.folder)
        folder.describe(describe(run))
        folder.write_config(yaml.safe_dump(run.plain))
        (run.folder / "result.json").touch()
        return run

    run = finished("+experiment=grbm")
    finished("+experiment=grbm", "seed=1")
    finished("+experiment=baseline", "dataset.num_test=12")
    finished("+experiment=baseline", "dataset.splits.train=val", "dataset=mfnet", "dataset.root=x")
    finished("+experiment=baseline", "trainer.max_steps=2")
    (finished("+experiment=baseline").folder / "config.yaml").unlink()  # damaged
    assert "compare" not in dict(next_steps(run, run_folder(run.folder)))
    finished("+experiment=baseline", "seed=1")
    other = finished("+experiment=crm")
    finished("+experiment=baseline", "seed=2")  # newer, and of another seed
    command = dict(next_steps(run, run_folder(run.folder)))["compare"]
    expected = [f"a={other.key}", f"b={run.key}", f"runs_dir={tmp_path}"]
    assert shlex.split(command)[-3:] == expected


def test_no_comparison_is_advised_that_is_refused(tmp_path: Path) -> None:
    run = specify_run(("+experiment=grbm", f"runs_dir={tmp_path}"), checked=False)
    run.folder.mkdir()
    folder = RunFolder(run.folder)
    for number, found in ((9, 0), (10, 1)):  # `rgbt compare` requires ten images
        data: Any = {"names": tuple(map(str, range(number))), "night": None}
        data |= {"classes": ("ground", "car"), "measurement": measurement()}
        counts = Counts(counts=np.ones((number, 5, 2, 2), np.int64), **data)
        counts.save(run.folder / "counts_test.npz")
        words = [name for name, _ in next_steps(run, folder)]
        assert words.count("compare with") == found
        assert "predict" in words


def test_own_classes_are_trusted_by_the_printed_command(tmp_path: Path) -> None:
    run = specify_run(("+experiment=grbm", f"runs_dir={tmp_path}"), checked=False)
    run.plain["masker"]["_target_"] = "my_lab.maskers.Mine"
    assert dict(next_steps(run, run_folder(run.folder)))["predict"].endswith("trust=my_lab.maskers")


@contextmanager
def until_printed(command: str, folder: Path, word: str) -> Iterator[str]:
    """A command of the shell that serves until it is interrupted, and the line with `word`."""
    with subprocess.Popen(
        ["bash", "-c", f"exec {command}"],
        cwd=folder,
        stdout=subprocess.PIPE,
        text=True,
        start_new_session=True,
    ) as process:
        assert process.stdout is not None
        try:
            yield next((line for line in process.stdout if word in line), "")
        finally:
            os.killpg(process.pid, signal.SIGINT)


@pytest.mark.slow
@pytest.mark.usefixtures("inactive")
def test_printed_commands_work_as_pasted(tmp_path: Path) -> None:
    """In a folder with a space: train, look, predict, train another, compare, open MLflow."""

    def paste(command: str) -> str:
        done = subprocess.run(
            ["bash", "-c", command], cwd=folder, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, f"{command}\n{done.stdout}\n{done.stderr}"
        return done.stdout

    def steps_of(shown: str) -> dict[str, str]:
        return dict(re.findall(r"^(\S[\w ]*?) {2,}(\S.*)$", shown, re.MULTILINE))

    folder = tmp_path / "my images"
    folder.mkdir()
    first = shlex.join([str(SCRIPT), "run", "+experiment=grbm", *SMOKE, "runs_dir=my runs"])
    steps = steps_of(paste(first))
    assert Path(steps["look at"]).stat().st_size > 10_000
    assert "12 images in" in paste(steps["predict"])
    assert len(list(folder.glob("predicted/*/*_overlay.png"))) == 12
    after = steps_of(paste(steps["compare with"]))
    assert "mIoU" in paste(after["compare"])
    assert steps_of(paste(first))["compare"] != after["compare"], "now there is one to compare with"
    with until_printed(steps["open MLflow"], folder, "open MLflow") as line:
        assert "http://127.0.0.1:" in line
