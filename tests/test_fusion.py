"""Functions that a training may compile: when they are, and that its losses stay the same."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import torch
from torch._dynamo.exc import TorchDynamoException

from rgbt.checks import InputError
from rgbt.engine.checkpoint import State
from rgbt.engine.device import compiles_functions
from rgbt.fusion import compile_fused, fused
from tests.engine.test_device import settings
from tests.engine.test_trainer import batches, make

CPU, CUDA = torch.device("cpu"), torch.device("cuda", 0)


def test_marked_functions_are_compiled_inside_the_block_alone(monkeypatch: Any) -> None:
    compiled: list[str] = []

    def stand_in(function: Any, *, dynamic: bool) -> Any:
        assert dynamic
        compiled.append(function.__name__)
        return lambda x: function(x) + 100

    monkeypatch.setattr(torch, "compile", stand_in)

    @fused
    def double(x: int) -> int:
        return 2 * x

    assert double(1) == 2
    with compile_fused(True):
        assert [double(1), double(2)] == [102, 104]
        with compile_fused(False):  # an evaluation
            assert double(1) == 2
        assert double(3) == 106
    with pytest.raises(ValueError, match="stops"), compile_fused(True):
        raise ValueError("stops")
    assert (double(1), compiled) == (2, ["double"])


def test_what_cannot_be_compiled_names_the_setting(monkeypatch: Any) -> None:
    def failing(function: Any, *, dynamic: bool) -> Any:
        def call(error: Exception) -> None:
            raise error

        return call

    monkeypatch.setattr(torch, "compile", failing)

    @fused
    def step(error: Exception) -> None: ...

    with compile_fused(True):
        with pytest.raises(InputError, match="trainer.compile: step .*no compiler.*compile=none"):
            step(TorchDynamoException("no compiler\nfound"))
        with pytest.raises(torch.OutOfMemoryError):
            step(torch.OutOfMemoryError("full"))


@pytest.mark.parametrize(
    ("setting", "device", "there", "expected"),
    [
        ("auto", CPU, True, False),
        ("auto", CUDA, True, True),
        ("auto", CUDA, False, False),  # no Triton, or no C compiler
        ("functions", CPU, False, True),
        ("none", CUDA, True, False),
        ("default", CUDA, True, False),
    ],
)
def test_functions_are_compiled_on_gpus_that_can(
    setting: Any, device: torch.device, there: bool, expected: bool, monkeypatch: Any
) -> None:
    found = "/usr/bin/gcc" if there else None
    monkeypatch.delenv("CC", raising=False)
    monkeypatch.setattr("rgbt.engine.device.shutil.which", lambda name: found)
    monkeypatch.setattr("rgbt.engine.device.find_spec", lambda name: object() if there else None)
    assert compiles_functions(settings(compile=setting), device) is expected


@pytest.mark.parametrize("setting", ["functions", "none"])
def test_a_training_compiles_its_steps_and_not_its_evaluation(
    setting: str, tmp_path: Path, monkeypatch: Any
) -> None:
    monkeypatch.setattr(torch, "compile", lambda function, dynamic: lambda: "compiled")
    called: dict[str, str] = {}

    @fused
    def here() -> str:
        return "as it is"

    trainer, _ = make(tmp_path, compile=setting, max_steps=1)
    phases = trainer.phases

    def step(*arguments: Any) -> Any:
        called["step"] = here()
        return phases(*arguments)

    def evaluate(number: int, network: torch.nn.Module) -> float:
        called["evaluation"] = here()
        return 0.5

    trainer.phases, trainer.hooks.evaluate = step, evaluate
    trainer.fit(batches(0), State(seed=0))
    expected = "compiled" if setting == "functions" else "as it is"
    assert called == {"step": expected, "evaluation": "as it is"}
    assert here() == "as it is"


STEPS = """
import json, sys, tempfile, torch
from pathlib import Path
from rgbt.assembly.training_setup import set_up_training
from rgbt.config.compose import compose
from rgbt.engine.checkpoint import State
from rgbt.engine.trainer import Hooks
from rgbt.runs.specify import specify
from tests.benchmarks.loop import trainer_of
import torch._dynamo.utils as seen
words = ["+experiment=crm", "+debug=smoke", "tracking=none", "trainer.accelerator=cpu"]
words += ["trainer.max_steps=6", "trainer.log_every=1", f"trainer.compile={sys.argv[1]}"]
setup = set_up_training(specify(compose(words), words), upstream_finished=False)
losses, graphs = [], []
hooks = Hooks()
def log(step, values):
    losses.append(values["loss"]); graphs.append(seen.counters["stats"]["unique_graphs"])
hooks.log = log
trainer = trainer_of(setup, Path(tempfile.mkdtemp()), hooks)
trainer.fit(setup.batches(range(6)), State(seed=0))
print(json.dumps([losses, graphs]))
"""


@pytest.mark.slow
def test_compiled_functions_give_the_same_losses_and_are_compiled_in_three_steps() -> None:
    found = []
    for setting in ("none", "functions"):
        call = [sys.executable, "-c", STEPS, setting]
        root = Path(__file__).parents[1]
        done = subprocess.run(call, capture_output=True, text=True, check=True, cwd=root)
        found.append(json.loads(done.stdout.splitlines()[-1]))
    (plain, none), (compiled, graphs) = found
    assert compiled[0] == pytest.approx(plain[0], rel=1e-6)
    assert compiled == pytest.approx(plain, rel=1e-4)
    assert none[-1] == 0
    assert 0 < graphs[0] < 20
    assert graphs[2:] == [graphs[2]] * 4
