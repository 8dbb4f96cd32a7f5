"""The command that measures a GPU: its options, its limits, and its steps on the CPU."""

from __future__ import annotations

import io
import json
import subprocess
import sys
import time
import warnings
from pathlib import Path
from typing import Any

import pytest
import torch

from tests.benchmarks.gpu import step_equality, step_training, step_waits
from tests.benchmarks.gpu.device import arithmetic
from tests.benchmarks.gpu.request import Request, UsageError, request_of
from tests.benchmarks.gpu.results import StepResult, markdown
from tests.benchmarks.gpu.runner import ROOT, limit_of, run_steps
from tests.benchmarks.gpu.step_tests import files_with_mark
from tests.benchmarks.gpu.steps import STEPS, Step
from tests.benchmarks.gpu.task import Task

FAKES = "tests.benchmarks.fakes"


def task_in(folder: Path, device: str = "cpu", seconds: float = 600.0) -> Task:
    (folder / "work").mkdir()
    return Task(device, "smoke", None, folder / "work", seconds, io.StringIO())


def lines_of(task: Task, kind: str) -> list[Any]:
    written = map(json.loads, task.report.getvalue().splitlines())
    return [line[kind] for line in written if kind in line]


# Options.


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        ([], "out has no value"),
        (["out=x", "minute=3"], "unknown option minute=3"),
        (["out=x", "out=y"], "out is given twice"),
        (["out="], "out has no value"),
        (["out=x", "minutes=0"], "minutes must be a number above 0"),
        (["out=x", "minutes=soon"], "got soon"),
        (["out=x", "device=tpu"], "device must be cuda or cpu, got tpu"),
        (["out=x", "size=huge"], "size must be full or smoke, got huge"),
        (["out=x", "steps=machine,speed"], "there is no step 'speed'"),
        (["out=x", "data=/nowhere"], "data=/nowhere does not contain train.txt"),
        ([f"out={Path(__file__)}"], "is a file"),
    ],
)
def test_wrong_options_are_one_sentence(words: list[str], sentence: str) -> None:
    with pytest.raises(UsageError) as caught:
        request_of(words)
    assert sentence in str(caught.value)
    assert "\n" not in str(caught.value)


def test_steps_keep_the_order_of_the_table() -> None:
    request = request_of(["out=x", "steps=views,machine", "minutes=2.5"])
    assert request.steps == ("machine", "views")
    assert (request.device, request.size, request.minutes) == ("cuda", "full", 2.5)
    assert request_of(["out=x"]).steps == tuple(step.name for step in STEPS)


# Limits and failures.


def fake(name: str, seconds: float | None = 40.0) -> Step:
    return Step(name, name.title(), f"{FAKES}.{name}", seconds, least=1.0)


def test_limits_are_shares_of_the_whole() -> None:
    request = Request(Path("x"), minutes=4.0)
    assert limit_of(fake("works"), request, 200.0) == 20.0
    assert limit_of(fake("works"), request, 12.0) == 12.0
    assert limit_of(fake("works", None), request, 200.0) == 200.0
    # What has a fixed limit fits into the nominal time.
    assert sum(step.seconds or step.least for step in STEPS) <= 480


