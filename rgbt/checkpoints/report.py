"""Describe a file of weights, and report which entries of a network it sets."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

from rich.console import RenderableType
from rich.text import Text
from torch import Tensor

from rgbt.checkpoints.layout import CLASS_PARTS, Facts
from rgbt.checkpoints.plan import Plan
from rgbt.checkpoints.read import Contents
from rgbt.checks import one_line

ANOTHER_SIZE = 0.05
"""Share of entries that do not fit above which the network is assumed to have another size."""


@dataclass(frozen=True)
class Report:
    """The entries that were set from a file.

    Attributes:
        path: of the file.
        container: its format.
        facts: what it is.
        num_entries: of the network.
        num_set: of them, from the file.
        num_zeros: counters that the file lacks and that begin at 0.
        fresh: why entries keep their initial values -> how many.
        leftover: why names of the file have no place -> how many.
        remarks: further remarks for the user.
    """

    path: Path
    container: str
    facts: Facts
    num_entries: int
    num_set: int
    num_zeros: int
    fresh: Mapping[str, int]
    leftover: Mapping[str, int]
    remarks: tuple[str, ...]

    def sentence(self) -> str:
        """All counts in one line."""
        parts = [f"{self.num_set} of {self.num_entries} entries set"]
        if self.num_zeros:
            parts.append(f"{self.num_zeros} counters of batch normalisation begin at 0")
        if self.fresh:
            parts.append(f"fresh: {_reasons(self.fresh)}")
        if self.leftover:
            parts.append(f"unused entries of the file: {_reasons(self.leftover)}")
        return f"weights of {self.path}, {self.facts.title}: {'; '.join([*parts, *self.remarks])}"


def counted(reasons: Mapping[str, str]) -> dict[str, int]:
    """Reason -> how many names have it, most first."""
    values = list(reasons.values())
    return dict(sorted(((why, values.count(why)) for why in set(values)), key=lambda p: -p[1]))


def _reasons(counts: Mapping[str, int]) -> str:
    return ", ".join(f"{count} ({why})" for why, count in counts.items())


def refusal(path: Path, facts: Facts, plan: Plan, family: str, num_entries: int) -> str:
    """Why a file does not fit a network: missing, unexpected and different entries."""
    parts = [
        _some(plan.missing, "of the network missing from the file"),
        _some(plan.unexpected, "of the file unknown to the network"),
        _some(_unfit(plan), "of another shape or kind"),
        _some(_torn(plan), "that share one tensor in the network but differ in the file"),
    ]
    return (
        f"{path} ({facts.title}) does not fit this network: {', '.join(filter(None, parts))}"
        f"{_hint(facts, plan, family, num_entries)}"
    )


def _some(names: Collection[str], what: str) -> str:
    if not names:
        return ""
    return f"{len(names)} {'entry' if len(names) == 1 else 'entries'} {what} ({_first(names, 2)})"


def _unfit(plan: Plan) -> list[str]:
    return [f"{entry}: {how}" for entry, how in plan.unfit.items()]


def _torn(plan: Plan) -> list[str]:
    return [f"{first} and {other}" for first, other in plan.torn]


def _hint(facts: Facts, plan: Plan, family: str, num_entries: int) -> str:
    parts = [
        part
        for part in CLASS_PARTS.get(family, ())
        if any(entry.startswith(f"{part}.") for entry in plan.unfit)
    ]
    by_class = all(entry.startswith(tuple(f"{part}." for part in parts)) for entry in plan.unfit)
    if plan.unfit and by_class and not (plan.missing or plan.unexpected):
        trained = "" if facts.classes is None else f" (the file has {facts.classes})"
        return (
            f". Only parts that depend on the number of classes{trained} differ; initialise them "
            f"at random with 'model.fresh=[{','.join(parts)}]'."
        )
    if plan.torn:
        tokens = all(first.endswith("mask_token") for first, _ in plan.torn)
        setting = "model.mask_token=branch" if tokens else "model.share_start=4"
        return f". Build the network as it was trained, for example with {setting}."
    wrong = len(plan.missing) + len(plan.unfit)
    if wrong > ANOTHER_SIZE * num_entries and facts.fits:
        return f". The file fits {' '.join(facts.fits[0])}."
    if wrong and not plan.unexpected:
        return ". Name parts in 'model.fresh=[...]' to keep their initial values."
    return "."


NOT_TRAINED = (
    *("running_mean", "running_var", "num_batches_tracked"),
    *("relative_position_index", "attn_mask", "empty_weight"),
    *("rope_embed.periods", "qkv.bias_mask"),
)
"""Last words of the names of buffers."""

MILLION = 1e6


def count_parameters(tensors: Mapping[str, Tensor]) -> int:
    """Number of trained values; a tensor under two names counts once."""
    trained = {
        (tensor.data_ptr() or name, tensor.shape): tensor.numel()
        for name, tensor in tensors.items()
        if tensor.is_floating_point() and not name.endswith(NOT_TRAINED)
    }
    return sum(trained.values())


def facts_view(
    contents: Contents, facts: Facts, more: Iterable[tuple[str, str]] = ()
) -> RenderableType:
    """The description of the file, as lines; `more` follows what it fits."""
    tensors = contents.tensors.values()
    kinds = sorted({str(tensor.dtype).removeprefix("torch.") for tensor in tensors})
    size = contents.path.stat().st_size / MILLION
    where = f", under '{contents.where}'" if contents.where else ""
    taken = f", prefix '{contents.prefix}' removed from every name" if contents.prefix else ""
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
        *more,
        *((("windows", f"{facts.window} x {facts.window} tokens"),) if facts.window else ()),
        *(("remark", remark) for remark in facts.remarks),
        *((f"note {one_line(key)}", one_line(contents.note[key])) for key in notes),
    ]
    if not facts.family and not facts.fits:
        lines.append(("names", _first(contents.tensors, 8)))
    width = max(len(name) for name, _ in lines)
    return Text("\n".join(f"{name:<{width}}  {value}" for name, value in lines), no_wrap=True)


PLAN_HEADER = ("", "tensors", "why", "such as")


def plan_rows(plan: Plan) -> tuple[tuple[str, str, str, str], ...]:
    """The effect on a network, one row per reason, columns as in `PLAN_HEADER`."""
    rows: list[tuple[str, str, Iterable[str]]] = [
        ("set", "", [entry for entry in plan.values if entry not in plan.unfit]),
        ("begin at 0", "counters that the file lacks", plan.zeros),
        *(("keep initial values", why, names) for why, names in _by_reason(plan.fresh)),
        *(("unused", why, names) for why, names in _by_reason(plan.leftover)),
        ("MISSING", "in the network, but not in the file", plan.missing),
        ("UNEXPECTED", "in the file, but not in the network", plan.unexpected),
        ("DIFFERENT", "of another shape or kind", _unfit(plan)),
        ("TORN", "one tensor in the network, two in the file", _torn(plan)),
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
    return ", ".join(one_line(name) for name in listed[:count]) + more
