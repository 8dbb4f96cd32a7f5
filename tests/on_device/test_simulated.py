"""Steps of the experiments on a simulated device: no operation meets tensors of two devices."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from rgbt.config.compose import available
from tests.on_device.simulated import (
    DEVICE,
    DeviceMismatchError,
    Placed,
    line_of_ours,
    simulation,
)
from tests.on_device.simulated_run import on_cpu, simulated, words_of

SOME = ("crm", "temporal_con", "sh_adversarial")
MOST_WAITS = {"crm": 16, "temporal_con": 20, "sh_adversarial": 6}
"""Of one step. Fewer are better: lower these numbers then."""


def there(*shape: int) -> torch.Tensor:
    return torch.ones(shape).to(DEVICE)


def test_values_and_gradients_are_those_of_the_cpu() -> None:
    torch.manual_seed(0)
    layer, x = torch.nn.Linear(3, 4), torch.randn(5, 3)
    layer(x).square().sum().backward()
    expected = layer.weight.grad.clone()
    with simulation():
        layer.zero_grad()
        layer.to(DEVICE)
        loss = layer(x.to(DEVICE)).square().sum()
        loss.backward()
        assert isinstance(layer.weight.grad, Placed)
        assert torch.equal(layer.weight.grad.cpu(), expected)


def test_meetings_of_two_devices_raise() -> None:
    with simulation():
        for meet in (
            lambda: there(3) + torch.ones(3),
            lambda: torch.cat([there(1), torch.ones(1)]),
            lambda: there(3, 3) @ torch.ones(3, 3),
            lambda: torch.where(there(3) > 0, torch.ones(3), 0.0),
            lambda: torch.stack([there(), torch.ones(())]),
        ):
            with pytest.raises(DeviceMismatchError, match="tensors of the CPU"):
                meet()
        for leave in (lambda: there(3).numpy(), lambda: np.asarray(there(3))):
            with pytest.raises((RuntimeError, TypeError)):
                leave()
        # Single numbers of the host are constants, and indices may lie there.
        assert (there(3) * torch.tensor(2.0)).tolist() == [2.0] * 3
        assert there(3)[torch.tensor([0, 2])].shape == (2,)


def test_random_numbers_need_a_generator_of_the_device() -> None:
    with simulation():
        generator = torch.Generator(device=DEVICE).manual_seed(3)
        drawn = torch.rand(4, generator=generator, device=generator.device)
        assert isinstance(drawn, Placed)
        assert drawn.tolist() == torch.rand(4, generator=torch.Generator().manual_seed(3)).tolist()


def test_lines_of_tests_are_not_ours() -> None:
    """Also in a clone whose folder is called rgbt."""
    assert line_of_ours() == "elsewhere"


@pytest.mark.parametrize(
    "experiment", ["crm", pytest.param("temporal_con", marks=pytest.mark.slow), "sh_adversarial"]
)
def test_steps_and_classes_are_those_of_the_cpu(experiment: str, tmp_path: Path) -> None:
    words = words_of(experiment)
    here, found = on_cpu(words, tmp_path), simulated(words, tmp_path)
    assert found.losses == pytest.approx(here.losses, rel=1e-5)
    differing = sum(int((a != b).sum()) for a, b in zip(here.classes, found.classes))
    assert differing <= 1e-3 * sum(each.numel() for each in here.classes)
    assert 0 < sum(found.step_waits.values()) <= MOST_WAITS[experiment], found.step_waits
    assert sum(found.evaluation_waits.values()) <= 1, found.evaluation_waits


@pytest.mark.slow
@pytest.mark.parametrize("experiment", [e for e in available("experiment") if e not in SOME])
def test_every_experiment_runs_on_one_device(experiment: str, tmp_path: Path) -> None:
    found = simulated(words_of(experiment), tmp_path)
    assert all(np.isfinite(found.losses))
