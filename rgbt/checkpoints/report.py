"""What was done with a file of weights, or why nothing was, in words."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path

from rgbt.checkpoints.layout import CLASS_PARTS, Facts
from rgbt.checkpoints.pickles import printable
from rgbt.checkpoints.plan import Plan

ANOTHER_SIZE = 0.05
"""Share of entries that do not fit, above which the network is of another size than the file."""


@dataclass(frozen=True)
class Report:
    """What was set from a file.

    Attributes:
        path: of the file.
        container: its format.
        facts: what it is.
        num_entries: of the network.
        num_set: of them, from the file.
        num_zeros: counters that the file lacks and that begin at 0.
        fresh: why entries keep their initial values -> how many.
        leftover: why names of the file have no place -> how many.
        remarks: what else one should know.
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
        """All in one line."""
        parts = [f"{self.num_set} of {self.num_entries} entries set"]
        if self.num_zeros:
            parts.append(f"{self.num_zeros} counters of batch normalisation begin at 0")
        if self.fresh:
            parts.append(f"fresh: {_reasons(self.fresh)}")
        if self.leftover:
            parts.append(f"left over in the file: {_reasons(self.leftover)}")
        return f"weights of {self.path}, {self.facts.title}: {'; '.join([*parts, *self.remarks])}"


def counted(reasons: Mapping[str, str]) -> dict[str, int]:
    """Reason -> how many names have it, most first."""
    values = list(reasons.values())
    return dict(sorted(((why, values.count(why)) for why in set(values)), key=lambda p: -p[1]))


def _reasons(counts: Mapping[str, int]) -> str:
    return ", ".join(f"{count} ({why})" for why, count in counts.items())


def refusal(path: Path, facts: Facts, plan: Plan, family: str, num_entries: int) -> str:
    """Why a file does not fit a network: what lacks, what is too much, what differs."""
    parts = [
        _some(plan.missing, "of the network not in the file"),
        _some(plan.unexpected, "of the file without a place"),
        _some([f"{entry}: {how}" for entry, how in plan.unfit.items()], "of another shape or kind"),
        _some(
            [f"{first} and {other}" for first, other in plan.torn],
            "of the network that are one tensor there and differ in the file",
        ),
    ]
    return (
        f"{path} ({facts.title}) does not fit this network: {', '.join(filter(None, parts))}"
        f"{_hint(facts, plan, family, num_entries)}"
    )


def _some(names: Collection[str], what: str) -> str:
    if not names:
        return ""
    shown = ", ".join(printable(name) for name in list(names)[:2])
    more = ", ..." if len(names) > 2 else ""
    return f"{len(names)} {'entry' if len(names) == 1 else 'entries'} {what} ({shown}{more})"


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
            f"; only what depends on the number of classes{trained} differs, start that anew with "
            f"'model.fresh=[{','.join(parts)}]'."
        )
    if plan.torn:
        return "; build the network as it was trained, such as with model.share_start=4."
    wrong = len(plan.missing) + len(plan.unfit)
    if wrong > ANOTHER_SIZE * num_entries and facts.fits:
        return f"; the file fits {' '.join(facts.fits[0])}."
    if wrong and not plan.unexpected:
        return "; parts named in 'model.fresh=[...]' keep their initial values."
    return "."
