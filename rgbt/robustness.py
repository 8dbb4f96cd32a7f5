"""What is left when images are missing or partly wrong: ``python -m rgbt.robustness run=...``.

Every severity of every degradation is evaluated and its counts are kept beside the run, each with a
file that says what it was made of. What is there already is not made again.
"""

from __future__ import annotations

import csv
import hashlib
import io
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rgbt.checks import InputError
from rgbt.command import plain_command
from rgbt.types import VIEWS, View

if TYPE_CHECKING:
    from torch import nn

    from rgbt.degraded import Chosen, Failure
    from rgbt.metrics.counts import Counts
    from rgbt.session import Session
    from rgbt.stored import Stored
    from rgbt.tracking.tables import Grid

OWN = {
    "run": "",
    "runs_dir": "runs",
    "split": "test",
    "degradations": "all",
    "regions": "as trained",
    "checkpoint": "best",
    "out": "",
}
FOLDER = "robustness"
"""Inside ``evaluations/`` of a run; `analysis.robustness` looks for curves there."""

FORMAT = "rgbt robustness 1"
CLEAN = "clean"
FEATURES: dict[View, str] = {
    "thermal": "thermal alone (features)",
    "rgb": "RGB alone (features)",
}
"""View -> what it is called beside "RGB removed (zeroed)": the network sees both images, and the
features of one branch alone are decoded."""


def main(arguments: dict[str, str], overrides: list[str]) -> int:
    """Evaluate runs under every severity of every degradation; one table per run.

    run       run folders, config keys or MLflow run ids, with commas; without one, name a network
              and its weights: model=mfnet model.weights=final.pth dataset.root=/data/MFNet
    split     split of the data set
    degradations  files of conf/degradation with commas, or all; the clean images and, of networks
              that can decode one branch alone, both branches are always measured beside them
    regions   a file of conf/metric: ring5, ring9, vertical5, horizontal5
    checkpoint  best (by validation mIoU) or last
    out       folder of the counts of one run; default: evaluations/robustness/ in the run folder
    overrides such as dataset=mfnet dataset.root=/data/MFNet, degradation.seed=1 (of what is drawn),
              and of a single degradation any key: degradations=noise degradation.severities=[4,12]

    Stopped and given again, it goes on; what is there is made again only where the data, the
    weights or the degradation differ. python -m analysis.figures figure=robustness draws it.
    """
    from rgbt.degraded import own_words
    from rgbt.stored import open_trained
    from rgbt.tracking.terminal import place_lines, rich_table, show

    words, overrides = own_words(overrides)
    chosen = chosen_of(arguments["degradations"], words)
    runs = [word.strip() for word in arguments["run"].split(",")]
    _check_comparable(arguments, overrides, runs)
    if arguments["regions"] != OWN["regions"]:
        overrides = [*overrides, f"metric={arguments['regions']}"]
    for run in runs:
        stored = open_trained(run, Path(arguments["runs_dir"]), overrides, arguments["checkpoint"])
        folder = Path(arguments["out"] or stored.folder / FOLDER / _place(stored, arguments))
        measured = measure(stored.session, arguments["split"], chosen, folder)
        grid = robustness_grid(measured, _title(stored, arguments["split"]))
        _write_tables(measured, grid, folder)
        show(rich_table(grid))
        show(place_lines([("counts", f"{folder}/ (robustness.md, robustness.csv)")]))
    return 0


def chosen_of(text: str, words: Sequence[str]) -> list[Chosen]:
    """The degradations of ``degradations=``.

    Args:
        text: names with commas, or "all".
        words: ``degradation.KEY=VALUE``; any key of a single degradation, the seed of several.

    Raises:
        InputError: an unknown name, one that stands twice, or keys of several degradations at once.
    """
    from rgbt.degraded import NODE, SEED, choose, known_degradations

    names = [name.strip() for name in text.split(",")]
    names = known_degradations() if names == ["all"] else names
    for word in words:
        key = word.partition("=")[0]
        if len(names) > 1 and key != f"{NODE}.{SEED}":
            raise InputError(
                f"'{key}' is a key of one degradation, but {len(names)} were asked for; name that "
                "one with degradations=..."
            )
    chosen = [choose(name, words) for name in names]
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


