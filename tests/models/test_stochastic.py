"""Random drops: their rate, their scale, and that only the generator decides."""

from __future__ import annotations

import pytest
import torch

from rgbt.models.stochastic import drop_channels, keep_factors


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def test_factors_are_zero_or_the_inverse_of_the_probability() -> None:
    factors = keep_factors(torch.tensor([0.0, 0.2]), (2, 5000), generator(), torch.device("cpu"))
    assert factors.shape == (2, 2, 5000)
    assert factors[0].unique().tolist() == [1.0]
    assert factors[1].unique().tolist() == [0.0, 1.25]
    # 10,000 draws: standard error 0.005.
    assert factors[1].mean().item() == pytest.approx(1.0, abs=0.02)


def test_the_generator_alone_decides() -> None:
    rates, cpu = torch.tensor([0.5]), torch.device("cpu")
    torch.manual_seed(1)
    first = keep_factors(rates, (64,), generator(), cpu)
    torch.manual_seed(2)
    assert torch.equal(first, keep_factors(rates, (64,), generator(), cpu))
    assert not torch.equal(first, keep_factors(rates, (64,), generator(1), cpu))
    with pytest.raises(ValueError, match="generator"):
        keep_factors(rates, (1,), None, cpu)


def test_whole_channels_are_dropped() -> None:
    x = torch.ones(8, 50, 3, 4)
    dropped = drop_channels(x, 0.5, generator())
    by_channel = dropped.flatten(2)
    assert torch.equal(by_channel.amin(-1), by_channel.amax(-1))
    assert by_channel.unique().tolist() == [0.0, 2.0]
    assert 120 < (by_channel[..., 0] == 0).sum() < 280  # of 400
