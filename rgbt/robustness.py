"""Evaluate a run on missing or corrupted images: ``rgbt robustness run=...``."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

from rgbt.checks import InputError, split_list
from rgbt.config.common_options import NetworkOptions, RegionsFile, Split
from rgbt.config.options import Help
from rgbt.config.plain_command import PlainCommand


@dataclass(frozen=True, kw_only=True)
class Options(NetworkOptions):
    """Options of the command."""

    run: Annotated[
        str,
        Help("run folders, keys or MLflow run ids, separated by commas; see rgbt evaluate"),
    ] = ""
    split: Split = "test"
    corruptions: Annotated[
        str,
        Help(
            "files of conf/corruption separated by commas, such as frozen,noise:rgb, or all. Clean "
            "images are evaluated as well, and each branch alone if the network can decode it"
        ),
    ] = "all"
    regions: RegionsFile = "as trained"
    out: Annotated[
        Path | None,
        Help("folder for the counts of one run; default: evaluations/ in it"),
    ] = None


def main(options: Options, overrides: list[str]) -> int:
    """Evaluate runs under every severity of every corruption; one table per run.

    Overrides such as dataset=mfnet dataset.root=/data/MFNet, corruption.seed=1, and any key of a
    single corruption: corruptions=noise corruption.severities=[4,12]. What is measured already is
    not measured again. `rgbt figures figure=robustness` draws the results.
    """
    from rgbt.assembly.load_run import open_named
    from rgbt.config.corruption_node import choose_corruptions, split_overrides
    from rgbt.config.stored_config import parse_trust
    from rgbt.evaluation.measure import path_of
    from rgbt.evaluation.robustness import measure_all, robustness_grid, write_tables
    from rgbt.runs.folder import find_run
    from rgbt.terminal import path_lines, print_rich, rich_table

    words, overrides = split_overrides(overrides)
    split, out = options.split, options.out
    corruptions = choose_corruptions(options.corruptions, words, parse_trust(options.trust))
    runs = split_list(options.run, "runs") if options.run else [""]
    if out and len(runs) > 1:
        raise InputError(f"out={out} is the folder of a single run, but run={options.run}.")
    if options.run:
        for run in runs:  # before the first of them is measured
            find_run(run, options.runs_dir)
    # A table of some corruptions does not replace that of all.
    some = [] if options.corruptions == Options.corruptions else corruptions
    for run in runs:
        opened = open_named(replace(options, run=run), overrides, options.regions)
        every = measure_all(opened, split, corruptions, out)
        label = f"{opened.label} seed={opened.spec.seed}" if opened.step else opened.label
        on = f"{opened.dataset.name}, {split}"
        grid = robustness_grid(every, f"Robustness of {label} ({on}): mIoU in percent")
        last = every[-1].measurement
        folder = out or path_of(opened, last).parent
        clean = every[0].measurement
        first = split if clean.is_own else clean.file_name.removesuffix(".npz")
        stem = "_".join(["robustness", first, *(corruption.name for corruption in some)])
        write_tables(every, grid, folder / stem)
        print_rich(rich_table(grid))
        print_rich(path_lines([("counts", f"{folder}/ ({stem}.md, {stem}.csv)")]))
    return 0


entry = PlainCommand(Options, main)

if __name__ == "__main__":
    entry()
