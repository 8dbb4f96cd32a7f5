"""The points of a list while they are planned: their runs, their tags and their errors."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import replace

from rgbt.checks import InputError
from rgbt.runs.naming import VARIED
from sweeps.point import COLOUR, Outcome, Point, colour, varied_keys
from sweeps.worker.planner import PlannedPoint, Planner
from sweeps.worker.progress import planning_progress

SHOWN_S = 0.2
"""Seconds of planning between two updates of its progress."""


class PlannedPoints:
    """Plans points in their order; each is planned once.

    Attributes:
        points: all points.
        plans: the planned ones by their index in `points`, without those of a wrong configuration.
        errors: sentences about the wrong configurations, by index.
    """

    def __init__(
        self, study: str, points: Sequence[Point], planner: Planner, *, strict: bool = False
    ) -> None:
        """No point is planned yet.

        Args:
            study: its name, from which the colours are derived.
            points: see above.
            planner: composes and checks them.
            strict: raise for one wrong point, not only if all points are wrong.
        """
        self.points: list[Point] = []
        self.plans: dict[int, PlannedPoint] = {}
        self.errors: dict[int, str] = {}
        self.num_planned = 0
        self._study = study
        self._planner = planner
        self._strict = strict
        self._same: dict[str, list[int]] = {}
        self._colours: dict[str, str] = {}
        self.append(points)

    @property
    def num_left(self) -> int:
        """Points that are not planned yet."""
        return len(self.points) - self.num_planned

    @property
    def num_runs(self) -> int:
        """Different points among those that are planned."""
        return len(self._same)

    def append(self, points: Sequence[Point]) -> None:
        """Add points that have to be planned."""
        self.points += points
        self._varied = " ".join(varied_keys(self.points))
        for key in self._same:
            self._describe(key)

    def plan(self, seconds: float = math.inf) -> list[PlannedPoint]:
        """Plan points for so many seconds, at least one; returns those without an error.

        Raises:
            InputError: a point is wrong and `strict` is set, or all points are wrong.
        """
        first, until = self.num_planned, time.monotonic() + seconds
        while self.num_left:
            self._plan_next()
            if time.monotonic() >= until:
                break
        new = range(first, self.num_planned)
        return [self.plans[index] for index in new if index in self.plans]

    def plan_and_show(self, title: str, seconds: float = math.inf) -> None:
        """Plan points for so many seconds and show how far it is; raises as `plan`."""
        until = time.monotonic() + seconds
        with planning_progress(title, len(self.points)) as show:
            while self.num_left and time.monotonic() < until:
                self.plan(min(SHOWN_S, until - time.monotonic()))
                show(self.num_planned)

    def outcomes(self, status_of: Callable[[PlannedPoint], Outcome]) -> list[Outcome]:
        """One outcome per planned point, in order."""
        return [
            Outcome(point, "failed", self.errors[index])
            if index in self.errors
            else status_of(self.plans[index])
            for index, point in enumerate(self.points[: self.num_planned])
        ]

    def _plan_next(self) -> None:
        index = self.num_planned
        try:
            plan = self._planner.plan(self.points[index])
        except InputError as error:
            self.errors[index] = str(error)
        else:
            self.plans[index] = plan
            self._same.setdefault(plan.key, []).append(index)
            self._describe(plan.key)
        self.num_planned += 1
        self._check()

    def _check(self) -> None:
        if not self.errors:
            return
        if not self.plans and not self.num_left:
            # An error of every point is one of the command and not of a point.
            raise InputError(next(iter(self.errors.values())))
        if self.plans and self._strict:
            index, reason = next(iter(self.errors.items()))
            raise InputError(f"{self.points[index].label}: {reason}")

    def _describe(self, key: str) -> None:
        """Give the plans of a key their tags, their colour and the keys that vary."""
        # Points of the same run in other words (1 and 1.0) get the tags of all of them. Every run
        # gets its own colour, and the keys that vary, which begin its name.
        tags: dict[str, list[str]] = {}
        for index in self._same[key]:
            for name, value in self.points[index].tags.items():
                values = tags.setdefault(name, [])
                values += [] if value in values else [value]
        if key not in self._colours:
            self._colours[key] = colour(self._study, len(self._colours))
        merged = {name: " | ".join(each) for name, each in tags.items()}
        merged |= {VARIED: self._varied, COLOUR: self._colours[key]}
        for index in self._same[key]:
            plan = self.plans[index]
            self.plans[index] = replace(plan, point=replace(plan.point, tags=merged))
