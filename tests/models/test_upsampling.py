"""The up block by hand, and where channels are dropped on the way up."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor, nn

from rgbt.models.upsampling import UpBlock, enlarge
from tests.models.plain import generator


@pytest.mark.parametrize(
    ("align_corners", "row"),
    [
        (False, [0.0, 1.0, 3.0, 4.0]),  # centres of the new cells lie at -1/4, 1/4, 3/4, 5/4
        (True, [0.0, 4 / 3, 8 / 3, 4.0]),  # at 0, 1/3, 2/3, 1
    ],
)
def test_twice_the_size(align_corners: bool, row: list[float]) -> None:
    block = UpBlock(1, 1, align_corners=align_corners).eval()
    state = block.state_dict()
    # The middle tap alone, doubled, plus 1; normalised with mean 4 and deviation 2.
    state["conv.0.weight"].zero_()[0, 0, 1, 1] = 2.0
    state["conv.0.bias"].fill_(1.0)
    state["conv.1.running_mean"].fill_(4.0)
    state["conv.1.running_var"].fill_(4.0 - 1e-5)
    state["conv.2.weight"].fill_(0.5)
    found = block(torch.tensor([0.0, 4.0]).view(1, 1, 1, 2))
    assert found.shape == (1, 1, 2, 4)
    normalised = [(2 * value + 1 - 4) / 2 for value in row]
    expected = [value if value > 0 else 0.5 * value for value in normalised]
    torch.testing.assert_close(found[0, 0], torch.tensor([expected, expected]))


class Note(nn.Module):
    """Passes a map on and remembers it."""

    def forward(self, x: Tensor) -> Tensor:
        self.seen = x
        return x


def test_channels_are_dropped_before_the_first_block_and_after_every_one() -> None:
    x = torch.ones(4, 500, 2, 2)
    blocks = (Note(), Note())
    result = enlarge(x, blocks, (0.5, 0.2), generator())
    first, second = (block.seen[:, :, 0, 0] for block in blocks)
    assert first.unique().tolist() == [0.0, 2.0]
    assert second.unique().tolist() == [0.0, 2.5]
    # 2,000 draws: standard errors 0.011 and 0.010
    assert (first == 0).float().mean().item() == pytest.approx(0.5, abs=0.05)
    assert (result == 0).float().mean().item() == pytest.approx(1 - 0.5 * 0.8**2, abs=0.05)


def test_no_rate_needs_no_generator() -> None:
    x = torch.rand(1, 3, 2, 2)
    assert torch.equal(enlarge(x, (Note(),), (0.0, 0.0), None), x)
    with pytest.raises(ValueError, match="generator"):
        enlarge(x, (Note(),), (0.0, 0.1), None)


def test_gradient() -> None:
    block = UpBlock(2, 3, align_corners=False).double()
    x = torch.rand(2, 2, 2, 3, dtype=torch.float64, generator=generator(), requires_grad=True)
    assert torch.autograd.gradcheck(block, (x,))
