"""What a file of weights is and what it would do, for a terminal."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from rich.console import RenderableType
from rich.text import Text
from torch import Tensor

from rgbt.checkpoints.layout import Facts
from rgbt.checkpoints.pickles import printable
from rgbt.checkpoints.plan import Plan
from rgbt.checkpoints.read import Contents

NOT_TRAINED = (
    *("running_mean", "running_var", "num_batches_tracked"),
    *("relative_position_index", "attn_mask", "empty_weight"),
)
"""Last words of the names of buffers."""

MILLION = 1e6


def count_parameters(tensors: Mapping[str, Tensor]) -> int:
    """Numbers that were trained; what lies under two names counts once."""
    trained = {
        (tensor.data_ptr() or name, tensor.shape): tensor.numel()
        for name, tensor in tensors.items()
        if tensor.is_floating_point() and not name.endswith(NOT_TRAINED)
    }
    return sum(trained.values())


def facts_view(contents: Contents, facts: Facts) -> RenderableType:
    """What the file is, line by line."""
    tensors = contents.tensors.values()
    kinds = sorted({str(tensor.dtype).removeprefix("torch.") for tensor in tensors})
    size = contents.path.stat().st_size / MILLION
    where = f", under '{contents.where}'" if contents.where else ""
    taken = f", '{contents.prefix}' taken off every name" if contents.prefix else ""
    parameters = count_parameters(contents.tensors)
    notes = sorted(contents.note)
    lines = [
        ("file", f"{contents.path} ({size:.1f} MB)"),
        ("what", facts.title),
        ("container", f"{contents.container}{where}{taken}"),
        *((("beside them", ", ".join(contents.others)),) if contents.others else ()),
        ("tensors", f"{len(tensors)} ({', '.join(kinds)})"),
        ("parameters", f"{parameters:,} ({parameters / MILLION:.2f} M)"),
        *(("fits", " ".join(overrides)) for overrides in facts.fits or (("no published size",),)),
        *((("windows", f"{facts.window} x {facts.window} tokens"),) if facts.window else ()),
        *(("remark", remark) for remark in facts.remarks),
        *((f"note {printable(key, 20)}", printable(contents.note[key], 600)) for key in notes),
    ]
    if not facts.family and not facts.fits:
        lines.append(("names", _first(contents.tensors, 8)))
    width = max(len(name) for name, _ in lines)
    return Text("\n".join(f"{name:<{width}}  {value}" for name, value in lines), no_wrap=True)


PLAN_HEADER = ("", "tensors", "why", "such as")


def plan_rows(plan: Plan) -> tuple[tuple[str, str, str, str], ...]:
    """What would happen to a network, one row per reason, columns as in `PLAN_HEADER`."""
    unfit = [f"{entry}: {how}" for entry, how in plan.unfit.items()]
    torn = [f"{first} and {other}" for first, other in plan.torn]
    rows: list[tuple[str, str, Iterable[str]]] = [
        ("set", "", [entry for entry in plan.values if entry not in plan.unfit]),
        ("begin at 0", "counters that the file lacks", plan.zeros),
        *(("stay fresh", why, names) for why, names in _by_reason(plan.fresh)),
        *(("left over", why, names) for why, names in _by_reason(plan.leftover)),
        ("MISSING", "the network has them, the file does not", plan.missing),
        ("UNEXPECTED", "the file has them, the network does not", plan.unexpected),
        ("DIFFERENT", "of another shape or kind", unfit),
        ("TORN", "one tensor in the network, two in the file", torn),
    ]
    listed = ((what, why, list(names)) for what, why, names in rows)
    return tuple(
        (what, str(len(names)), why, "" if what == "set" else _first(names, 1))
        for what, why, names in listed
        if names
    )


def _by_reason(reasons: Mapping[str, str]) -> list[tuple[str, list[str]]]:
    found: dict[str, list[str]] = {}
    for name, why in reasons.items():
        found.setdefault(why, []).append(name)
    return list(found.items())


def _first(names: Iterable[str], count: int) -> str:
    listed = list(names)
    more = ", ..." if len(listed) > count else ""
    return ", ".join(printable(name) for name in listed[:count]) + more
