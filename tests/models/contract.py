"""What every network of one view must do; each check is called with a network of few channels."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from rgbt.types import MaskPair

Pair = tuple[Tensor, Tensor]


def check_hidden_pixels_do_not_count(net: nn.Module, images: Pair) -> None:
    """Images (1, c, 64, 96) that differ only in one hidden cell of 32 x 32 give equal logits."""
    hidden = torch.zeros(1, 2, 3, dtype=torch.bool)
    hidden[0, 1, 2] = True
    masks = MaskPair(hidden, hidden)
    changed = images[0].clone(), images[1].clone()
    for image in changed:
        image[..., 32:, 64:] = 0.5
    assert torch.equal(net(*images, masks).logits, net(*changed, masks).logits)
    assert not torch.allclose(net(*images).logits, net(*changed).logits)


def check_gradient_reaches_every_parameter(net: nn.Module, images: Pair) -> None:
    """A weighted sum of the logits has finite gradients that are not all 0."""
    logits = net(*images).logits
    weight = torch.randn(logits.shape, generator=torch.Generator().manual_seed(2))
    (logits * weight).sum().backward()
    idle = [n for n, p in net.named_parameters() if p.grad is None or not p.grad.any()]
    assert idle == []
    assert all(p.grad is not None and p.grad.isfinite().all() for p in net.parameters())


def check_nothing_is_drawn(net: nn.Module, images: Pair) -> None:
    """A forward leaves the global generator as it was."""
    state = torch.get_rng_state()
    net(*images)
    assert torch.equal(state, torch.get_rng_state())
