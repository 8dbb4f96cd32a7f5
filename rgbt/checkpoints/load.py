"""Load weights from a file into a network, completely or not at all."""

from __future__ import annotations

import json
import re
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor, nn

from rgbt.checkpoints.files import Contents, in_words, read
from rgbt.checkpoints.kinds import KINDS, NONE, OWN, Kind, family_of
from rgbt.checks import InputError, not_finite, one_line
from rgbt.requirements import NetworkRecord, record_of

# Last word of batch normalisation's counters, which files of old torch versions lack.
COUNTER = "num_batches_tracked"


@dataclass(frozen=True)
class Plan:
    """The effect of a file on a network.

    Attributes:
        contents: the file, of this `kind`.
        num_entries: of the network, of which `num_set` are set.
        values: these entries -> their values, of the same shape; {} once they are set.
        zeros: counters of batch normalisation that the file lacks; they begin at 0.
        fresh: entries that keep their initial values.
        unused: names of the file without a place.
        problems: everything that does not fit, in words; none: the file fits.
    """

    contents: Contents
    kind: Kind
    num_entries: int
    num_set: int
    values: Mapping[str, Tensor]
    zeros: Sequence[str]
    fresh: Sequence[str]
    unused: Sequence[str]
    problems: Sequence[str]

    @property
    def is_own(self) -> bool:
        """Whether rgbt wrote the file."""
        return self.kind == OWN

    @property
    def convention(self) -> tuple[str, ...]:
        """Return overrides for the inputs and evaluation that the weights were trained for."""
        if self.contents.note:
            return ()
        overrides = list(self.kind.convention)
        for key, value in self.contents.settings.items():
            if key.endswith("FUSION.AGGREGATION"):
                overrides.append(f"model.fusion={str(value).lower()}")
        return tuple(overrides)

    @property
    def inputs(self) -> Mapping[str, object] | None:
        """Read `model.inputs` as an export notes it, None where it does not."""
        try:
            noted = json.loads(self.contents.note.get("inputs", ""))
        except json.JSONDecodeError:
            return None
        return noted if isinstance(noted, dict) else None

    def sentence(self) -> str:
        """Say what is set, in one line, or why the file does not fit."""
        where = f"{self.contents.path} ({self.kind.title})"
        if self.problems:
            return (
                f"{where} does not fit this network: {_some(self.problems, '; ')}. Choose the "
                "network that it was trained with, or name parts that keep their initial values "
                "with model.fresh=[...]"
            )
        parts = [f"{self.num_set} of {self.num_entries} entries set"]
        lists = {"counters begin at 0": self.zeros, "initial values": self.fresh}
        lists["unused in the file"] = self.unused
        parts += [f"{len(all_)} {what} ({_some(all_)})" for what, all_ in lists.items() if all_]
        return f"weights of {where}: {'; '.join(parts)}"


def load_weights(
    model: nn.Module, path: Path | str, fresh: tuple[str, ...] = (), *, other_classes: bool = False
) -> Plan:
    """Set the weights of a network from a file, ours or a released one.

    Every name of the file must be used or known to be unused. Every entry of the network must be
    set or known to be absent from such a file. Otherwise nothing is changed.

    Args:
        model: the network; its class says which kinds of files fit.
        path: of the file (see `rgbt.checkpoints.files.read`).
        fresh: parts that keep their initial values, by the beginning of their names.
        other_classes: whether parts whose shape differs keep their initial values too.

    Returns:
        what was set, without the values.

    Raises:
        InputError: unreadable, of another network, incomplete, or with NaN or infinity.
    """
    plan = plan_for(model, read(Path(path)), fresh, other_classes=other_classes)
    if plan.problems:
        raise InputError(f"{plan.sentence()}.")
    if broken := not_finite(plan.values):
        raise InputError(
            f"{path}: '{broken[0]}' holds NaN or infinity ({len(broken)} of {len(plan.values)} "
            "tensors do). Use a checkpoint of an earlier step."
        )
    state = model.state_dict()
    with torch.no_grad():
        for entry, value in plan.values.items():
            state[entry].copy_(value)
        for entry in plan.zeros:
            state[entry].zero_()
    return replace(plan, contents=replace(plan.contents, tensors={}), values={})


