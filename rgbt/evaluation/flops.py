"""Count floating-point operations of a prediction, and name the operations that are not counted.

The count is that of `torch.utils.flop_counter`: two operations for each multiplication with its
addition, of convolutions and matrix products. It has no formula for normalisation, activation,
softmax, resizing, sampling and sums, which are not counted.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from torch.nn.attention import SDPBackend, sdpa_kernel
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils.flop_counter import FlopCounterMode, flop_registry

MOVES = frozenset(
    (
        *("_local_scalar_dense", "_to_copy", "_unsafe_index", "_unsafe_view", "alias", "arange"),
        *("cat", "clone", "constant_pad_nd", "contiguous", "copy_", "device", "detach", "empty"),
        *("empty_like", "fill_", "flip", "full", "full_like", "gather", "index", "index_select"),
        *("lift_fresh", "linspace", "masked_fill", "masked_fill_", "ones", "ones_like"),
        *("reflection_pad2d", "repeat", "replication_pad2d", "roll", "scalar_tensor", "scatter"),
        *("select_scatter", "slice_scatter", "stack", "where", "zeros", "zeros_like", "zero_"),
    )
)
"""Operations that create or move values and calculate nothing, by name."""


@dataclass(frozen=True)
class FlopCount:
    """Operations of one call.

    Attributes:
        total: floating-point operations with a formula; a multiplication and its addition are two.
        uncounted: operation without a formula -> values that it calculated.
    """

    total: int
    uncounted: Mapping[str, int] = field(default_factory=dict)


def count_flops(call: Callable[[], object]) -> FlopCount:
    """Count the operations of one call.

    Attention is computed as matrix products and a softmax, because the fused operation of some
    devices has no formula. So every device gives the same count.
    """
    seen = _Uncounted()
    # `seen` is outside: it gets what the counter has divided into parts.
    with sdpa_kernel(SDPBackend.MATH), seen, FlopCounterMode(display=False) as counter:
        call()
    names = dict(seen.values.most_common())
    return FlopCount(int(counter.get_total_flops()), names)


class _Uncounted(TorchDispatchMode):  # type: ignore[no-untyped-call]
    """Sums the sizes of the results of operations that have no formula."""

    def __init__(self) -> None:
        super().__init__()  # type: ignore[no-untyped-call]
        self.values: Counter[str] = Counter()

    def __torch_dispatch__(
        self,
        func: Any,
        types: Sequence[type],
        args: tuple[Any, ...] = (),
        kwargs: Mapping[str, Any] | None = None,
    ) -> Any:
        result = func(*args, **(kwargs or {}))
        name = func.overloadpacket.__name__
        if func.overloadpacket not in flop_registry and not func.is_view and name not in MOVES:
            first = result[0] if isinstance(result, tuple | list) and result else result
            if isinstance(first, torch.Tensor):
                self.values[name] += first.numel()
        return result
