"""The runs of one or several tables: ``rgbt reproduce table=all scale=bench minutes=120``.

Of several tables, what decides most claims a minute is run first. Finished runs are added to an
archive, and what is in it counts as finished, so that the same command continues on any machine.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from statistics import median

from rich.console import Group

from analysis.archive import add
from rgbt.runs.provenance import machine, machine_name
from rgbt.tables import TextTable
from rgbt.terminal import info, print_rich, rich_table
from sweeps.judge.contrasts import contrasts_of
from sweeps.judge.until_decided import SeedsUntilDecided
from sweeps.plan.planner import Planner
from sweeps.plan.request import TAG, seed_of
from sweeps.point import Outcome, Point
from sweeps.run.point_list import PointList
from sweeps.run.run_store import RunStore
from sweeps.show.preview import (
    WIDTH,
    need_lines,
    print_needs,
    seconds_a_step,
    short_label,
    time_and_disk,
)
from sweeps.space import signature

# Estimated duration of a run as long as no run of its network has finished: that of an arm at
# bench scale on two cores.
DEFAULT_S = 240.0


@dataclass
class Queue:
    """The runs of tables; of several, those that decide most claims a minute first.

    A missing run is worth, for every open claim that needs it, one over the number of missing runs
    of that claim, and nothing where its table has runs of its seed by another machine: the same
    seed is another training there.
    """

    tables: Sequence[SeedsUntilDecided]
    runs: RunStore
    planner: Planner
    is_dry: bool

    def __post_init__(self) -> None:
        self._machine = machine_name(machine())
        # A plan orders what cannot start yet as if it could.
        self._wanted = ("waiting", "missing") if self.is_dry else ("waiting",)
        self._claims = self._decided = 0  # of claims about scores, see `more`
        self._worth: dict[tuple[str, ...], float] = defaultdict(float)  # by overrides of a run
        self._seconds: dict[str, list[float]] = defaultdict(list)  # of finished runs by network
        self._seen: set[int] = set()  # places of finished points
        self._owners: list[int] = []  # of every point, the place of its table
        self._points: list[Point] = []
        for place, table in enumerate(self.tables):
            points = table.judged.request.points()
            self._points += points
            self._owners += [place] * len(points)

    def point_list(self, workers: int, *, is_ranked: bool) -> PointList:
        """Return the points of all tables as one study, `is_ranked` by what they decide."""

        def announce(outcomes: Sequence[Outcome]) -> None:
            print_needs(outcomes, self.planner, self.runs.runs_dir, workers)

        request, *_ = requests = [table.judged.request for table in self.tables]
        points = tuple(self._points)
        if not is_ranked:
            title = f"{request.name} scale={request.scale}"
            more = self.tables[0] if request.until_decided else None
            own = (request.study, title, points, self.runs, self.planner)
            return PointList(*own, more, announce=announce)
        title = f"tables {request.scale}"
        identity = signature([request.study for request in requests])
        study = f"{title} {identity[:6]}"  # a driver of other tables does not run these
        own = (study, title, points, self.runs, self.planner)
        return PointList(*own, self.more, self.rank, announce)

    def more(self, outcomes: Sequence[Outcome]) -> list[Point]:
        """Return the next seeds of open claims, given all points in their order.

        It adds new finished runs to the archive, unless it `is_dry`.
        """
        self._note_finished(outcomes)
        added: list[Point] = []
        owners = list(self._owners)
        self._claims = self._decided = 0
        self._worth.clear()
        for place, table in enumerate(self.tables):
            pairs = zip(outcomes, owners, strict=True)
            own = [outcome for outcome, owner in pairs if owner == place]
            new = table(own) if table.judged.request.until_decided else []
            waiting = [outcome.point for outcome in own if outcome.state in self._wanted]
            self._count(table, own, [*waiting, *new])
            added += new
            self._owners += [place] * len(new)
        return added

    def _note_finished(self, outcomes: Sequence[Outcome]) -> None:
        """Archive the runs of newly finished points, and note how long they took."""
        archive = None if self.is_dry else self.runs.archive
        for place, outcome in enumerate(outcomes):
            if outcome.state != "finished" or place in self._seen:
                continue
            self._seen.add(place)
            for result in outcome.results:
                if archive is not None and self.runs.is_own(result):
                    add(result, archive)
            if outcome.seconds is not None:
                self._seconds[self._network(outcome.point)].append(outcome.seconds)

    def _count(
        self, seeds: SeedsUntilDecided, outcomes: Sequence[Outcome], missing: list[Point]
    ) -> None:
        """Add what the missing runs of a table are worth; claims on a design need all its rows."""
        request = seeds.judged.request
        table = request.table
        judged = replace(seeds.judged, runs={**request.runs(outcomes), **seeds.external})
        elsewhere = set()
        for outcome in outcomes:
            if any(run.machine not in ("", self._machine) for run in outcome.results):
                elsewhere.add(seed_of(outcome.point.overrides))
        rows: dict[tuple[str, ...], set[str]] = {}  # labels by the overrides of their run
        for point in missing:
            if seed_of(point.overrides) not in elsewhere:
                rows[point.overrides] = set(point.tags[TAG + request.name].split(" | "))
        sizes = {column.name for column in table.columns if column.efficiency is not None}
        for found in judged.claims:
            if sizes & set(found.claim.columns):
                continue
            self._claims += 1
            is_confirmed = found.confirmation is not None
            if is_confirmed or (found.is_decided and not request.is_confirming):
                self._decided += 1
                continue
            named: set[str] = set()
            for contrast in contrasts_of(found.claim, table):
                named |= contrast.rows
            needed = [words for words, labels in rows.items() if labels & named or not named]
            for words in needed:
                self._worth[words] += 1 / len(needed)

    def rank(self, point: Point) -> float:
        """Return the claims a second that a missing run decides, as far as that is known."""
        return self._worth[point.overrides] / self._estimated_s(point)

    def _estimated_s(self, point: Point) -> float:
        return median(self._seconds.get(self._network(point)) or [DEFAULT_S])

    def _network(self, point: Point) -> str:
        run = self.planner.composed(point)
        return "" if run is None else str(run.plain["model"]["_target_"])

    def report(self, outcomes: Sequence[Outcome], workers: int) -> int:
        """Print how several tables stand; in a dry run first their missing runs, in their order.

        Returns:
            1 if a run failed, else 0.
        """
        self.more(outcomes)
        if self.is_dry:
            needs = need_lines(outcomes, self.planner, self.runs.runs_dir, workers)
            print_rich(Group(rich_table(self._missing_runs(outcomes)), needs), width=WIDTH)
        states = Counter(outcome.state for outcome in outcomes)
        missing = f", {states['missing']} missing something" if states["missing"] else ""
        scale = self.tables[0].judged.request.scale
        info(
            f"{states['finished']} of {len(outcomes)} runs are finished, {states['failed']} "
            f"failed{missing}; {self._decided} of {self._claims} claims are decided: "
            f"rgbt claims scale={scale}"
        )
        return int(states["failed"] > 0)

    def _missing_runs(self, outcomes: Sequence[Outcome]) -> TextTable:
        names: dict[tuple[str, ...], dict[str, None]] = {}  # of tables, by overrides of a run
        missing: dict[tuple[str, ...], Point] = {}
        for outcome, owner in zip(outcomes, self._owners, strict=False):
            if outcome.state in (*self._wanted, "failed"):
                point = outcome.point
                missing.setdefault(point.overrides, point)
                name = self.tables[owner].judged.request.name
                names.setdefault(point.overrides, {})[name] = None
        step_s = seconds_a_step(outcomes, self.planner)
        rows: list[tuple[str, ...]] = []
        for point in sorted(missing.values(), key=self.rank, reverse=True):
            first, *others = names[point.overrides]
            table = f"{first} +{len(others)}" if others else first
            needs = time_and_disk(point, self.planner, step_s)
            rows.append((short_label(point), table, f"{self._worth[point.overrides]:.2f}", *needs))
        header = ("run", "table", "claims", "time", "disk", "missing")
        return TextTable("Missing runs in their order", header, tuple(rows))
