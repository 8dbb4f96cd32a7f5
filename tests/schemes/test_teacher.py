"""The teacher: its average by hand, and the statistics that it predicts with."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor, nn

from rgbt.models.parts import drop_channels
from rgbt.schemes.self_training import Teacher


class Net(nn.Module):
    """A normalisation, a weight, and dropout in training."""

    def __init__(self) -> None:
        super().__init__()
        self.norm = nn.BatchNorm2d(1)
        self.weight = nn.Parameter(torch.tensor(2.0, dtype=torch.float64))
        self.double()

    def forward(self, x: Tensor, generator: torch.Generator | None = None) -> Tensor:
        return self.weight * drop_channels(self.norm(x), 0.9 if self.training else 0.0, generator)


def images() -> Tensor:
    return torch.tensor([1.0, 3.0, 5.0, 7.0], dtype=torch.float64).view(1, 1, 2, 2)


def teacher_of(network: nn.Module, decay: float = 0.999, norm: str = "batch") -> Teacher:
    return Teacher(network, decay=decay, normalisation=norm)  # type: ignore[arg-type]


def test_average_follows_its_recursion_once_a_step() -> None:
    network = Net()
    teacher = teacher_of(network, decay=0.6)
    values, expected = [5.0, 1.0, 4.0, 2.0, 8.0], 0.0
    for step, value in enumerate(values):
        network.weight.data.fill_(value)
        teacher.update(step)
        share = min(1 - 1 / (step + 1), 0.6)
        expected = share * expected + (1 - share) * value
        network.weight.data.fill_(-100.0)
        teacher.update(step)
        assert teacher.network().weight.item() == pytest.approx(expected, abs=1e-12)
    # After steps 0 and 1 it is their mean, 3; then 0.6 and 0.4.
    by_hand = 0.6 * (0.6 * (0.6 * 3 + 0.4 * 4) + 0.4 * 2) + 0.4 * 8
    assert expected == pytest.approx(by_hand)


@pytest.mark.parametrize("norm", ["batch", "running"])
def test_teacher_predicts_without_dropout_and_changes_no_statistics(norm: str) -> None:
    network = Net()
    with torch.no_grad():
        network.norm.running_mean.fill_(3.0)
        network.norm.running_var.fill_(4.0)
    teacher = teacher_of(network, norm=norm)
    network.weight.data.fill_(4.0)
    before = {name: each.clone() for name, each in teacher.average.state_dict().items()}
    for _ in range(2):
        found = teacher.network()(images())  # without a generator, so that dropout would raise
        # Mean 4 and variance 5 of the batch, or mean 3 and variance 4 of the network; weight 2.
        mean, variance = (4.0, 5.0) if norm == "batch" else (3.0, 4.0)
        expected = 2 * (images() - mean) / (variance + network.norm.eps) ** 0.5
        torch.testing.assert_close(found, expected)
    assert not found.requires_grad
    after = teacher.average.state_dict()
    assert all(torch.equal(before[name], after[name]) for name in before)
    assert network.norm.training
    assert network.norm.track_running_stats


def test_frozen_normalisation_stays_frozen() -> None:
    network = Net()
    network.norm.eval()
    found = teacher_of(network).network()(images())
    torch.testing.assert_close(found, 2 * images() / (1 + network.norm.eps) ** 0.5)


def test_statistics_are_those_of_the_student() -> None:
    network = Net()
    teacher = teacher_of(network, norm="running")
    network.norm.running_mean.fill_(3.0)
    teacher.update(7)
    assert teacher.network().norm.running_mean.item() == 3.0


