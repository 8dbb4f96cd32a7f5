"""Print all claims of the papers with their verdicts: ``rgbt claims``.

Nothing is run: the verdicts come from the finished runs in the folder of runs.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from rgbt.checks import InputError
from rgbt.config.common_options import RunsDir
from rgbt.config.options import Help, readable_paths
from rgbt.config.plain_command import PlainCommand

if TYPE_CHECKING:
    from rgbt.runs.result import RunResult
    from sweeps.verdicts.judge import JudgedClaim

ALL = "all"


@dataclass(frozen=True)
class Options:
    """Options of ``rgbt claims``."""

    table: Annotated[str, Help("such as spatialseg/table3; all: every table of the papers")] = ALL
    scale: Annotated[str, Help("scale of the runs: demo, bench or paper")] = "demo"
    form: Annotated[Literal["paper", "released"], Help("form of the rows")] = "paper"
    runs_dir: RunsDir = Path("runs")
    out: Annotated[Path | None, Help("output folder of claims.md and claims.csv")] = None


def main(options: Options, overrides: list[str]) -> int:
    """Print every claim of the papers: holds, contradicted, undecided, or not run.

    Overrides are those of the runs: dataset.root=/data/MFNet. Claims about data sets alone, such as
    those on noise and sharpness, are decided by `rgbt spatial`.
    """
    from rgbt.files.atomic import write_atomic
    from rgbt.terminal import path_lines, print_rich, rich_table
    from sweeps.rendering.claims import claims_csv, claims_grid, claims_markdown, counted
    from sweeps.rendering.times import print_lines

    judged, times = judge_all(options, overrides)
    run_as = " ".join([f"scale={options.scale}", f"form={options.form}", *overrides])
    where = f"{run_as}, runs in {options.runs_dir}"
    print_rich(rich_table(claims_grid(judged, f"{counted(judged)} ({where})", tables=True)))
    print_lines([by_paper(judged), *times])
    if options.out is not None:
        options.out.mkdir(parents=True, exist_ok=True)
        words = re.sub(r" ?dataset\.root=\S+", "", run_as)  # the folder names a machine
        head = f"# Claims of the papers\n\n{counted(judged)} Runs: `{words}`."
        text = "\n\n".join([head, *times, claims_markdown(judged, tables=True)])
        write_atomic(options.out / "claims.md", text.encode())
        write_atomic(options.out / "claims.csv", claims_csv(judged).encode())
        print_rich(path_lines([("claims", str(options.out / "claims.md"))]))
    return 0


def judge_all(options: Options, overrides: Sequence[str]) -> tuple[list[JudgedClaim], list[str]]:
    """The claims of the requested tables, judged by the finished runs; and how long these took."""
    from rich.console import Console
    from rich.progress import track

    from sweeps.rendering.times import time_lines
    from sweeps.table.efficiency import exact_sizes
    from sweeps.table.load_table import is_own, table_names
    from sweeps.table_plan import (
        TableWords,
        check_equal_runs,
        check_override,
        make_request,
        read_named,
    )
    from sweeps.verdicts.judge import TableJudge
    from sweeps.verdicts.stored import finished_by_seed, rule_of, stored_runs
    from sweeps.worker.planner import Planner

    names = table_names(Path("none")) if options.table == ALL else [options.table]
    finished = finished_by_seed(options.runs_dir)
    for word in overrides:
        check_override(word)
    words = TableWords(seeds=(0,), scale=options.scale, form=options.form, overrides=overrides)
    planner = Planner(readable_paths([f"runs_dir={options.runs_dir}"]))
    judged: list[JudgedClaim] = []
    results: dict[str, RunResult] = {}
    trained: list[tuple[str, ...]] = []
    for each in track(names, "judging", console=Console(stderr=True), transient=True):
        name, table = read_named(each)
        if not table.claims:
            continue
        request, external = make_request(name, table, words)
        if external:
            raise InputError(
                f"{external[0].kind}.{external[0].label}: only finished runs are judged here; "
                f"use rgbt reproduce table={name} for rows that are not trained."
            )
        if overrides or is_own(each):  # a test checks the others
            check_equal_runs(request, planner)
        runs = {}
        if overrides or finished:
            runs = stored_runs(request, options.runs_dir, finished, planner)
        found = [result for run in runs.values() for result in run.results]
        rule = rule_of(result.tags for result in found)
        judge = TableJudge(name, table, rule, sizes=exact_sizes(request))
        judged += judge.claims(runs)
        results |= {result.key: result for result in found}
        trained += [request.overrides(label, seed) for label, seed in runs]
    return judged, time_lines(results.values(), trained, planner)


def by_paper(judged: Sequence[JudgedClaim]) -> str:
    """How many claims each paper makes, and of how many its printed numbers agree."""
    lines = []
    for paper in dict.fromkeys(each.table.partition("/")[0] for each in judged):
        found = [each.as_printed for each in judged if each.table.partition("/")[0] == paper]
        lines.append(
            f"{paper}: {len(found)} claims; its printed values agree with {found.count(True)}, do "
            f"not agree with {found.count(False)}"
            + (f", and are not printed for {count}." if (count := found.count(None)) else ".")
        )
    return "\n".join(lines)


entry = PlainCommand(Options, main)

if __name__ == "__main__":
    entry()