@dataclass(frozen=True)
class Asked:
    """One evaluation.

    Attributes:
        mark: name of its file.
        row: of the table: a degradation or a view, whose severities share it.
        title: what people call the row.
        unit: of the severity; "" where it has none.
        severity: 0: clean.
        view: what is predicted from.
        failure: of the images; None: they are clean.
    """

    mark: str
    row: str
    title: str
    unit: str
    severity: float
    view: View
    failure: Failure | None = None


@dataclass(frozen=True)
class Measured:
    """An evaluation with its counts, and the mIoU of each part of them as a fraction."""

    asked: Asked
    counts: Counts
    mious: dict[str, float]


def asked_of(session: Session, chosen: Sequence[Chosen]) -> tuple[Asked, ...]:
    """Clean images, single branches as far as the network decodes them, every failure."""
    from rgbt.degraded import Failure
    from rgbt.session import view_of

    view = view_of(session)
    known = getattr(session.model, "views", VIEWS)
    branches = {each: title for each, title in FEATURES.items() if view == "rgbt" and each in known}
    found = [Asked(CLEAN, CLEAN, CLEAN, "", 0.0, view)]
    for branch, title in branches.items():
        found.append(Asked(f"features-{branch}", f"features-{branch}", title, "", 1.0, branch))
    for each in chosen:
        kind = each.degradation
        for severity in kind.severities:
            failure = Failure(each, severity)
            said = (each.row, kind.title, kind.unit, severity)
            found.append(Asked(failure.mark, *said, view, failure))
    return tuple(found)


def measure(
    session: Session, split: str, chosen: Sequence[Chosen], folder: Path
) -> tuple[Measured, ...]:
    """Evaluate what is missing of a run's robustness; the clean images come first.

    Args:
        session: with the trained network.
        split: of its data set.
        chosen: degradations, each with all severities of its ladder.
        folder: of the counts; NAME.npz has a NAME.json, written after it, that says what made it.

    Raises:
        InputError: a severity that does not fit the images, or a file that cannot be read.
    """
    from rgbt.engine.progress import progress
    from rgbt.metrics.scores import miou

    folder.mkdir(parents=True, exist_ok=True)
    every = asked_of(session, chosen)
    shared = _shared_identity(session, split)
    found = []
    with progress() as display:
        task = display.add_task(FOLDER, total=len(every), note="")
        for asked in every:
            display.update(task, note=asked.mark)
            counts = _counts(session, split, asked, shared, folder)
            parts = {"": counts, **{f"{part}/": sub for part, sub in counts.parts().items()}}
            mious = {
                f"{part}mIoU": float(miou(sub.whole(), session.regions.absent, sub.scored))
                for part, sub in parts.items()
            }
            found.append(Measured(asked, counts, mious))
            display.advance(task)
    return tuple(found)


def _counts(
    session: Session, split: str, asked: Asked, shared: dict[str, Any], folder: Path
) -> Counts:
    """Those that are there if they were made of the same, else new ones."""
    from rgbt.session import evaluate
    from rgbt.tracking.files import write_atomic

    counts_file, made_file = folder / f"{asked.mark}.npz", folder / f"{asked.mark}.json"
    identity = _identity(asked, shared)
    made = {**identity, "row": asked.row, "title": asked.title, "unit": asked.unit}
    known = _read_json(made_file)
    counts = _kept(counts_file, known, identity)
    if counts is None:
        failing = session if asked.failure is None else asked.failure.applied(session, split)
        counts = evaluate(failing, session.model, split, view=asked.view).counts
        # What says that the counts are of these weights must not outlive those of others.
        made_file.unlink(missing_ok=True)
        counts.save(counts_file)
    if known != made:
        write_atomic(made_file, (json.dumps(made, indent=1) + "\n").encode())
    return counts


