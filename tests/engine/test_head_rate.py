"""The constant rate of the head of "SH-Maximum squares loss", against steps in plain floats."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from lightning_fabric import Fabric
from torch import nn

from rgbt.engine.checkpoint import State
from rgbt.engine.optimizers import SGD
from rgbt.engine.schedules import ThesisPoly
from rgbt.engine.settings import TrainerSettings
from rgbt.engine.trainer import Trainer
from rgbt.requirements import Record
from rgbt.types import Phase
from tests.engine.test_trainer import SETTINGS, batches

STEPS, RATE, SHARE, MOMENTUM, DECAY = 5, 0.1, 0.1, 0.9, 0.01


class Product(nn.Module):
    """backbone * head; the cost (b h - 1)^2."""

    record = Record(pretrained_parts=("backbone.",))

    def __init__(self) -> None:
        super().__init__()
        self.backbone = nn.Module()
        self.backbone.register_parameter("w", nn.Parameter(torch.tensor(0.5)))
        self.head = nn.Module()
        self.head.register_parameter("w", nn.Parameter(torch.tensor(0.7)))


class Fit:
    def __init__(self, model: Product) -> None:
        self.model = model

    def phases(self, *_: Any) -> Any:
        product = self.model.backbone.w * self.model.head.w  # type: ignore[operator]
        yield Phase(("main",), {"fit": (product - 1) ** 2})


def by_hand(head_rate: str) -> tuple[float, float, list[tuple[float, float]]]:
    """SGD with momentum and decay; rates RATE (1 - t / T)^0.9 with t from 1, the head's or not."""
    b, h, of_b, of_h, rates = 0.5, 0.7, 0.0, 0.0, []
    for step in range(1, STEPS + 1):
        factor = (1 - step / STEPS) ** 0.9
        rate_b, rate_h = RATE * SHARE * factor, RATE * (factor if head_rate == "scheduled" else 1)
        residual = 2 * (b * h - 1)
        of_b = MOMENTUM * of_b + residual * h + DECAY * b
        of_h = MOMENTUM * of_h + residual * b + DECAY * h
        b, h = b - rate_b * of_b, h - rate_h * of_h
        rates.append((rate_b, rate_h))
    return b, h, rates


def trained(folder: Path, head_rate: Any, stop: int | None = None) -> tuple[Product, list[Any]]:
    model, log = Product(), []
    for last in (stop, STEPS) if stop else (STEPS,):
        builder = SGD(
            **{"lr": RATE, "backbone_multiplier": SHARE, "momentum": MOMENTUM},
            **{"weight_decay": DECAY, "head_rate": head_rate},
        )
        made = Trainer(
            fabric=Fabric(accelerator="cpu", devices=1),
            settings=TrainerSettings(
                **{**SETTINGS, "max_steps": STEPS, "clip_norm": None, "checkpoint_every": 1}
            ),
            **{"scheme": Fit(model), "model": model, "others": {}},
            optimizers={"main": builder(model)},
            schedule=ThesisPoly(power=0.9),
            **{"steps_per_epoch": 1, "folder": folder},
            record=lambda _, values: log.append(values),
            validate=float,
        )
        state = State(seed=0)
        made.resume(state)
        if last != STEPS:
            made.settings = TrainerSettings(**{**SETTINGS, "max_steps": last, "clip_norm": None})
            made.schedule = lambda step, *_: ThesisPoly(power=0.9)(step, STEPS, 1)
        made.fit(batches(state.step), state)
    return model, log


@pytest.mark.parametrize("head_rate", ["scheduled", "released"])
@pytest.mark.parametrize("stop", [None, 3])
def test_five_steps_are_those_written_out(tmp_path: Path, head_rate: str, stop: int | None) -> None:
    backbone, head, rates = by_hand(head_rate)
    model, log = trained(tmp_path, head_rate, stop)
    assert model.backbone.w.item() == pytest.approx(backbone, abs=1e-6)
    assert model.head.w.item() == pytest.approx(head, abs=1e-6)
    logged = [tuple(sorted((each["lr/main_0"], each["lr/main_1"]))) for each in log]
    assert logged == [pytest.approx(tuple(sorted(pair))) for pair in rates]
    assert by_hand("released")[1] != pytest.approx(by_hand("scheduled")[1], abs=1e-3)
