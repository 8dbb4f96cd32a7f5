"""A device without memory left: the run is kept, and the message names settings that need less."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from rgbt import evaluate
from rgbt.checks import InputError
from rgbt.config.component import build
from rgbt.config.compose import compose
from rgbt.config.plain_command import exit_code
from rgbt.engine.memory import naming_memory, training_advice
from rgbt.engine.settings import TrainerSettings
from rgbt.engine.trainer import Trainer
from rgbt.evaluation.predict import Predictor
from rgbt.requirements import NetworkRecord
from tests.commands import Call, Trained, assert_one_sentence, losses, short, train

CUDA = "CUDA out of memory. Tried to allocate 2.00 GiB. GPU 0 has a total capacity of 15 GiB"
WORDS = ("+experiment=grbm", *short(3))


def no_memory(*_: Any, **__: Any) -> Any:
    raise torch.OutOfMemoryError(CUDA)


def test_run_without_memory_is_resumed_with_less(
    call: Call, data: Path, trained: Trained, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It stops in step 3, after the checkpoint of step 2, and ends with the losses of another."""
    step = Trainer._step

    def limited(trainer: Trainer, number: int, *rest: Any) -> Any:
        return no_memory() if number == 2 else step(trainer, number, *rest)

    with monkeypatch.context() as patch:
        patch.setattr(Trainer, "_step", limited)
        code, _, err = train(call, data, tmp_path, *WORDS)
    assert code == 2, err
    assert_one_sentence(err, "cpu is out of memory in a training step of 2 images of 48x64 in 32-")
    assert "To resume it with less, set trainer.activation_checkpointing=true or more" in err
    assert "data.batch_size=1 trainer.accumulate=2 or a smaller transform.crop_hw" in err
    code, _, err = train(call, data, tmp_path, *WORDS, "trainer.activation_checkpointing=true")
    assert code == 0, err
    assert "resumes at step 2" in err
    (folder,) = (path.parent for path in tmp_path.glob("*/result.json"))
    assert losses(folder) == losses(trained(*WORDS))


def test_evaluation_without_memory_names_its_batch(
    call: Call, trained: Trained, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Predictor, "classes", no_memory)
    for size, advice in (("2", "data.eval_batch_size=1"), ("1", "prediction.window_hw=")):
        words = (f"run={trained(*WORDS)}", "out=counts.npz", f"data.eval_batch_size={size}")
        code, _, err = call(evaluate.entry, *words)
        assert code == 2, err
        assert_one_sentence(err, f"out of memory in an evaluation of {size} images at once")
        assert advice in err


def test_settings_with_less_memory() -> None:
    """Those that are set already, or that cannot be set, are not named."""
    trainer: TrainerSettings = build(compose([]).trainer)
    network = NetworkRecord(recomputed=("blocks.*",))
    said = training_advice(trainer, 14, network, (48, 64))
    assert "checkpointing=true or more trainer.devices." in said
    assert "data.batch_size=7 trainer.accumulate=2 or a smaller transform.crop_hw or" in said
    trainer = replace(trainer, activation_checkpointing=True, accumulate=3, precision="bf16-mixed")
    said = training_advice(trainer, 3, network, None)
    assert said.endswith("A new run needs less with data.batch_size=1 trainer.accumulate=9.")
    said = training_advice(trainer, 1, network, None)
    assert said == "A new run needs less with smaller images."


@pytest.mark.parametrize(
    ("text", "kind"),
    [
        ("mat1 and mat2 shapes cannot be multiplied", RuntimeError),
        *(
            (message, InputError)
            for message in (CUDA, "[alloc] can't allocate memory: 2", "X_ALLOC_FAILED")
        ),
    ],
)
def test_errors_of_memory_are_known(text: str, kind: type[Exception]) -> None:
    with pytest.raises(kind), naming_memory(torch.device("cpu"), "a step", ""):
        raise RuntimeError(text)


def test_other_commands_end_with_one_sentence(capsys: pytest.CaptureFixture[str]) -> None:
    assert exit_code(no_memory) == 2
    said = "rgbt: CUDA out of memory. Tried to allocate 2.00 GiB. Use smaller images or batches, or"
    assert capsys.readouterr().err.startswith(said)
