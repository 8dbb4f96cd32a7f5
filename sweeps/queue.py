"""Several tables at once: ``rgbt reproduce table=all scale=bench seeds=until_decided minutes=120``.

What decides most claims a minute is run first. Finished runs are added to an archive, and what is
in it counts as finished, so that the same command continues on any machine.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING

from analysis.archive import add
from rgbt.checks import InputError, split_list
from rgbt.runs.provenance import machine, machine_name
from rgbt.tables import TextTable
from rgbt.terminal import info, print_rich, rich_table
from sweeps.judge.judged_table import contrasts_of
from sweeps.plan.planner import Planner
from sweeps.plan.request import TAG, seed_of
from sweeps.plan.table import study_names, table_names
from sweeps.point import Outcome, Point
from sweeps.run.point_list import PointList, commands_line, preview_points, run_points
from sweeps.run.run_store import RunStore
from sweeps.settings import SweepSettings
from sweeps.space import signature
from sweeps.table_plan import TablePlan, plan_table

if TYPE_CHECKING:
    from sweeps.reproduce import Options

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

    plans: Sequence[TablePlan]
    runs: RunStore
    planner: Planner
    is_dry: bool = False
    claims: int = 0
    decided: int = 0
    machine: str = field(default_factory=lambda: machine_name(machine()))
    # Worth of a run by its overrides; seconds of finished runs by their network.
    _worth: dict[tuple[str, ...], float] = field(default_factory=lambda: defaultdict(float))
    _seconds: dict[str, list[float]] = field(default_factory=lambda: defaultdict(list))
    _seen: set[int] = field(default_factory=set)  # places of finished points

    def __post_init__(self) -> None:
        self.points = tuple(point for plan in self.plans for point in plan.points.points)
        self.owners = [n for n, plan in enumerate(self.plans) for _ in plan.points.points]

    def more(self, outcomes: Sequence[Outcome]) -> list[Point]:
        """The next seeds of open claims, given all points in their order.

        It adds new finished runs to the archive, unless it `is_dry`.
        """
        finished = {n for n, outcome in enumerate(outcomes) if outcome.state == "finished"}
        for outcome in (outcomes[place] for place in finished - self._seen):
            for result in filter(self.runs.is_own, outcome.results):
                if self.runs.archive is not None and not self.is_dry:
                    add(result, self.runs.archive)
            if outcome.seconds is not None:
                self._seconds[self._network(outcome.point)].append(outcome.seconds)
        self._seen = finished
        added, owners = list[Point](), list(self.owners)
        self.claims = self.decided = 0
        self._worth.clear()
        for place, plan in enumerate(self.plans):
            own = [each for each, owner in zip(outcomes, owners, strict=True) if owner == place]
            new = plan.until_decided(own) if plan.until_decided else []
            self._count(plan, own, [*(o.point for o in own if o.state == "waiting"), *new])
            added += new
            self.owners += [place] * len(new)
        return added

    def _count(self, plan: TablePlan, outcomes: Sequence[Outcome], missing: list[Point]) -> None:
        """Add what the missing runs of a table are worth; claims on a design need all its rows."""
        request, table = plan.request, plan.request.table
        judged = {each.claim.name: each.word for each in plan.judge.claims(request.runs(outcomes))}
        elsewhere = {
            seed_of(each.point.overrides)
            for each in outcomes
            if any(run.machine not in ("", self.machine) for run in each.results)
        }
        rows = {
            point.overrides: set(point.tags[TAG + request.name].split(" | "))
            for point in missing
            if seed_of(point.overrides) not in elsewhere
        }
        sizes = {column.name for column in table.columns if column.efficiency is not None}
        for claim in (each for each in table.claims if not sizes & set(each.columns)):
            named = {cell.row for each in contrasts_of(claim, table) for cell in each.cells}
            needed = [each for each, labels in rows.items() if labels & named or not named]
            is_open = judged.get(claim.name) not in ("holds", "contradicted")
            self.claims += 1
            self.decided += not is_open
            for overrides in needed if is_open else ():
                self._worth[overrides] += 1 / len(needed)

    def rank(self, point: Point) -> float:
        """Claims a second that a missing run decides, as far as that is known."""
        return self._worth[point.overrides] / self.seconds(point)

    def seconds(self, point: Point) -> float:
        """Estimated duration of a run."""
        return median(self._seconds.get(self._network(point)) or [DEFAULT_S])

    def _network(self, point: Point) -> str:
        """The class of the network of a run."""
        return str(self.planner.specify((*self.planner.base, *point.overrides)).model.target)

    def preview(self, outcomes: Sequence[Outcome]) -> TextTable:
        """The missing runs in the order in which they would be run today, each once."""
        tables: dict[tuple[str, ...], list[str]] = defaultdict(list)
        missing: dict[tuple[str, ...], Point] = {}
        for outcome, owner in zip(outcomes, self.owners, strict=False):
            if outcome.state == "waiting":
                point = outcome.point
                missing.setdefault(point.overrides, point)
                tables[point.overrides].append(self.plans[owner].request.name)
        rows, total = list[tuple[str, ...]](), 0.0
        for point in sorted(missing.values(), key=self.rank, reverse=True):
            minutes, worth = self.seconds(point) / 60, self._worth[point.overrides]
            total += minutes
            name = ", ".join(dict.fromkeys(tables[point.overrides]))
            rows.append((point.label, name, f"{worth:.2f}", f"{minutes:.1f}", f"{total:.0f}"))
        header = ("run", "table", "claims", "minutes", "total")
        return TextTable("Missing runs in their order", header, tuple(rows))


def run_queue(
    options: Options,
    overrides: Sequence[str],
    settings: SweepSettings,
    runs: RunStore,
    planner: Planner,
) -> int:
    """Run what several tables lack until the time is over; 1 if a run failed.

    A table that cannot be trained with these options is left out with a line.
    """
    every = [*table_names(Path("none")), *study_names()]
    names = every if options.table == "all" else split_list(options.table, "tables")
    plans, runs.archive = list[TablePlan](), options.archive
    for name in names:
        try:
            # Nothing is counted of the networks themselves.
            plan = plan_table(replace(options, table=name, dry_run=True), overrides, runs, planner)
            _check(plan, planner)
            plans.append(plan)
        except InputError as error:
            info(f"{name} is left out: {error}")
    if not plans:
        raise InputError(f"table={options.table}: none of them can be trained.")
    queue, title = Queue(plans, runs, planner, options.dry_run), f"tables {options.scale}"
    identity = signature([plan.points.study for plan in plans])
    study = f"{title} {identity[:6]}"  # a driver of other tables does not run these
    points = PointList(study, title, queue.points, runs, planner, more=queue.more, rank=queue.rank)
    if settings.commands is not None:
        info(commands_line(points, settings))
        return 0
    outcomes = (preview_points if options.dry_run else run_points)(points, settings)
    if outcomes is None:
        return 0
    queue.more(outcomes)
    if options.dry_run:
        print_rich(rich_table(queue.preview(outcomes)))
    states = Counter(outcome.state for outcome in outcomes)
    info(
        f"{states['finished']} of {len(outcomes)} runs are finished, {states['failed']} failed; "
        f"{queue.decided} of {queue.claims} claims are decided: rgbt claims scale={options.scale}"
    )
    return int(states["failed"] > 0)


def _check(plan: TablePlan, planner: Planner) -> None:
    """InputError: no row of a table can be trained, and why."""
    reasons = []
    for point in plan.points.points:
        try:
            planner.plan(point)
        except InputError as error:
            reasons.append(error)
        else:
            return
    raise reasons[0] if reasons else InputError("none of its rows is trained.")
