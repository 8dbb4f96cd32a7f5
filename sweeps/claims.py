"""Print all claims of the papers with their verdicts: ``rgbt claims``.

Nothing is run: the verdicts come from finished runs, those of the folder and of the archive.
"""

from __future__ import annotations

import gc
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from rgbt.checks import InputError, split_list
from rgbt.config.common_options import RunsDir
from rgbt.config.options import Help, readable_paths
from rgbt.config.plain_command import PlainCommand

if TYPE_CHECKING:
    from sweeps.judge.judged_table import JudgedTable


@dataclass(frozen=True)
class Options:
    """Options of ``rgbt claims``."""

    table: Annotated[
        str, Help("such as spatialseg/table3; a,b; all: every table of the papers")
    ] = "all"
    scale: Annotated[str, Help("scale of the runs: demo, bench or paper")] = "demo"
    form: Annotated[Literal["paper", "released"], Help("form of the rows")] = "paper"
    runs_dir: RunsDir = Path("runs")
    archive: Annotated[Path, Help("folder of archived runs")] = Path("results")
    out: Annotated[Path | None, Help("output folder of claims.md and claims.csv")] = None


def main(options: Options, overrides: list[str]) -> int:
    """Print every claim of the papers: its direction and size in finished runs, or not run.

    A claim holds or is contradicted where runs with the paper's recipe on its images show so. Other
    runs, such as those on synthetic scenes, have the same or the opposite direction. The last lines
    say how far such runs rank like the printed values.
    Overrides are those of the runs: dataset.root=/data/MFNet. Claims about data sets alone, such as
    those on noise and sharpness, are decided by `rgbt spatial`.
    """
    from rich.console import Group

    from rgbt.files.atomic import write_atomic
    from rgbt.terminal import path_lines, plain_text, print_rich, rich_table
    from sweeps.judge.agreement import contrasts_frame, ranks_of, signs_of
    from sweeps.show.agreement import agreement_lines
    from sweeps.show.claims import (
        chance_of,
        claim_grids,
        claims_frame,
        claims_markdown,
        counted,
        counts_grid,
        frame_csv,
    )

    gc.set_threshold(1_000_000, 20, 20)  # many small objects stay
    tables = judge_all(options, overrides)
    frame = claims_frame([claim for table in tables for claim in table.claims])
    run_as = " ".join([f"scale={options.scale}", f"form={options.form}", *overrides])
    print_rich(Group(*map(rich_table, [*claim_grids(frame, noted=True), counts_grid(frame)])))
    print_rich(f"{counted(frame)} ({run_as})")
    lines = agreement_lines(signs_of(contrasts_frame(tables)), ranks_of(tables))
    print_rich(plain_text("\n".join(filter(None, [chance_of(frame), *lines]))))
    if options.out is not None:
        options.out.mkdir(parents=True, exist_ok=True)
        words = " ".join(word for word in run_as.split() if not word.startswith("dataset.root="))
        head = f"# Claims of the papers\n\n{counted(frame)} Runs: `{words}`."
        text = f"{head}\n\n{claims_markdown(frame)}"
        write_atomic(options.out / "claims.md", text.encode())
        write_atomic(options.out / "claims.csv", frame_csv(frame).encode())
        print_rich(path_lines([("claims", str(options.out / "claims.md"))]))
    return 0


def judge_all(options: Options, overrides: Sequence[str]) -> list[JudgedTable]:
    """Judge the claims of the requested tables by the finished runs."""
    from analysis.results import finished_runs
    from rgbt.terminal import tracked
    from sweeps.judge.judged_table import JudgedTable, Resamplers
    from sweeps.judge.stored_tables import runs_of_request
    from sweeps.plan.planner import Planner
    from sweeps.plan.request import check_overrides, make_request
    from sweeps.plan.table import PUBLISHED, load_table, table_names
    from sweeps.score.efficiency import network_sizes
    from sweeps.score.reader import RunReader

    is_all = options.table == "all"
    names = table_names(PUBLISHED) if is_all else split_list(options.table, "tables")
    check_overrides(overrides)
    reader = RunReader(finished_runs(options.runs_dir, options.archive))
    planner = Planner(readable_paths([f"runs_dir={options.runs_dir}"]))
    judged: list[JudgedTable] = []
    resamplers: Resamplers = {}
    for name in tracked(names, "judging", len(names)):
        if not load_table(name).claims:
            continue
        request = make_request(
            name, options.scale, words=overrides, form=options.form, planner=planner
        )
        for row in request.external:
            raise InputError(
                f"{row.kind}.{row.label}: only finished runs are judged here; "
                f"use rgbt reproduce table={name} for rows that are not trained."
            )
        runs = runs_of_request(request, reader, planner, checked=bool(overrides))
        sizes = network_sizes(request)
        table = JudgedTable(
            request=request, runs=runs, sizes=sizes, reader=reader, resamplers=resamplers
        )
        _ = table.claims  # the slow part, while progress is shown
        judged.append(table)
    return judged


entry = PlainCommand(Options, main)

if __name__ == "__main__":
    entry()
