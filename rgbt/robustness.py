"""What is left when images are missing or partly wrong: ``python -m rgbt.robustness run=...``.

Every severity of every degradation is evaluated and its counts are kept beside the run, each with a
file that says what it was made of. What is there already is not made again.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from rgbt.checks import InputError, split_list
from rgbt.config.command import plain_command

if TYPE_CHECKING:
    from rgbt.build.load_run import TrainedNetwork
    from rgbt.evaluation.corrupted import Chosen
    from rgbt.evaluation.robustness import Measured
    from rgbt.tracking.tables import Grid

OWN = {
    "run": "",
    "runs_dir": "runs",
    "split": "test",
    "degradations": "all",
    "regions": "as trained",
    "checkpoint": "best",
    "trust": "",
    "out": "",
}
FOLDER = "robustness"
"""Inside ``evaluations/`` of a run; `analysis.robustness` looks for curves there."""


def main(arguments: dict[str, str], overrides: list[str]) -> int:
    """Evaluate runs under every severity of every degradation; one table per run.

    run       run folders, config keys or MLflow run ids, with commas; without one, name a network
              and its weights: model=mfnet model.weights=final.pth dataset.root=/data/MFNet
    split     split of the data set
    degradations  files of conf/degradation with commas, or all; the clean images and, of networks
              that can decode one branch alone, both branches are always measured beside them
    regions   a file of conf/metric: ring5, ring9, vertical5, horizontal5
    checkpoint  best (by validation mIoU) or last
    trust     modules of yours that the runs were made with: trust=my_lab; their code is run
    out       folder of the counts of one run; default: evaluations/robustness/ in the run folder
    overrides such as dataset=mfnet dataset.root=/data/MFNet, degradation.seed=1 (of what is drawn),
              and of a single degradation any key: degradations=noise degradation.severities=[4,12]

    Stopped and given again, it goes on; what is there is made again only where the data, the
    weights or the degradation differ. python -m analysis.figures figure=robustness draws it.
    """
    from rgbt.build.load_run import open_trained
    from rgbt.config.stored_config import parse_trust
    from rgbt.evaluation.corrupted import own_words
    from rgbt.evaluation.robustness import measure
    from rgbt.tracking.folder import find_run
    from rgbt.tracking.terminal import place_lines, rich_table, show

    words, overrides = own_words(overrides)
    trust = parse_trust(arguments["trust"])
    chosen = chosen_of(arguments["degradations"], words, trust)
    runs = split_list(arguments["run"], "runs") if arguments["run"] else [""]
    _check_comparable(arguments, overrides, runs)
    for run in filter(None, runs):  # before the first of them is measured
        find_run(run, Path(arguments["runs_dir"]))
    if arguments["regions"] != OWN["regions"]:
        overrides = [*overrides, f"metric={arguments['regions']}"]
    for run in runs:
        runs_dir, checkpoint = Path(arguments["runs_dir"]), arguments["checkpoint"]
        stored = open_trained(run, runs_dir, overrides, checkpoint, trust=trust)
        folder = Path(arguments["out"] or stored.folder / FOLDER / _place(stored, arguments))
        measured = measure(stored.session, arguments["split"], chosen, folder)
        grid = robustness_grid(measured, _title(stored, arguments["split"]))
        # A table of some failures does not take the place of that of all.
        some = [] if arguments["degradations"] == OWN["degradations"] else chosen
        stem = "_".join(["robustness", *(each.row for each in some)])
        _write_tables(measured, grid, folder / stem)
        show(rich_table(grid))
        show(place_lines([("counts", f"{folder}/ ({stem}.md, {stem}.csv)")]))
    return 0


def chosen_of(text: str, words: Sequence[str], trust: Collection[str] = ()) -> list[Chosen]:
    """The degradations of ``degradations=``.

    Args:
        text: names with commas, or "all".
        words: ``degradation.KEY=VALUE``; any key of a single degradation, the seed of several.
        trust: see `rgbt.evaluation.corrupted.choose`.

    Raises:
        InputError: an unknown name, one that stands twice, or keys of several degradations at once.
    """
    from rgbt.evaluation.corrupted import NODE, SEED, choose, known_degradations

    names = split_list(text, "degradations")
    names = known_degradations() if names == ["all"] else names
    for word in words:
        key = word.partition("=")[0]
        if len(names) > 1 and key != f"{NODE}.{SEED}":
            raise InputError(
                f"'{key}' is a key of one degradation, but {len(names)} were asked for; name that "
                "one with degradations=..."
            )
    chosen = [choose(name, words, trust) for name in names]
    stems = [each.name for each in chosen]
    for name in stems:
        if stems.count(name) > 1:
            raise InputError(f"degradations: '{name}' stands twice; name each once.")
    return chosen


CHANGES = ("transform", "trainer.precision", "metric")
"""Settings by which the same run gives other counts, or other scores of them."""


def _check_comparable(
    arguments: dict[str, str], overrides: Sequence[str], runs: Sequence[str]
) -> None:
    """Refuse counts made in another way among those of the run, and several runs in one folder."""
    changed = [word for word in overrides if word.lstrip("+").startswith(CHANGES)]
    if changed and arguments["run"] and not arguments["out"]:
        raise InputError(
            f"{changed[0]} changes how the run is measured; name a folder for these counts with "
            "out=..."
        )
    if arguments["out"] and len(runs) > 1:
        raise InputError(f"out= is the folder of one run, but run= names {len(runs)}; leave it.")


def _place(stored: TrainedNetwork, arguments: dict[str, str]) -> str:
    """Folder of a split's counts: plain where the run is measured as its own evaluation is."""
    from rgbt.evaluation.robustness import read_json

    session = stored.session
    regions = [session.regions.name] if arguments["regions"] != OWN["regions"] else []
    last = [] if arguments["checkpoint"] == "best" else [arguments["checkpoint"]]
    own = read_json(stored.folder.parent / "dataset.json") or {}
    found = session.dataset.fingerprint()
    is_other = own.get("files", found) != found
    others = [f"{session.dataset.name}-{found[:8]}"] if is_other else []
    return "_".join([arguments["split"], *regions, *last, *others])


