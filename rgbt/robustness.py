"""What is left when images are missing or partly wrong: ``python -m rgbt.robustness run=...``.

Every severity of every corruption is evaluated and its counts are kept beside the run, each with a
file that says what it was made of. Counts that exist are not made again.
"""

from __future__ import annotations

from pathlib import Path

from rgbt.checks import InputError, split_list
from rgbt.config.command import plain_command

OWN = {
    "run": "",
    "runs_dir": "runs",
    "split": "test",
    "corruptions": "all",
    "regions": "as trained",
    "checkpoint": "best",
    "trust": "",
    "out": "",
}


def main(arguments: dict[str, str], overrides: list[str]) -> int:
    """Evaluate runs under every severity of every corruption; one table per run.

    run       run folders, config keys or MLflow run ids, with commas; without one, name a network
              and its weights: model=mfnet model.weights=final.pth dataset.root=/data/MFNet
    split     split of the data set
    corruptions  files of conf/corruption with commas, such as frozen,noise:rgb (also :thermal,
              :both), or all of them; the clean images and, of networks that can decode one branch
              alone, both branches are always measured beside them
    regions   a file of conf/metric: ring5, ring9, vertical5, horizontal5
    checkpoint  best (by validation mIoU) or last
    trust     modules of yours that the runs were made with: trust=my_lab; their code is run
    out       folder of the counts of one run; default: evaluations/robustness/ in the run folder
    overrides such as dataset=mfnet dataset.root=/data/MFNet, corruption.seed=1 (of what is drawn),
              and of a single corruption any key: corruptions=noise corruption.severities=[4,12]

    Stopped and called again, it resumes; counts are made again only where the data, the weights
    or the corruption differ. python -m analysis.figures figure=robustness draws it.
    """
    from rgbt.evaluation.corruption_request import choose_corruptions, split_overrides
    from rgbt.evaluation.request import NetworkRequest
    from rgbt.evaluation.robustness import measure
    from rgbt.evaluation.robustness_table import (
        counts_folder,
        robustness_grid,
        robustness_title,
        write_tables,
    )
    from rgbt.tracking.folder import find_run
    from rgbt.tracking.terminal import place_lines, rich_table, show

    words, overrides = split_overrides(overrides)
    options, split, out = arguments, arguments["split"], arguments["out"]
    networks = [
        NetworkRequest.from_options({**options, "run": run}, overrides)
        for run in (split_list(options["run"], "runs") if options["run"] else [""])
    ]
    corruptions = choose_corruptions(options["corruptions"], words, networks[0].trust)
    if out and len(networks) > 1:
        raise InputError(
            f"out= is the folder of one run, but run= names {len(networks)}; omit out=."
        )
    for network in networks:  # before the first of them is measured
        network.check_comparable(out)
        if network.run:
            find_run(network.run, network.runs_dir)
    # A table of some corruptions does not replace that of all.
    some = [] if options["corruptions"] == OWN["corruptions"] else corruptions
    stem = "_".join(["robustness", *(each.row for each in some)])
    for network in networks:
        opened = network.open()
        folder = Path(out) if out else counts_folder(opened, network, split)
        measured = measure(opened.session, split, corruptions, folder)
        grid = robustness_grid(measured, robustness_title(opened, split))
        write_tables(measured, grid, folder / stem)
        show(rich_table(grid))
        show(place_lines([("counts", f"{folder}/ ({stem}.md, {stem}.csv)")]))
    return 0


if __name__ == "__main__":
    plain_command(OWN, main)()