def _kept(file: Path, known: Any, identity: dict[str, Any]) -> Counts | None:
    """The counts in `file` if they were made of the same; None where they are missing or damaged.

    Args:
        file: of counts.
        known: what is written beside it.
        identity: see `_identity`.
    """
    from rgbt.metrics.counts import Counts

    is_same = isinstance(known, dict) and {key: known.get(key) for key in identity} == identity
    if not (file.is_file() and is_same):
        return None
    try:
        return Counts.load(file)
    except InputError:
        return None


def _identity(asked: Asked, shared: dict[str, Any]) -> dict[str, Any]:
    """What decides the counts of an evaluation, as read back from JSON."""
    plain = {
        **shared,
        "severity": asked.severity,
        "view": asked.view,
        "failure": None if asked.failure is None else asked.failure.identity(),
    }
    return dict(json.loads(json.dumps(plain)))


def _shared_identity(session: Session, split: str) -> dict[str, Any]:
    from omegaconf import OmegaConf

    return {
        "format": FORMAT,
        "dataset": session.dataset.fingerprint(),
        "split": split,
        "partition": session.regions.name,
        "weights": weights_digest(session.model),
        "transform": OmegaConf.to_container(session.config.transform, resolve=True),
        "precision": session.trainer.precision,
    }


def weights_digest(model: nn.Module) -> str:
    """SHA-256 in hexadecimal over names and bytes of all parameters and buffers that are saved."""
    import torch

    digest = hashlib.sha256()
    for name, tensor in sorted(model.state_dict().items()):
        digest.update(f"{name} {tuple(tensor.shape)} {tensor.dtype}\n".encode())
        digest.update(tensor.cpu().contiguous().reshape(-1).view(torch.uint8).numpy())
    return digest.hexdigest()


def _read_json(path: Path) -> Any:
    try:
        return json.loads(path.read_text())
    except (OSError, ValueError):  # not there, or cut short: made again
        return None


def _place(stored: Stored, arguments: dict[str, str]) -> str:
    """Folder of a split's counts: plain where the run is measured as its own evaluation is."""
    session = stored.session
    regions = [session.regions.name] if arguments["regions"] != OWN["regions"] else []
    last = [] if arguments["checkpoint"] == "best" else [arguments["checkpoint"]]
    own = _read_json(stored.folder.parent / "dataset.json") or {}
    found = session.dataset.fingerprint()
    is_other = own.get("files", found) != found
    others = [f"{session.dataset.name}-{found[:8]}"] if is_other else []
    return "_".join([arguments["split"], *regions, *last, *others])


def _title(stored: Stored, split: str) -> str:
    session = stored.session
    is_run = stored.step > 0  # a file of weights tells neither step nor seed
    seed = f" seed={session.config.seed}" if is_run else ""
    return f"Robustness of {stored.label}{seed} ({session.dataset.name}, {split}): mIoU in percent"


def robustness_grid(measured: Sequence[Measured], title: str) -> Grid:
    """One line per degradation; level 0 is the clean image, level n the n-th severity.

    Args:
        measured: the clean images first.
        title: shown above.
    """
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


def _write_tables(measured: Sequence[Measured], grid: Grid, folder: Path) -> None:
    from rgbt.tracking.files import write_atomic

    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    scores = list(measured[0].mious)
    writer.writerow(("row", "title", "unit", "severity", "view", *scores))
    for each in measured:
        asked = each.asked
        values = [100 * each.mious[score] for score in scores]
        writer.writerow(
            (asked.row, asked.title, asked.unit, f"{asked.severity:g}", asked.view, *values)
        )
    write_atomic(folder / "robustness.csv", stream.getvalue().encode())
    write_atomic(folder / "robustness.md", grid.to_markdown().encode())


if __name__ == "__main__":
    plain_command(OWN, main)()
