"""Several tables at once: ``rgbt reproduce table=all scale=bench seeds=until_decided minutes=120``.

What decides most claims a minute is run first. Finished runs are added to an archive, and what is
in it counts as finished, so that the same command continues on any machine.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from statistics import median

from analysis.archive import add
from rgbt.checks import InputError
from rgbt.runs.provenance import machine, machine_name
from rgbt.tables import TextTable
from rgbt.terminal import info, print_rich, rich_table
from sweeps.judge.contrasts import contrasts_of
from sweeps.judge.judged_table import JudgedTable
from sweeps.judge.until_decided import SeedsUntilDecided
from sweeps.plan.planner import Planner
from sweeps.plan.request import TAG, TableRequest, seed_of
from sweeps.point import Outcome, Point
from sweeps.run.point_list import PointList, commands_line, preview_points, run_points
from sweeps.run.run_store import RunStore
from sweeps.settings import SweepSettings
from sweeps.space import signature

# Estimated duration of a run as long as no run of its network has finished: that of an arm at
# bench scale on two cores.
DEFAULT_S = 240.0


@dataclass
class Queue:
    """The runs of several tables, those that decide most claims a minute first.

    A missing run is worth, for every open claim that needs it, one over the number of missing runs
    of that claim, and nothing where its table has runs of its seed by another machine: the same
    seed is another training there. `claims` and `decided` count claims about scores, see `more`.
    """

    requests: Sequence[TableRequest]
    runs: RunStore
    planner: Planner
    max_seeds: int
    is_dry: bool = False
    claims: int = 0
    decided: int = 0
    machine: str = field(default_factory=lambda: machine_name(machine()))
    # Worth of a run by its overrides; seconds of finished runs by their network.
    _worth: dict[tuple[str, ...], float] = field(default_factory=lambda: defaultdict(float))
    _seconds: dict[str, list[float]] = field(default_factory=lambda: defaultdict(list))
    _seen: set[int] = field(default_factory=set)  # places of finished points

    def __post_init__(self) -> None:
        self._tables: list[SeedsUntilDecided] = []
        self._owners: list[int] = []  # of every point, the place of its table
        points: list[Point] = []
        for place, request in enumerate(self.requests):
            # Nothing is counted of the networks themselves.
            judged = JudgedTable(request=request)
            self._tables.append(SeedsUntilDecided(judged, self.max_seeds))
            of_table = request.points()
            points += of_table
            self._owners += [place] * len(of_table)
        self.points = tuple(points)

    def more(self, outcomes: Sequence[Outcome]) -> list[Point]:
        """Return the next seeds of open claims, given all points in their order.

        It adds new finished runs to the archive, unless it `is_dry`.
        """
        self._note_finished(outcomes)
        added: list[Point] = []
        owners = list(self._owners)
        self.claims = self.decided = 0
        self._worth.clear()
        for place, table in enumerate(self._tables):
            pairs = zip(outcomes, owners, strict=True)
            own = [outcome for outcome, owner in pairs if owner == place]
            new = table(own) if table.judged.request.until_decided else []
            waiting = [outcome.point for outcome in own if outcome.state == "waiting"]
            self._count(table, own, [*waiting, *new])
            added += new
            self._owners += [place] * len(new)
        return added

    def _note_finished(self, outcomes: Sequence[Outcome]) -> None:
        """Archive the runs of newly finished points, and note how long they took."""
        archive = None if self.is_dry else self.runs.archive
        seen, self._seen = self._seen, set()
        for place, outcome in enumerate(outcomes):
            if outcome.state != "finished":
                continue
            self._seen.add(place)
            if place in seen:
                continue
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
        claims = replace(seeds.judged, runs=request.runs(outcomes)).claims
        words_of = {judged.claim.name: judged.word for judged in claims}
        elsewhere = set()
        for outcome in outcomes:
            if any(run.machine not in ("", self.machine) for run in outcome.results):
                elsewhere.add(seed_of(outcome.point.overrides))
        rows: dict[tuple[str, ...], set[str]] = {}  # labels by the overrides of their run
        for point in missing:
            if seed_of(point.overrides) not in elsewhere:
                rows[point.overrides] = set(point.tags[TAG + request.name].split(" | "))
        sizes = {column.name for column in table.columns if column.efficiency is not None}
        for claim in table.claims:
            if sizes & set(claim.columns):
                continue
            named: set[str] = set()
            for contrast in contrasts_of(claim, table):
                named |= contrast.rows
            needed = [words for words, labels in rows.items() if labels & named or not named]
            is_open = words_of.get(claim.name) not in ("holds", "contradicted")
            self.claims += 1
            self.decided += not is_open
            if is_open:
                for words in needed:
                    self._worth[words] += 1 / len(needed)

    def rank(self, point: Point) -> float:
        """Return the claims a second that a missing run decides, as far as that is known."""
        return self._worth[point.overrides] / self.seconds(point)

    def seconds(self, point: Point) -> float:
        """Estimate the duration of a run."""
        return median(self._seconds.get(self._network(point)) or [DEFAULT_S])

    def _network(self, point: Point) -> str:
        """Return the class of the network of a run."""
        return str(self.planner.specify((*self.planner.base, *point.overrides)).model.target)

    def preview(self, outcomes: Sequence[Outcome]) -> TextTable:
        """Show the missing runs in the order in which they would be run today, each once."""
        tables: dict[tuple[str, ...], list[str]] = defaultdict(list)
        missing: dict[tuple[str, ...], Point] = {}
        for outcome, owner in zip(outcomes, self._owners, strict=False):
            if outcome.state == "waiting":
                point = outcome.point
                missing.setdefault(point.overrides, point)
                tables[point.overrides].append(self.requests[owner].name)
        rows: list[tuple[str, ...]] = []
        total = 0.0
        for point in sorted(missing.values(), key=self.rank, reverse=True):
            minutes, worth = self.seconds(point) / 60, self._worth[point.overrides]
            total += minutes
            name = ", ".join(dict.fromkeys(tables[point.overrides]))
            rows.append((point.label, name, f"{worth:.2f}", f"{minutes:.1f}", f"{total:.0f}"))
        header = ("run", "table", "claims", "minutes", "total")
        return TextTable("Missing runs in their order", header, tuple(rows))


def run_queue(
    requests: Sequence[TableRequest],
    settings: SweepSettings,
    runs: RunStore,
    planner: Planner,
    max_seeds: int,
) -> int:
    """Run what several tables lack until the time is over; 1 if a run failed."""
    queue = Queue(requests, runs, planner, max_seeds, is_dry=settings.dry_run)
    scale = requests[0].scale
    identity = signature([request.study for request in requests])
    points = PointList(
        f"tables {scale} {identity[:6]}",  # a driver of other tables does not run these
        f"tables {scale}",
        queue.points,
        runs,
        planner,
        more=queue.more,
        rank=queue.rank,
    )
    if settings.commands is not None:
        info(commands_line(points, settings))
        return 0
    outcomes = (preview_points if settings.dry_run else run_points)(points, settings)
    if outcomes is None:
        return 0
    queue.more(outcomes)
    if settings.dry_run:
        print_rich(rich_table(queue.preview(outcomes)))
    states = Counter(outcome.state for outcome in outcomes)
    info(
        f"{states['finished']} of {len(outcomes)} runs are finished, {states['failed']} failed; "
        f"{queue.decided} of {queue.claims} claims are decided: rgbt claims scale={scale}"
    )
    return int(states["failed"] > 0)


def check_trainable(request: TableRequest, planner: Planner) -> None:
    """Refuse a table of which no row can be trained, with the reason of the first row."""
    reasons = []
    for point in request.points():
        try:
            planner.plan(point)
        except InputError as error:
            reasons.append(error)
        else:
            return
    raise reasons[0] if reasons else InputError("none of its rows is trained.")
