"""A claimed point at work: its runs one after another, then their further evaluations."""

from __future__ import annotations

import math
import signal
import time
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean

from rgbt.checks import RunError
from rgbt.files.atomic import is_held
from rgbt.tracking.folder import MetricLine
from sweeps.evaluation import ExtraEvaluation
from sweeps.worker.executors import GRACE_S, Job
from sweeps.worker.planner import PlannedPoint, PlannedRun
from sweeps.worker.run_monitor import MetricsReader, failure_reason, signal_lock_holder
from sweeps.worker.run_store import RunResult, RunStore

LOGS = ".logs"
"""Folder inside the folder of runs: what the processes said, one file per run."""

PruningCallback = Callable[[MetricLine], str]
"""Gets a line of the selection split; says why the point shall be pruned, or ""."""

Start = Callable[[Sequence[str], Path], Job]
"""Starts ``python -m <command>`` with its output in a file."""


class TrialError(Exception):
    """The point failed; the message says why in one sentence."""


class TrialPruned(Exception):  # noqa: N818 - not an error
    """The point was stopped because it is not promising; the message says at which step."""


@dataclass(frozen=True)
class ExecutionContext:
    """What a work needs from its driver.

    Attributes:
        runs: where finished runs are found.
        start: starts processes.
        timeout_s: of a run; None for no limit.
    """

    runs: RunStore
    start: Start
    timeout_s: float | None


