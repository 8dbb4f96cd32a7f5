"""Claims as texts, for the page and for the results pages: verdicts, numbers, sums by paper."""

from __future__ import annotations

import math
import shlex
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import chain, groupby

from analysis.report.data import ClaimEntry, VerdictWord
from analysis.report.views import DASH, FORMS, TableView, plural, unique_names

VERDICTS: dict[VerdictWord, str] = {
    "holds": "✓ holds",
    "contradicted": "✗ contradicted",
    "undecided": "? undecided",
    "not run": f"{DASH} not run",
}
"""Every verdict with a sign, so that colour is never the only mark."""

MOST_LISTED = 3
"""Rows without a run that are named."""

DATA_WORDS = ("dataset=", "dataset.")
FOLDERS = ("dataset.root=", "dataset.cache_dir=")

IMAGES = "images alone"
"""What an interval covers, and in the place of the number of seeds where nothing has seeds."""


@dataclass(frozen=True)
class PlacedClaim:
    """A claim with the table that it is about.

    Attributes:
        panel: address of what opens behind its verdict; "" where nothing was run.
    """

    entry: ClaimEntry
    view: TableView
    panel: str

    @property
    def text(self) -> str:
        """What the filter of the claims looks through."""
        entry, table = self.entry, self.view.entry
        words = (entry.name, entry.says, entry.source, entry.contrast, entry.verdict)
        return " ".join((table.name, table.number, *words)).lower()


@dataclass(frozen=True)
class PaperClaims:
    """The claims of a paper at one scale, on the data of the scale or on others, in one form.

    Attributes:
        id: its anchor.
        title: the paper, with scale, data and form where something was run.
        data: overrides that chose other data, such as "dataset=mfnet"; "": those of the scale.
        claims: of its tables in their order.
    """

    id: str
    paper: str
    scale: str
    data: str
    form: str
    claims: tuple[PlacedClaim, ...]

    @property
    def run_as(self) -> str:
        """Scale, data and form; "" where nothing was run."""
        scale = f"{self.scale} scale" if self.scale else ""
        return ", ".join(filter(None, (scale, self.data, self.form)))

    @property
    def title(self) -> str:
        """The paper, with scale, data and form where something was run."""
        return ", ".join(filter(None, (self.paper, self.run_as)))

    @property
    def counted(self) -> str:
        """How many claims there are by verdict."""
        return counted(each.entry for each in self.claims)

    @property
    def judged(self) -> list[PlacedClaim]:
        """The claims with a verdict."""
        return [each for each in self.claims if not _is_waiting(each)]

    def count(self, verdict: VerdictWord) -> int:
        """Number of claims with a verdict."""
        return sum(each.entry.verdict == verdict for each in self.claims)

    def printed(self, agree: bool) -> int:
        """Number of claims that the printed values agree with, or do not agree with."""
        return sum(each.entry.as_printed is agree for each in self.claims)


def placed(view: TableView) -> list[PlacedClaim]:
    """The claims of a table."""
    return [
        PlacedClaim(entry, view, f"claim={view.id}/{index}" if entry.runs else "")
        for index, entry in enumerate(view.entry.claims)
    ]


def paper_claims(tables: Iterable[TableView]) -> list[PaperClaims]:
    """The claims of every paper, once for each scale, data set and form that some table was run in.

    A claim of a table that was run several times, with other rows or overrides, is counted once: by
    the most seeds, whatever its verdicts. Runs of different scales or data are never in one
    verdict. Tables that were not run in such a way have claims that are not run.
    """
    order = sorted(tables, key=lambda view: (view.entry.paper, view.entry.name))
    groups = [(paper, list(views)) for paper, views in groupby(order, lambda v: v.entry.paper)]
    made = [
        (paper, variant, _claims_of(views, variant))
        for paper, views in groups
        for variant in _variants(views)
    ]
    made = [each for each in made if each[2]]
    ids = unique_names(f"claims {paper} {' '.join(variant)}" for paper, variant, _ in made)
    return [
        PaperClaims(id_, paper, *variant, claims)
        for id_, (paper, variant, claims) in zip(ids, made, strict=True)
    ]


