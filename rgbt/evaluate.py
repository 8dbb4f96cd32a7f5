"""Evaluate a run, or weights from a file: ``python -m rgbt.evaluate run=runs/<key>``.

Counts are written, and the tables that follow from them are shown.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from rgbt.checks import InputError
from rgbt.config.common_options import (
    AS_TRAINED,
    Checkpoint,
    Head,
    Modality,
    RegionsFile,
    RunsDir,
    Split,
    Trained,
    Trust,
)
from rgbt.config.options import Help
from rgbt.config.plain_command import PlainCommand

if TYPE_CHECKING:
    from rgbt.evaluation.corrupted import Failure


@dataclass(frozen=True)
class Options:
    """What is evaluated, and on which images."""

    run: Trained = ""
    runs_dir: RunsDir = Path("runs")
    split: Split = "test"
    modality: Modality = "default"
    regions: RegionsFile = "as trained"
    head: Head = "as trained"
    degradation: Annotated[
        str,
        Help(
            "of the images: a file of conf/degradation such as thermal_removed or noise, with a "
            "severity: degradation=noise severity=16; rgbt robustness takes all of them"
        ),
    ] = "none"
    severity: Annotated[str, Help("of the degradation")] = ""
    checkpoint: Checkpoint = "best"
    trust: Trust = ""
    out: Annotated[
        Path | None, Help("file of the counts; default: evaluations/ in the run folder")
    ] = None


def main(options: Options, overrides: list[str]) -> int:
    """Evaluate a run, on its own data set or another one, or a network with weights from a file.

    Overrides such as dataset=mfnet dataset.root=/data/MFNet data.eval_batch_size=1, and of the
    degradation: degradation.block=16 degradation.seed=1
    """
    from rgbt.build.load_run import open_trained
    from rgbt.build.session import evaluate, result_tables, view_of
    from rgbt.config.stored_config import parse_trust
    from rgbt.evaluation.corrupted import own_words
    from rgbt.tracking.terminal import print_rich, result_view
    from rgbt.training.overview import announce_network

    if options.out is not None and options.out.is_dir():
        raise InputError(f"out={options.out} is a folder; name the file of the counts, x.npz.")
    words, overrides = own_words(overrides)
    trust = parse_trust(options.trust)
    failure = _failure(options, words, trust)
    if options.regions != AS_TRAINED:
        overrides = [*overrides, f"metric={options.regions}"]
    run, runs_dir, checkpoint = options.run, options.runs_dir, options.checkpoint
    stored = open_trained(run, runs_dir, overrides, checkpoint, trust=trust)
    announce_network(stored)
    session = stored.session
    view = view_of(session, options.modality)
    head = None if options.head == AS_TRAINED else options.head
    if failure is not None:
        session = failure.applied(session, options.split)
    found = evaluate(session, session.model, options.split, view=view, head=head)
    counts = found.counts
    stem = "_".join(
        [session.dataset.name, counts.split, view, counts.partition]
        + ([] if head is None else [f"{head}-head"])
        + ([] if failure is None else [failure.mark])
        + ([] if checkpoint == "best" else [checkpoint])
    )
    path = options.out or stored.folder / f"{stem}.npz"
    path.parent.mkdir(parents=True, exist_ok=True)
    counts.save(path)
    label = f"{stored.label} {session.dataset.name} {view}{f' {head} head' if head else ''}"
    label += f", {failure.told}" if failure else ""
    tables = result_tables(counts, session.regions, label, stored.step)
    heads = session.domains.told(head or session.domains.tested_head)
    places = [*([("heads", heads)] if heads else []), ("counts", str(path))]
    if found.skipped:
        places.append(("left out", f"{len(found.skipped)} images that cannot be read"))
    print_rich(result_view(tables, path.parent, places))
    return 0


def _failure(options: Options, words: list[str], trust: Collection[str]) -> Failure | None:
    """The degradation and its severity; None where none is asked for."""
    from rgbt.evaluation.corrupted import choose

    if options.degradation != "none":
        return choose(options.degradation, words, trust).at(options.severity)
    idle = [*(["severity"] if options.severity else []), *words]
    if idle:
        key = idle[0].partition("=")[0]
        raise InputError(f"'{key}' has no effect without degradation=..., for example noise.")
    return None


entry = PlainCommand(Options, main)

if __name__ == "__main__":
    entry()