class RunningTrial:
    """Works on one point; never blocks.

    Args:
        plan: the point.
        number: of its trial.
        around: see `ExecutionContext`.
        report: asked with every evaluation of the first run, or None.
    """

    def __init__(
        self,
        plan: PlannedPoint,
        number: int,
        context: ExecutionContext,
        report: PruningCallback | None = None,
    ) -> None:
        self.plan = plan
        self.number = number
        self.began = time.monotonic()
        self.status = "starting"
        """What it does now, in a few words."""

        self.score = math.nan
        """Last mIoU on the selection split, a fraction."""

        self._context = context
        self._report = report
        self._job: Job | None = None
        self._held: Path | None = None
        self._index = 0
        self._follower = MetricsReader(Path())
        self._found: tuple[RunResult, ...] = ()
        self._end_as: Exception | None = None
        self._unreported: list[MetricLine] = []
        self._prune = ""
        self._steps = self._go()

    @property
    def done_share(self) -> float:
        """Steps done of all steps of the point, 0..1."""
        run = self.plan.runs[min(self._index, len(self.plan.runs) - 1)]
        done = self._index + min(1.0, self._follower.step / run.steps)
        return min(1.0, done / len(self.plan.runs))

    @property
    def seconds(self) -> float:
        """Since it began."""
        return time.monotonic() - self.began

    def advance(self) -> tuple[RunResult, ...] | None:
        """Look after the processes; the finished runs when all is done, None before.

        Raises:
            PointError: a run failed.
            Pruned: the report said so; the process is gone.
        """
        # A driver asks again where the storage could not be told how it ended.
        if self._end_as is not None:
            raise self._end_as
        self._tell()
        try:
            next(self._steps)
        except StopIteration:
            self._tell()
            return self._found
        except (TrialError, TrialPruned) as end:
            self._end_as = end
        except RunError as error:
            self._end_as = TrialError(str(error))
        if self._end_as is not None:
            raise self._end_as
        self._tell()
        return None

    def _tell(self) -> None:
        """Report what is new; not by the generator, which an error of the storage would end."""
        while self._unreported and not self._prune:
            assert self._report is not None, "lines are kept for a report alone"
            self._prune = self._report(self._unreported[0])
            del self._unreported[0]

    def stop(self) -> None:
        """End the process of this work, if there is one; it continues from its checkpoint later."""
        if self._job is not None and self._job.poll() is None:
            self._job.stop()

    def is_stopped(self) -> bool:
        """Whether no process of this work is left."""
        return self._job is None or self._job.poll() is not None

    def _go(self) -> Iterator[None]:
        runs = self._context.runs
        for index, run in enumerate(self.plan.runs):
            self._index = index
            found = runs.find(run.key, run.dataset)
            if found is None:
                yield from self._train(run)
                found = runs.find(run.key, run.dataset)
            if found is None:
                raise TrialError(
                    f"the run ended, but not as {run.key}: its configuration, its data set or your "
                    "own code was changed during the sweep; rerun the command"
                )
            runs.tag(found, self.plan.point.tags)
            for evaluation in self.plan.point.evaluations:
                yield from self._evaluate(run, found, evaluation)
            self._found = (*self._found, found)
        self._index = len(self.plan.runs)

    def _train(self, run: PlannedRun) -> Iterator[None]:
        folder = self._context.runs.runs_dir / run.key
        self._follower = MetricsReader(folder)
        log = self._log(run)
        self._context.runs.replace_outdated(run.key)
        while not (folder / "result.json").exists():
            if is_held(folder / "lock"):
                # Left by a driver that was killed, or run by hand: its result is taken when it
                # comes, and where it does not the run is continued from its checkpoint.
                self._held = folder
                self.status = "adopted"
                yield from self._until(lambda: 0 if not is_held(folder / "lock") else None)
                self._held = None
                continue
            begin = log.stat().st_size if log.exists() else 0
            self.status = "training"
            code = yield from self._run(("rgbt.run", *run.overrides), log)
            if code == 0:
                return
            finished = (folder / "result.json").exists()
            if not finished and not is_held(folder / "lock"):
                raise TrialError(failure_reason(code, log, begin))

    def _evaluate(
        self, run: PlannedRun, found: RunResult, evaluation: ExtraEvaluation
    ) -> Iterator[None]:
        out = found.counts_file(evaluation)
        if found.has(evaluation):
            return
        if found.run_id and self._context.runs.fetch_again(found, evaluation):
            return
        if found.run_id:
            raise TrialError(
                f"run {found.key} was made on another machine: its further evaluations "
                f"({evaluation.label}) can only be made there; to train it here, delete MLflow "
                f"run {found.run_id} and {found.folder}"
            )
        log = self._context.runs.runs_dir / LOGS / f"{found.key}.log"
        begin = log.stat().st_size if log.exists() else 0
        self.status = f"evaluating {evaluation.label}"
        module, *asked = evaluation.command
        # The protocols of consistency have a file each, which lie where a run's evaluations lie.
        place = f"out={out}" if evaluation.frames is None else f"runs_dir={found.folder.parent}"
        command = (
            *(module, f"run={found.folder}", *asked, place),
            # The run may have been made where the data lie elsewhere.
            *(word for word in run.overrides if word.startswith("dataset.root=")),
        )
        code = yield from self._run(command, log)
        if code != 0 or not found.has(evaluation):
            raise TrialError(failure_reason(code, log, begin))
        self._context.runs.send(found)

    def _run(self, command: Sequence[str], log: Path) -> Generator[None, None, int]:
        """Run a command to its exit code."""
        try:
            self._job = self._context.start(command, log)
        except OSError as error:
            raise TrialError(f"its process could not be started ({error})") from error
        return (yield from self._until(self._job.poll))

    def _until(self, poll: Callable[[], int | None]) -> Generator[None, None, int]:
        """Wait for an exit code, following the run meanwhile."""
        limit = self._context.timeout_s
        began = time.monotonic()
        while True:
            code = poll()
            self._follow()
            if code is not None:
                return code
            if self._prune:
                yield from self._end(poll)
                raise TrialPruned(self._prune)
            if limit is not None and time.monotonic() - began > limit:
                yield from self._end(poll)
                raise TrialError(f"stopped after {limit / 60:g} minutes (timeout_minutes)")
            yield

    def _end(self, poll: Callable[[], int | None]) -> Iterator[None]:
        if self._held is not None:
            signal_lock_holder(self._held, signal.SIGTERM)
        self.stop()
        kill_at = time.monotonic() + GRACE_S
        while poll() is None:
            if self._held is not None and time.monotonic() > kill_at:
                signal_lock_holder(self._held, signal.SIGKILL)
            yield

    def _follow(self) -> None:
        """Look at new metric lines; those of the first run are reported by `advance`."""
        lines = [line for line in self._follower.new_lines() if line.kind == "val"]
        if lines:
            self.score = lines[-1].values.get("mIoU", math.nan)
        if self._report is not None and self._index == 0:
            self._unreported += lines

    def _log(self, run: PlannedRun) -> Path:
        return self._context.runs.runs_dir / LOGS / f"{run.key}.log"


def mean_scores(found: Sequence[RunResult]) -> Mapping[str, float]:
    """Scores that all runs have, averaged over the runs."""
    each = [one.scores() for one in found]
    shared = set(each[0]).intersection(*each[1:])
    return {name: fmean(scores[name] for scores in each) for name in each[0] if name in shared}