Variant = tuple[str, str, str]
"""Scale, data and form."""


def _variants(views: Sequence[TableView]) -> list[Variant]:
    """The ways in which the tables were run; ("", "", "") where none was."""
    run = [view for view in views if view.is_run and view.entry.form != "both"]
    return sorted({_variant(view) for view in run}) or [("", "", "")]


def _variant(view: TableView) -> Variant:
    return view.entry.scale, chosen_data(view.entry.extra), FORMS[view.entry.form]


def chosen_data(extra: str) -> str:
    """The overrides of a table that choose other images than those of the scale.

    Args:
        extra: `TableEntry.extra`. Folders are left out: the same images may lie anywhere.
    """
    words = [word for word in shlex.split(extra) if word.startswith(DATA_WORDS)]
    return " ".join(sorted(word for word in words if not word.startswith(FOLDERS)))


def _claims_of(views: Sequence[TableView], variant: Variant) -> tuple[PlacedClaim, ...]:
    """The claims of each table: of its variant where it was run, else as not run."""
    claims: list[PlacedClaim] = []
    for _, group in groupby(views, lambda view: view.entry.name):
        of_table = list(group)
        fitting = [placed(v) for v in of_table if v.is_run and _variant(v) == variant]
        of_claims = _by_name(fitting or [list(map(_not_run, placed(of_table[0])))])
        claims += sorted(map(_with_most_seeds, of_claims), key=_is_waiting)
    return tuple(claims)


def _by_name(tables: Iterable[Sequence[PlacedClaim]]) -> Iterable[list[PlacedClaim]]:
    """Every claim as each of the tables has it."""
    found: dict[str, list[PlacedClaim]] = {}
    for each in chain.from_iterable(tables):
        found.setdefault(each.entry.name, []).append(each)
    return found.values()


def _with_most_seeds(claims: Sequence[PlacedClaim]) -> PlacedClaim:
    return max(claims, key=lambda each: (not _is_waiting(each), each.entry.seeds))


def _is_waiting(claim: PlacedClaim) -> bool:
    return claim.entry.verdict == "not run"


def _not_run(claim: PlacedClaim) -> PlacedClaim:
    entry = claim.entry
    plain = ClaimEntry(
        name=entry.name,
        says=entry.says,
        source=entry.source,
        remarks=entry.remarks,
        verdict="not run",
        contrast=entry.contrast,
        printed=entry.printed,
        as_printed=entry.as_printed,
    )
    return claim if entry.verdict == "not run" else PlacedClaim(plain, claim.view, "")


def counted(claims: Iterable[ClaimEntry]) -> str:
    """``12 claims: 1 holds, 0 contradicted, 4 undecided, 7 not run``."""
    words = Counter(each.verdict for each in claims)
    parts = ", ".join(f"{words[verdict]} {verdict}" for verdict in VERDICTS)
    return f"{plural(words.total(), 'claim')}: {parts}"


def seeds(entry: ClaimEntry) -> str:
    """Number of paired seeds."""
    if entry.verdict == "not run":
        return DASH
    return IMAGES if entry.seeds == 0 else str(entry.seeds)


def needed(entry: ClaimEntry) -> str:
    """Number of seeds that would decide an open claim."""
    if entry.verdict != "undecided" or entry.seeds_needed is None:
        return DASH
    return "no number" if math.isinf(entry.seeds_needed) else f"{entry.seeds_needed:.0f}"


def printed_sentence(entry: ClaimEntry) -> str:
    """Whether the printed values agree with the statement."""
    if entry.as_printed is None:
        return "The paper does not print all of its values."
    return f"The printed values {'agree' if entry.as_printed else 'do not agree'}."


def why(entry: ClaimEntry) -> str:
    """Why a claim is undecided or not run; "" where there is nothing to say."""
    if entry.verdict == "not run" and entry.missing:
        more = len(entry.missing) - MOST_LISTED
        rest = f" and {more} more rows" if more > 0 else ""
        return f"Not run: {', '.join(entry.missing[:MOST_LISTED])}{rest}."
    return entry.reason[:1].upper() + entry.reason[1:]
