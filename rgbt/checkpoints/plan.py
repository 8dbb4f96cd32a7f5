"""Assign the tensors of a file to the entries of a network, and list what does not fit."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

import torch
from torch import Tensor

from rgbt.checkpoints.layout import COUNTER, Rule, reason
from rgbt.checks import InputError, nearest

NAMED_FRESH = "named in model.fresh"
OTHER_SHAPE = "of another shape in the common start, which has other classes"


@dataclass
class Plan:
    """The effect of a file on a network.

    Attributes:
        tensors: of the file, by name.
        values: entry of the network -> name in the file.
        zeros: counters of batch normalisation that the file lacks; they begin at 0.
        fresh: entry that keeps its initial value -> why.
        leftover: name in the file without a place -> why.
        missing: entries that the file should hold but does not.
        unexpected: names in the file that nothing explains.
        unfit: entry -> how the file's tensor differs in shape or kind.
        torn: pairs of entries that share one tensor in the network but differ in the file.
    """

    tensors: Mapping[str, Tensor] = field(default_factory=dict)
    values: dict[str, str] = field(default_factory=dict)
    zeros: list[str] = field(default_factory=list)
    fresh: dict[str, str] = field(default_factory=dict)
    leftover: dict[str, str] = field(default_factory=dict)
    missing: list[str] = field(default_factory=list)
    unexpected: list[str] = field(default_factory=list)
    unfit: dict[str, str] = field(default_factory=dict)
    torn: list[tuple[str, str]] = field(default_factory=list)

    @property
    def fits(self) -> bool:
        """Every name is used or explained, every entry set or explained."""
        return not (self.missing or self.unexpected or self.unfit or self.torn)

    def put(self, entry: str, name: str, difference: str, *, other_classes: bool) -> None:
        """Assign the tensor `name` to an entry, which it fits without a `difference`."""
        if difference and other_classes:
            self.fresh[entry] = self.leftover[name] = OTHER_SHAPE
            return
        self.values[entry] = name
        if difference:
            self.unfit[entry] = difference


def make_plan(
    state: Mapping[str, Tensor],
    tensors: Mapping[str, Tensor],
    rule: Rule,
    *,
    prefix: str,
    fresh: tuple[str, ...],
    other_classes: bool = False,
) -> Plan:
    """Find a place for everything.

    Args:
        state: entries of the network, as `state_dict(keep_vars=True)` gives them.
        tensors: of the file.
        rule: how this network is filled from this kind of file.
        prefix: before every name in the file that belongs to the network.
        fresh: parts that keep their initial values, by the beginning of their names.
        other_classes: whether an entry of another shape keeps its initial values; False: it does
            not fit.

    Raises:
        InputError: a part in `fresh` that the network does not have.
    """
    check_parts(fresh, state)
    plan, explained = Plan(tensors), {}
    for entry, value in state.items():
        name = prefix + rule.source(entry)
        if _under(entry, fresh):
            plan.fresh[entry] = explained[name] = NAMED_FRESH
        elif why := reason(rule.fresh, entry):
            plan.fresh[entry] = why
        elif name in tensors:
            difference = _difference(tensors[name], value, entry, rule)
            plan.put(entry, name, difference, other_classes=other_classes)
        elif entry.endswith(COUNTER):
            plan.zeros.append(entry)
        else:
            plan.missing.append(entry)
    used = {*plan.values.values(), *plan.leftover}
    for name in (name for name in tensors if name not in used):
        why = explained.get(name) or reason(rule.leftover, name.removeprefix(prefix))
        if why:
            plan.leftover[name] = why
        else:
            plan.unexpected.append(name)
    if not plan.unfit:
        plan.torn = list(_torn(state, tensors, plan.values))
    return plan


def adapted(tensor: Tensor, value: Tensor) -> Tensor:
    """A file's tensor for an entry of the network: the same, or of another shape.

    One input channel gets the mean over the file's; channels behind the file's get it too. A first
    position that the file lacks is 0.

    Args:
        tensor: (C, c, k, k) or (1, n - 1, d) where the shapes differ.
        value: (C, c', k, k), c' = 1 or more than c, or (1, n, d).
    """
    if tensor.shape == value.shape:
        return tensor
    if tensor.dim() == 3:
        return torch.cat([torch.zeros_like(tensor[:, :1]), tensor], 1)
    mean = tensor.float().mean(1, keepdim=True)
    if value.shape[1] == 1:
        return mean
    extra = value.shape[1] - tensor.shape[1]
    return torch.cat([tensor.float(), *[mean] * extra], 1)


def check_parts(parts: tuple[str, ...], state: Mapping[str, Tensor]) -> None:
    """Raise InputError where a part is not the beginning of an entry's name."""
    for part in parts:
        if not any(_under(entry, (part,)) for entry in state):
            words = [entry.split(".") for entry in state]
            known = {".".join(each[:n]) for each in words for n in (1, 2, 3)}
            close = nearest(part, known).split("known: ")[0].rstrip("? ")
            hint = f" ({close}?)" if close else ""
            raise InputError(
                f"model.fresh: the network has no part '{part}'{hint}; name a part by the "
                "beginning of its names in state_dict()."
            )


def _under(entry: str, parts: tuple[str, ...]) -> bool:
    return any(entry == part or entry.startswith(f"{part.rstrip('.')}.") for part in parts)


def _difference(tensor: Tensor, value: Tensor, entry: str, rule: Rule) -> str:
    """How a file's tensor does not fit an entry, "" where it does."""
    if tensor.is_floating_point() != value.is_floating_point():
        kinds = [str(each.dtype).removeprefix("torch.") for each in (tensor, value)]
        return f"file {kinds[0]}, network {kinds[1]}"
    found, own = tuple(tensor.shape), tuple(value.shape)
    if found == own:
        return ""
    is_table = entry in rule.positions and len(found) == len(own) == 3
    if is_table and (found[0], found[1] + 1, found[2]) == own:
        return ""
    if entry in rule.stems and len(found) == len(own) == 4 and found[1] == 3 and own[1] in (1, 4):
        found, own = (found[0], *found[2:]), (own[0], *own[2:])
        if found == own:
            return ""
    return f"file {_shape(tensor)}, network {_shape(value)}"


def _shape(tensor: Tensor) -> str:
    return " x ".join(map(str, tensor.shape)) or "one number"


def _torn(
    state: Mapping[str, Tensor], tensors: Mapping[str, Tensor], values: Mapping[str, str]
) -> Iterator[tuple[str, str]]:
    """Entries that share one parameter but would get different values."""
    shared: dict[int, list[str]] = defaultdict(list)
    for entry in values:
        shared[id(state[entry])].append(entry)
    for first, *others in shared.values():
        for other in others:
            if not torch.equal(tensors[values[first]], tensors[values[other]]):
                yield first, other
