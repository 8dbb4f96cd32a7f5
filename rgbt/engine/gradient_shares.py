"""Share of each loss term in the gradient of a phase (`trainer.log_gradient_shares`).

Terms are the named parts of a phase (`loss/NAME` of the same line). For term k, g_k is the gradient
of its weighted value by the parameters that the phase steps, and g the sum of all g_k:

    share_k = <g_k, g> / |g|^2        the projection on the total: all shares add to 1
    ratio_k = |g_k| / |g|             the size; terms that oppose each other may be above 1

To first order, a small step against g raises a term with a negative share. Both are of the gradient
before clipping. What a parameter keeps from an earlier phase is not part of g.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence

import torch
from torch import Tensor, nn

from rgbt.engine.gradients import average_tensors

GRADIENT_SHARE, GRADIENT_RATIO = "gradient_share", "gradient_ratio"


def gradient_share(term: str, optimizers: str = "") -> str:
    """The name of a share in the log: "gradient_share/sdc".

    `optimizers` are those of the phase, in a run with several: "gradient_share/critic/NAME".
    """
    return "/".join(filter(None, (GRADIENT_SHARE, optimizers, term)))


def gradient_ratio(term: str, optimizers: str = "") -> str:
    """The name of a ratio in the log, as `gradient_share`."""
    return "/".join(filter(None, (GRADIENT_RATIO, optimizers, term)))


class TermGradients:
    """The gradient of every term of one phase, summed over its accumulated batches.

    They are computed beside the backward pass, which they do not change: one more pass and one copy
    of the parameters in memory for each term.

    Args:
        parameters: those that the phase steps; frozen ones are left out.
        backward: runs a backward pass with the arguments of `Tensor.backward`, as Fabric does.
    """

    def __init__(self, parameters: Sequence[nn.Parameter], backward: Callable[..., None]) -> None:
        self._backward = backward
        self._parameters = [each for each in parameters if each.requires_grad]
        self._terms: dict[str, list[Tensor]] = {}

    def add(self, parts: Mapping[str, Tensor], factor: float) -> None:
        """Add `factor` times the gradients of named scalars; their graphs are kept."""
        for name, part in parts.items():
            so_far = self._terms.setdefault(name, [torch.zeros_like(p) for p in self._parameters])
            if not part.requires_grad:
                continue
            for total, gradient in zip(so_far, self._gradients(part * factor), strict=True):
                if gradient is not None:
                    total += gradient

    def _gradients(self, cost: Tensor) -> list[Tensor | None]:
        """The gradient of each parameter; what the parameters hold as theirs stays."""
        kept = [each.grad for each in self._parameters]
        try:
            for each in self._parameters:
                each.grad = None
            self._backward(cost, inputs=self._parameters, retain_graph=True)
            return [each.grad for each in self._parameters]
        finally:
            for each, gradient in zip(self._parameters, kept, strict=True):
                each.grad = gradient

    def shares(self, optimizers: str) -> dict[str, float]:
        """Shares and ratios of all terms, by the names that they have in ``metrics.jsonl``.

        Args:
            optimizers: names of the optimisers of the phase, "" if there is only one in the run.

        Returns:
            nothing where the gradient is zero or not finite, because there are no shares then.
        """
        for gradients in self._terms.values():
            average_tensors(gradients)
        total = [torch.stack(each).sum(0) for each in zip(*self._terms.values(), strict=True)]
        products = {name: _product(each, total) for name, each in self._terms.items()}
        whole = _product(total, total)
        if not whole > 0 or not math.isfinite(whole):
            return {}
        shares = {
            gradient_share(name, optimizers): product / whole for name, product in products.items()
        }
        ratios = {
            gradient_ratio(name, optimizers): math.sqrt(_product(each, each) / whole)
            for name, each in self._terms.items()
        }
        return shares | ratios


def _product(first: Sequence[Tensor], second: Sequence[Tensor]) -> float:
    """Inner product of two gradients."""
    by_parameter = [(a * b).sum() for a, b in zip(first, second, strict=True)]
    return sum(torch.stack(by_parameter).tolist()) if by_parameter else 0.0


def shares_sentence(lines: Iterable[Mapping[str, float]]) -> str:
    """The mean share of every term over lines of the log, in words; "" without any.

    Examples:
        >>> shares_sentence([{"gradient_share/ce": 0.9, "gradient_share/sdc": 0.1, "loss": 2.0}])
        'mean share of the gradient by loss term: ce 90.0 %, sdc 10.0 %'
    """
    found: dict[str, list[float]] = {}
    for values in lines:
        for name, value in values.items():
            kind, _, term = name.partition("/")
            if kind == GRADIENT_SHARE:
                found.setdefault(term, []).append(value)
    means = {term: round(100 * sum(each) / len(each), 1) for term, each in found.items()}
    shown = [f"{term} {mean or 0.0:.1f} %" for term, mean in means.items()]  # no minus before 0
    return f"mean share of the gradient by loss term: {', '.join(shown)}" if shown else ""