def _title(stored: TrainedNetwork, split: str) -> str:
    session = stored.session
    is_run = stored.step > 0  # a file of weights tells neither step nor seed
    seed = f" seed={session.spec.seed}" if is_run else ""
    return f"Robustness of {stored.label}{seed} ({session.dataset.name}, {split}): mIoU in percent"


def robustness_grid(measured: Sequence[Measured], title: str) -> Grid:
    """One line per degradation; level 0 is the clean image, level n the n-th severity.

    Args:
        measured: the clean images first.
        title: shown above.
    """
    from rgbt.evaluation.robustness import CLEAN
    from rgbt.tracking.tables import Grid, percent

    clean, *others = measured
    rows: dict[str, list[Measured]] = {}
    for each in others:
        rows.setdefault(each.asked.row, []).append(each)
    levels = max((len(row) for row in rows.values()), default=0)
    lines = []
    for row in rows.values():
        asked = row[0].asked
        ladder = ", ".join(f"{each.asked.severity:g}" for each in row)
        severities = f"{ladder} {asked.unit}" if asked.unit else ""
        values = [percent(each.mious["mIoU"]) for each in (clean, *row)]
        empty = [""] * (levels - len(row))
        lines.append((asked.title, severities, *values, *empty))
    lines = lines or [(CLEAN, "", percent(clean.mious["mIoU"]))]
    header = ("", "severities", *(f"level {level}" for level in range(levels + 1)))
    return Grid(title, header, tuple(lines))


def _write_tables(measured: Sequence[Measured], grid: Grid, place: Path) -> None:
    """The numbers and the table in `place` with .csv and .md."""
    from rgbt.files.atomic import write_atomic
    from rgbt.tracking.csv_files import csv_text

    scores = list(measured[0].mious)
    rows: list[tuple[object, ...]] = [("row", "title", "unit", "severity", "view", *scores)]
    for each in measured:
        asked = each.asked
        values = [100 * each.mious[score] for score in scores]
        rows.append(
            (asked.row, asked.title, asked.unit, f"{asked.severity:g}", asked.view, *values)
        )
    # Names hold dots of severities: endings are added, not exchanged.
    write_atomic(place.with_name(f"{place.name}.csv"), csv_text(rows).encode())
    write_atomic(place.with_name(f"{place.name}.md"), grid.to_markdown().encode())


if __name__ == "__main__":
    plain_command(OWN, main)()
