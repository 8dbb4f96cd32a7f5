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
        Help("folder for the counts of one run; default: evaluations/robustness/ in it"),
    ] = None


def main(options: Options, overrides: list[str]) -> int:
    """Evaluate runs under every severity of every corruption; one table per run.

    Overrides such as dataset=mfnet dataset.root=/data/MFNet, corruption.seed=1, and any key of a
    single corruption: corruptions=noise corruption.severities=[4,12]. Existing counts are replaced
    only if data, weights or corruption changed. `rgbt figures figure=robustness` draws the results.
    """
    from rgbt.evaluation.request import NetworkRequest, choose_corruptions, split_overrides
    from rgbt.evaluation.robustness import counts_folder, measure, robustness_grid, write_tables
    from rgbt.runs.folder import find_run
    from rgbt.terminal import path_lines, print_rich, rich_table

    words, overrides = split_overrides(overrides)
    split, out = options.split, options.out
    networks = [
        NetworkRequest(replace(options, run=run), overrides, options.regions)
        for run in (split_list(options.run, "runs") if options.run else [""])
    ]
    corruptions = choose_corruptions(options.corruptions, words, networks[0].trust)
    if out and len(networks) > 1:
        raise InputError(f"out={out} is the folder of a single run, but run={options.run}.")
    for network in networks:  # before the first of them is measured
        network.check_comparable(out)
        if network.options.run:
            find_run(network.options.run, options.runs_dir)
    # A table of some corruptions does not replace that of all.
    some = [] if options.corruptions == Options.corruptions else corruptions
    stem = "_".join(["robustness", *(each.row for each in some)])
    for network in networks:
        opened = network.open()
        folder = out or counts_folder(opened, network, split)
        measured = measure(opened, split, corruptions, folder)
        label = f"{opened.label} seed={opened.spec.seed}" if opened.step else opened.label
        on = f"{opened.dataset.name}, {split}"
        grid = robustness_grid(measured, f"Robustness of {label} ({on}): mIoU in percent")
        write_tables(measured, grid, folder / stem)
        print_rich(rich_table(grid))
        print_rich(path_lines([("counts", f"{folder}/ ({stem}.md, {stem}.csv)")]))
    return 0


entry = PlainCommand(Options, main)

if __name__ == "__main__":
    entry()
