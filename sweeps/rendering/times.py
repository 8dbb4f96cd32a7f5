"""How long the runs of a table took, and which runs are upstream of them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from contextlib import suppress
from pathlib import Path
from statistics import median

from rich.text import Text

from rgbt.checks import InputError
from rgbt.runs.folder import read_result
from rgbt.runs.result import RunResult
from rgbt.runs.run_spec import RunSpec
from rgbt.terminal import print_rich
from sweeps.worker.planner import Planner
from sweeps.worker.progress import duration


def time_lines(
    results: Iterable[RunResult], overrides: Iterable[tuple[str, ...]], planner: Planner
) -> list[str]:
    """Both lines, where there is something to say; see `time_line` and `upstream_line`."""
    return list(filter(None, (time_line(results), upstream_line(overrides, planner))))


def print_lines(lines: Sequence[str]) -> None:
    """Print sentences; nothing without any."""
    if lines:
        print_rich(Text("\n".join(lines)))


def time_line(results: Iterable[RunResult]) -> str:
    """Wall time of finished runs in total and of one; "" where none is known.

    The time of a run is that of the process that finished it. It does not contain the further
    evaluations of a table.
    """
    folders = {result.key: result.folder for result in results}
    known = [time for folder in folders.values() if (time := _seconds(folder)) is not None]
    if not known:
        return ""
    return (
        f"Time: {_runs(len(known))}, {duration(sum(known))} in total, {duration(median(known))} "
        "for a run (median)."
    )


def upstream_line(overrides: Iterable[tuple[str, ...]], planner: Planner) -> str:
    """The runs upstream of some runs, by experiment, with their time; "" where there are none.

    Args:
        overrides: of each run; runs that cannot be composed are left out.
        planner: composes them.
    """
    found: dict[str, dict[str, RunSpec]] = {}
    for words in overrides:
        with suppress(InputError):  # reported where the run is planned
            for spec in _upstream(planner.specify((*planner.base, *words))):
                found.setdefault(spec.name, {})[spec.key] = spec
    parts = [_experiment(name, list(specs.values())) for name, specs in found.items()]
    count = sum(map(len, found.values()))
    return f"Upstream of these: {_runs(count)} ({'; '.join(parts)})." if parts else ""


def _upstream(spec: RunSpec) -> Iterable[RunSpec]:
    for each in spec.upstream:
        yield each
        yield from _upstream(each)


def _experiment(name: str, specs: list[RunSpec]) -> str:
    finished = [spec for spec in specs if spec.is_finished]
    known = [time for spec in finished if (time := _seconds(spec.folder)) is not None]
    took = f", {duration(sum(known))}" if known else ""
    return f"{name}: {len(finished)} of {len(specs)} finished{took}"


def _seconds(folder: Path) -> float | None:
    with suppress(InputError):
        result = read_result(folder) or {}
        if "seconds_of_last_process" in result:
            return float(result["seconds_of_last_process"])
    return None


def _runs(count: int) -> str:
    return f"{count} run{'' if count == 1 else 's'}"