def plan_for(
    model: nn.Module,
    contents: Contents,
    fresh: tuple[str, ...] = (),
    *,
    other_classes: bool = False,
) -> Plan:
    """Find a place in `model` for every tensor of a file; arguments as of `load_weights`.

    InputError: `fresh` names no part of the network, or the file is of no kind for it.
    """
    state = model.state_dict(keep_vars=True)
    for part in fresh:
        if not any(_under(entry, (part,)) for entry in state):
            raise InputError(f"model.fresh: no name in state_dict() begins with '{part}.'")
    kind = _kind_of(model, contents)
    # This holds for a file of a backbone alone: a file of the whole network holds what was drawn.
    drawn = tuple(record_of(model, NetworkRecord).drawn_anew) if kind.fresh != NONE else ()
    tensors = dict(contents.tensors)
    sources = {entry: kind.prefix + kind.source(entry) for entry in state}
    found: dict[str, list[str]] = defaultdict(list)
    values = {}
    for entry, place in state.items():
        if _under(entry, fresh) or entry.startswith(drawn) or re.match(kind.fresh, entry):
            found["fresh"].append(entry)
            continue
        if sources[entry] not in tensors:
            found["zeros" if entry.endswith(COUNTER) else "missing"].append(entry)
            continue
        value = tensors[sources[entry]]
        value = _as_stem(value, place) if re.match(kind.stems, entry) else value
        is_kind = value.is_floating_point() == place.is_floating_point()
        if is_kind and value.shape == place.shape:
            values[entry] = value
        elif is_kind and other_classes:
            found["fresh"].append(entry)
        else:
            found["others"].append(f"{entry} is {in_words(value)} instead of {in_words(place)}")
    used = {sources[entry] for entry in state if not re.match(kind.fresh, entry)}
    for name in sorted(tensors.keys() - used):
        is_known = re.match(kind.unused, name.removeprefix(kind.prefix))
        found["unused" if is_known else "unknown"].append(name)
    problems = [
        *found["others"],
        *(f"{entry} is missing" for entry in found["missing"]),
        *(f"{name} is unknown" for name in found["unknown"]),
        *_torn(state, values),
    ]
    left = {name: found[name] for name in ("zeros", "fresh", "unused")}
    return Plan(contents, kind, len(state), len(values), values, problems=problems, **left)


def recognised(contents: Contents) -> str:
    """Say what a file is; "" for an unknown one."""
    if contents.ours:
        return OWN.title
    for of_family in KINDS.values():
        for kind in of_family:
            if kind.recognises(contents.tensors):
                return kind.title
    return ""


def _kind_of(model: nn.Module, contents: Contents) -> Kind:
    """Find the first kind of the network's family that recognises the file."""
    if contents.ours:
        return OWN
    state, family = model.state_dict(), family_of(type(model))
    for kind in KINDS.get(family, ()):
        has_needed = not kind.needs or any(entry.startswith(kind.needs) for entry in state)
        if has_needed and kind.recognises(contents.tensors):
            return kind
    if contents.tensors.keys() == state.keys():
        return Kind("state_dict() of such a network")
    if names := record_of(model, NetworkRecord).author_names:
        beginning, prefix = names
        return Kind(
            "of its author", prefix=prefix, source=lambda entry: entry.removeprefix(beginning)
        )
    what = recognised(contents) or f"with names such as {_some(list(contents.tensors))}"
    raise InputError(
        f"{contents.path} ({what}) is no file of weights for {type(model).__name__}; `rgbt weights "
        "inspect` describes it."
    )


def _as_stem(tensor: Tensor, place: Tensor) -> Tensor:
    """Convert a first convolution (C, 3, k, k) to one or four channels; others stay.

    One channel gets the mean over the file's three; a fourth one behind these gets it too.
    """
    channels = place.shape[1] if place.dim() == tensor.dim() == 4 and tensor.shape[1] == 3 else 3
    if channels not in (1, 4):
        return tensor
    mean = tensor.float().mean(1, keepdim=True)
    return mean if channels == 1 else torch.cat([tensor.float(), mean], 1)


def _torn(state: Mapping[str, Tensor], values: Mapping[str, Tensor]) -> Iterator[str]:
    """Yield entries that share one parameter but would get different values."""
    shared: dict[int, str] = {}
    for other, value in values.items():
        first = shared.setdefault(id(state[other]), other)
        if first != other and not torch.equal(values[first], value):
            yield f"{first} and {other} are one in the network but differ in the file"


def _under(entry: str, parts: tuple[str, ...]) -> bool:
    return any(f"{entry}.".startswith(f"{part.rstrip('.')}.") for part in parts)


def _some(names: Sequence[str], separator: str = ", ") -> str:
    """Write the first names of a list."""
    shown = separator.join(one_line(name) for name in names[:3])
    return shown + f"{separator}and {len(names) - 3} more" * (len(names) > 3)