def test_a_step_that_fails_costs_that_step_alone(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tests.benchmarks.gpu.runner.CPU_LEAST", 3.0)
    names = ("crashes", "exhausts", "hangs", "lacks", "works")
    steps = [fake(name) for name in names]
    request = Request(tmp_path / "out", minutes=2.0, device="cpu", size="smoke", steps=names)
    found = {each.name: each for each in run_steps(request, steps)}
    assert [each.status for each in found.values()] == [
        *("failed", "failed", "stopped", "skipped", "done"),
    ]
    assert "SIGSEGV" in found["crashes"].reason
    assert found["crashes"].rows == [{"measured": 1}]
    assert found["exhausts"].reason.startswith("MemoryError: CUDA out of memory. Tried")
    assert "no_such_package_of_anybody" in found["lacks"].reason
    assert found["works"].rows[0] == {"name": "one", "value": 1.235, "device": "cpu"}
    # The stacks of a step that hangs are in its log, and what it started has ended.
    assert "hangs.py" in (tmp_path / "out" / "hangs.log").read_text()
    assert not is_alive(found["hangs"].rows[0]["child"])
    stored = json.loads((tmp_path / "out" / "results.json").read_text())
    assert [each["status"] for each in stored["steps"]] == [e.status for e in found.values()]
    page = (tmp_path / "out" / "results.md").read_text()
    assert "| one | 1.235 | cpu |" in page
    assert "A sentence." in page
    printed = capfd.readouterr().out
    assert "[3/5] hangs     Hangs (limit 10 s)" in printed
    assert "two parts" in printed
    assert not list((tmp_path / "out").glob(".*"))


def is_alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def test_the_command_ends_in_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    names = ("hangs", "works")
    began = time.monotonic()
    request = Request(tmp_path, minutes=6 / 60, device="cpu", size="smoke", steps=names)
    first, second = run_steps(request, [fake("hangs"), fake("works")])
    assert time.monotonic() - began < 6.0 + 4.0  # the machine may be busy
    assert first.status == "stopped"
    assert (second.status, second.seconds) == ("skipped", 0.0)
    assert "0 s are left" in second.reason


def test_a_step_without_a_gpu_is_skipped_with_the_reason(tmp_path: Path) -> None:
    if torch.cuda.is_available():
        pytest.skip("there is a GPU")
    words = ["out=out", "steps=machine", "minutes=1"]
    done = subprocess.run(
        [sys.executable, "-m", "tests.benchmarks.gpu", *words],
        **{"cwd": tmp_path, "env": {"PYTHONPATH": str(ROOT), "PATH": "/usr/bin:/bin"}},
        **{"capture_output": True, "text": True, "check": False, "timeout": 120},
    )
    assert done.returncode == 0, done.stderr
    assert "skipped: it needs a GPU, but" in done.stdout


def test_a_table_keeps_every_column() -> None:
    result = StepResult("a", "Title", rows=[{"x": 1}, {"y": "p|q"}])
    assert "| x | y |\n| --- | --- |\n| 1 |  |\n|  | p\\|q |" in markdown("c", "now", [result])


# The steps on the CPU.


def test_arithmetic_is_restored() -> None:
    matmul, cudnn = torch.backends.cuda.matmul, torch.backends.cudnn
    before = matmul.allow_tf32, cudnn.allow_tf32
    with arithmetic("tf32"):
        assert (matmul.allow_tf32, cudnn.allow_tf32) == (True, True)
        with arithmetic("fp32"):
            assert (matmul.allow_tf32, cudnn.allow_tf32) == (False, False)
    assert (matmul.allow_tf32, cudnn.allow_tf32) == before


def test_the_marked_tests_are_found() -> None:
    found = files_with_mark()
    assert "tests/on_device/test_draws.py" in found


@pytest.mark.slow
def test_equality_covers_every_scheme_loss_and_network() -> None:
    from rgbt.config.compose import available
    from tests.composed import specified

    def parts(names: Any) -> set[str]:
        specs = [specified((f"+experiment={name}", "+debug=smoke")) for name in names]
        nodes = [node for spec in specs for node in (spec.scheme, spec.loss, spec.model)]
        return {str(node.plain["_target_"]) for node in nodes}

    everything = available("experiment")
    assert set(step_equality.FIRST) <= set(everything)
    assert parts(step_equality.FIRST) == parts(everything)


def test_equality_reports_no_difference_on_one_device(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(step_equality, "SMOKE", ("mfnet",))
    task = task_in(tmp_path)
    step_equality.measure(task)
    rows = lines_of(task, "row")
    assert [row["experiment"] for row in rows] == ["mfnet"]
    assert all(row["loss difference"] == row["pixels differing"] == 0 for row in rows)
    assert all(row["loss on the CPU"] > 0 for row in rows)


@pytest.mark.slow
def test_training_reports_speed_memory_and_share(tmp_path: Path) -> None:
    task = task_in(tmp_path)
    step_training.measure(task)
    row, checkpointed = lines_of(task, "row")
    assert row["images per second"] * row["ms per step"] == pytest.approx(1e3 * row["batch"], 1e-2)
    assert 0 < row["share of the product's rate"] < 2
    assert checkpointed["loss"] == row["loss"]


def test_training_halves_the_batch_where_memory_runs_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def steps(bench: Any, network: str, precision: str, size: int, trainer: Any) -> Any:
        if size > 3:
            raise torch.cuda.OutOfMemoryError("CUDA out of memory.")
        return {"batch": size}

    monkeypatch.setattr(step_training, "_steps", steps)
    task = task_in(tmp_path)
    task.size = "full"
    bench = step_training.Bench(task, torch.device("cpu"), tmp_path, {})
    row = step_training.attempt(bench, "mask2former_swin_b", "fp32")
    assert row["batch"] == 3
    assert lines_of(task, "note") == [
        f"swin_b fp32: batch {size} does not fit into memory." for size in (14, 7)
    ]


def test_a_configuration_that_fails_does_not_stop_the_others(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def attempt(bench: Any, network: str, precision: str, **trainer: str) -> Any:
        if trainer["activation_checkpointing"] == "false":
            raise RuntimeError("no kernel image\nmore")
        bench.task.row(network=network)

    monkeypatch.setattr(step_training, "attempt", attempt)
    task = task_in(tmp_path)
    with pytest.raises(AssertionError, match="1 configurations failed"):
        step_training.measure(task)
    assert len(lines_of(task, "row")) == 1
    assert "failed: RuntimeError: no kernel image (" in lines_of(task, "note")[0]


@pytest.mark.slow
def test_waits_are_counted_by_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The code for a GPU, with a CPU that warns as CUDA does."""
    from rgbt.engine import trainer

    modes: list[str] = []
    read = trainer._finite_values

    def warned(parts: Any) -> Any:
        warnings.warn("called a synchronizing CUDA operation", stacklevel=1)
        return read(parts)

    monkeypatch.setattr(torch.cuda, "set_sync_debug_mode", modes.append)
    monkeypatch.setattr(trainer, "_finite_values", warned)
    for name in ("WARM", "STEPS"):
        monkeypatch.setattr(step_waits, name, 1)
    task = task_in(tmp_path)
    step_waits._measure_on_gpu(task, torch.device("cpu"))
    row = lines_of(task, "row")[0]
    assert row["line"].startswith("rgbt/engine/trainer.py:")
    assert row["per step"] == 1.0  # two calls, on two lines
    assert modes == ["warn", "default"]
    assert "waits" in lines_of(task, "headline")[0]


@pytest.mark.slow
def test_every_step_ends_on_the_cpu(tmp_path: Path) -> None:
    request = Request(tmp_path, minutes=10.0, device="cpu", size="smoke")
    found = run_steps(request)
    assert [(each.name, each.status) for each in found] == [(s.name, "done") for s in STEPS], [
        each.line() for each in found
    ]
