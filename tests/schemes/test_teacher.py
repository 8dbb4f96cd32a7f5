"""The teacher: its average by hand, and a network that is left as it was."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor, nn

from rgbt.models.parts import drop_channels
from rgbt.schemes.network_copy import NetworkCopy
from rgbt.schemes.teacher import Teacher


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


def test_average_follows_its_recursion() -> None:
    network = Net()
    teacher = teacher_of(network, decay=0.6)
    values, expected = [5.0, 1.0, 4.0, 2.0, 8.0], 0.0
    for step, value in enumerate(values):
        network.weight.data.fill_(value)
        teacher.update(step)
        share = min(1 - 1 / (step + 1), 0.6)
        expected = share * expected + (1 - share) * value
        assert teacher.average.get_buffer("weight").item() == pytest.approx(expected, abs=1e-12)
    # After steps 0 and 1 it is their mean, 3; then 0.6 and 0.4.
    by_hand = 0.6 * (0.6 * (0.6 * 3 + 0.4 * 4) + 0.4 * 2) + 0.4 * 8
    assert expected == pytest.approx(by_hand)


def test_first_update_is_a_copy_and_the_second_of_a_step_does_nothing() -> None:
    network = Net()
    teacher = teacher_of(network)
    network.weight.data.fill_(-7.5)
    teacher.update(0)
    assert teacher.average.get_buffer("weight").item() == -7.5
    network.weight.data.fill_(1.0)
    teacher.update(0)
    assert teacher.average.get_buffer("weight").item() == -7.5
    teacher.update(1)
    assert teacher.average.get_buffer("weight").item() == -3.25


def test_state_has_the_averages_alone() -> None:
    """No buffer of the network, and not the network itself."""
    teacher = teacher_of(Net())
    assert set(teacher.average.state_dict()) == {"norm/weight", "norm/bias", "weight"}
    assert not list(teacher.average.parameters())


@pytest.mark.parametrize("norm", ["batch", "running"])
def test_network_predicts_as_the_teacher_and_is_left_as_it_was(norm: str) -> None:
    network = Net()
    teacher = teacher_of(network, norm=norm)
    with torch.no_grad():
        network.weight.fill_(4.0)
        network.norm.running_mean.fill_(3.0)
        network.norm.running_var.fill_(4.0)
    before = {name: each.clone() for name, each in network.state_dict().items()}
    with teacher.in_network():
        assert not torch.is_grad_enabled()
        found = network(images())  # without a generator, so that dropout would raise
    # Mean 4 and variance 5 of the batch, or mean 3 and variance 4 of the network; weight 2.
    mean, variance = (4.0, 5.0) if norm == "batch" else (3.0, 4.0)
    expected = 2 * (images() - mean) / (variance + network.norm.eps) ** 0.5
    torch.testing.assert_close(found, expected)
    after = network.state_dict()
    assert all(torch.equal(before[name], after[name]) for name in before)
    assert network.training
    assert network.norm.training
    assert network.norm.track_running_stats
    assert torch.is_grad_enabled()


def test_frozen_normalisation_stays_frozen() -> None:
    network = Net()
    network.norm.eval()
    with teacher_of(network).in_network():
        found = network(images())
    torch.testing.assert_close(found, 2 * images() / (1 + network.norm.eps) ** 0.5)
    assert network.training
    assert not network.norm.training


def test_copy_with_buffers_is_the_network_as_it_was() -> None:
    """Weight 2, mean 3 and variance 4, whatever the network has become."""
    network = Net()
    network.norm.running_mean.fill_(3.0)
    network.norm.running_var.fill_(4.0)
    copied = NetworkCopy(network, normalisation="running", buffers=True)
    network.weight.data.fill_(5.0)
    network(images(), torch.Generator())
    before = {name: each.clone() for name, each in network.state_dict().items()}
    with copied.in_network():
        found = network(images())
    torch.testing.assert_close(found, 2 * (images() - 3) / (4 + network.norm.eps) ** 0.5)
    after = network.state_dict()
    assert all(torch.equal(before[name], after[name]) for name in before)


def test_tensor_with_two_names_is_exchanged_as_one() -> None:
    network = nn.ModuleDict({"first": Net()})
    network["second"] = network["first"]
    copied = NetworkCopy(network, normalisation="running", buffers=True)
    network["first"].weight.data.fill_(5.0)
    network["first"].norm.running_mean.fill_(3.0)
    for _ in range(2):
        with copied.in_network():
            assert network["second"].weight.item() == 2.0
            assert network["second"].norm.running_mean.item() == 0.0
        assert network["first"].weight.item() == 5.0
        assert network["first"].norm.running_mean.item() == 3.0


def test_an_error_leaves_the_network_as_it_was() -> None:
    network = Net()
    teacher = teacher_of(network)
    network.weight.data.fill_(4.0)

    def fail() -> None:
        with teacher.in_network():
            assert network.weight.item() == 2.0
            raise KeyError

    with pytest.raises(KeyError):
        fail()
    assert network.weight.item() == 4.0
    assert network.training


def test_optimizer_steps_the_network_after_the_teacher() -> None:
    """The parameter is the one that the optimizer knows, also after an exchange."""
    network = Net()
    teacher = teacher_of(network)
    optimizer = torch.optim.SGD(network.parameters(), lr=0.5)
    with teacher.in_network():
        network(images())
    (network.weight * 3).backward()
    optimizer.step()
    assert network.weight.item() == 0.5
    assert teacher.average.get_buffer("weight").item() == 2.0
