"""A claimed trial in progress: its runs one after another, then their further evaluations."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from statistics import fmean
from typing import NamedTuple

from rgbt.checks import RunError
from rgbt.files.atomic import is_held
from rgbt.runs.folder import MetricLine, is_finished
from rgbt.runs.result import RunResult
from rgbt.runs.run_spec import RunSpec
from sweeps.evaluation import Words, command_of, stored_at
from sweeps.worker.planner import PlannedPoint
from sweeps.worker.processes import LocalJob, failure_reason
from sweeps.worker.run_store import RunStore

# Settings of a run that its evaluations get, too.
FOLDERS = ("dataset.root=", "dataset.cache_dir=")
LOGS = ".logs"  # Folder inside the folder of runs: output of the processes, one file per run

# Gets a line of the selection split; returns why the trial is pruned, or "".
PruningCallback = Callable[[MetricLine], str]

# Starts ``python -m <command>`` with its output in a file.
Start = Callable[[Sequence[str], Path], LocalJob]


class ClaimedTrial(NamedTuple):
    """A trial that this driver executes; `report` gets every validation of the first run, once."""

    plan: PlannedPoint
    number: int
    report: PruningCallback | None = None


class TrialError(Exception):
    """The trial failed; the message is the reason in one sentence."""


class TrialPruned(Exception):  # noqa: N818 - not an error, Optuna's name for it
    """The trial was pruned; the message names the step."""


@dataclass(eq=False)
class RunningTrial:
    """Executes one trial; never blocks.

    Attributes:
        timeout_s: of a run.
        trust: as ``trust=`` of the commands that open a finished run.
        status: its present activity, in a few words.
        score: last mIoU on the selection split, a fraction.
        log: output of its last process.
    """

    claimed: ClaimedTrial
    runs: RunStore
    start: Start
    timeout_s: float = math.inf
    trust: str = ""
    status: str = field(default="starting", init=False)
    score: float = field(default=math.nan, init=False)
    log: Path | None = field(default=None, init=False)

    def __post_init__(self) -> None:
        self.plan, self.number, self._report = self.claimed
        self._began = time.monotonic()
        self._job: LocalJob | None = None
        self._folder = Path()
        self._size, self._step, self._validated = 0, 0, 0  # metrics of the present run
        self._results: tuple[RunResult, ...] = ()
        self._end: Exception | None = None
        self._unreported: list[MetricLine] = []
        self._prune_reason = ""
        self._steps = self._execute()

    @property
    def done_share(self) -> float:
        """Steps done of all steps of the trial, 0..1."""
        index, count = len(self._results), len(self.plan.runs)
        run = self.plan.runs[min(index, count - 1)]
        return min(1.0, (index + min(1.0, self._step / run.trainer.max_steps)) / count)

    @property
    def seconds(self) -> float:
        """Since it began."""
        return time.monotonic() - self._began

    def advance(self) -> tuple[RunResult, ...] | None:
        """Poll the processes; the finished runs when all is done, None before.

        Raises:
            TrialError: a run failed.
            TrialPruned: the callback asked for it; the process has ended.
        """
        if self._end is not None:  # a driver calls again where the storage could not record the end
            raise self._end
        self._report_lines()
        try:
            next(self._steps)
        except StopIteration:
            self._report_lines()
            return self._results
        except (TrialError, TrialPruned, RunError) as end:
            self._end = TrialError(str(end)) if isinstance(end, RunError) else end
            raise self._end from end
        self._report_lines()
        return None

    def _report_lines(self) -> None:
        """Report new lines; not in the generator, which an error of the storage would end."""
        while self._unreported and not self._prune_reason and self._report is not None:
            self._prune_reason = self._report(self._unreported[0])
            del self._unreported[0]

    def stop(self) -> None:
        """End the process of this trial, if any; its run resumes from its checkpoint later."""
        if self._job is not None and self._job.poll() is None:
            self._job.stop()

    def is_stopped(self) -> bool:
        """Whether no process of this trial is left."""
        return self._job is None or self._job.poll() is not None

    def _execute(self) -> Iterator[None]:
        evaluations = self.plan.point.evaluations
        for run in self.plan.runs:
            wanted = (run.key, self.plan.fingerprints[run.key], evaluations)
            result = self.runs.find(*wanted)
            if result is None:
                yield from self._train(run)
                result = self.runs.find(*wanted)
            if result is None:
                raise TrialError(
                    f"the run finished with another key than {run.key}: its configuration, its "
                    "data set or your own code changed during the sweep; rerun the command"
                )
            self.runs.tag(result, self.plan.point.tags)
            for words in evaluations:
                if stored_at(result, words) is None:
                    yield from self._evaluate(run, result, words)
            self._results = (*self._results, result)

    def _train(self, run: RunSpec) -> Iterator[None]:
        self._folder = folder = self.runs.runs_dir / run.key
        self._size = self._step = self._validated = 0
        self.runs.replace_outdated(run.key)
        while not is_finished(folder):
            if is_held(folder / "lock"):
                # A killed driver left it running, or it was started by hand. Its result is used
                # when it finishes; otherwise the run resumes from its checkpoint.
                self.status = "adopted"
                yield from self._wait(lambda: 0 if not is_held(folder / "lock") else None)
                continue
            self.status = "training"
            reason = yield from self._run(("rgbt.run", *run.overrides), run.key)
            if reason is None:
                return
            if not is_finished(folder) and not is_held(folder / "lock"):
                raise TrialError(reason)

    def _evaluate(self, run: RunSpec, result: RunResult, words: Words) -> Iterator[None]:
        self.status = f"evaluating {' '.join(words)}"
        module, *arguments = command_of(words)
        command = (
            module,
            f"run={result.folder}",
            *arguments,
            *([f"trust={self.trust}"] if self.trust else []),
            # The run may come from a machine with other folders.
            *(word for word in run.overrides if word.startswith(FOLDERS)),
        )
        reason = yield from self._run(command, result.key)
        if reason is not None or stored_at(result, words) is None:
            raise TrialError(reason or f"it wrote no counts of {' '.join(words)}")
        self.runs.sync(result)

    def _run(self, command: Sequence[str], key: str) -> Generator[None, None, str | None]:
        """Run a command to its end; why it failed, or None."""
        self.log = log = self.runs.runs_dir / LOGS / f"{key}.log"
        begin = log.stat().st_size if log.exists() else 0
        try:
            self._job = self.start(command, log)
        except OSError as error:
            raise TrialError(f"its process could not be started ({error})") from error
        code = yield from self._wait(self._job.poll)
        return failure_reason(code, log, begin) if code else None

    def _wait(self, poll: Callable[[], int | None]) -> Generator[None, None, int]:
        """Wait for an exit code, and read the metrics of the run meanwhile."""
        until = time.monotonic() + self.timeout_s
        while True:
            code = poll()
            for line in self._new_validations():
                self.score = line.values.get("mIoU", math.nan)
                if self._report is not None and not self._results:
                    self._unreported.append(line)
            if code is not None:
                return code
            if self._prune_reason or time.monotonic() > until:
                self.stop()  # an adopted run continues
                while not self.is_stopped():
                    yield
                if self._prune_reason:
                    raise TrialPruned(self._prune_reason)
                raise TrialError("stopped after timeout_minutes")
            yield

    def _new_validations(self) -> list[MetricLine]:
        """Whole lines of new steps; a run that resumes repeats those before its checkpoint."""
        path, lines = self._folder / "metrics.jsonl", list[MetricLine]()
        # It may not exist yet; the run itself reports a damaged line when it resumes.
        with suppress(FileNotFoundError, ValueError):
            before, self._size = self._size, path.stat().st_size
            if self._size != before:
                lines = MetricLine.read_all(path.read_bytes().split(b"\n")[:-1])
        self._step = lines[-1].step if lines else self._step
        found = [line for line in lines if line.kind == "val" and line.step > self._validated]
        self._validated = found[-1].step if found else self._validated
        return found


def mean_scores(results: Sequence[RunResult]) -> Mapping[str, float]:
    """Scores that all runs have, averaged over the runs."""
    each = [result.recorded_scores() for result in results]
    shared = set(each[0]).intersection(*each[1:])
    return {name: fmean(scores[name] for scores in each) for name in each[0] if name in shared}
