"""Evaluate a run, or weights from a file: ``python -m rgbt.evaluate run=runs/<key>``.

Counts are written, and the tables that follow from them are shown.
"""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path
from typing import TYPE_CHECKING, cast, get_args

from rgbt.checks import InputError, check_choice
from rgbt.config.command import plain_command
from rgbt.data.domains import TestedHead

if TYPE_CHECKING:
    from rgbt.evaluation.corrupted import Failure

OWN = {
    "run": "",
    "runs_dir": "runs",
    "split": "test",
    "modality": "default",
    "regions": "as trained",
    "head": "as trained",
    "degradation": "none",
    "severity": "",
    "checkpoint": "best",
    "trust": "",
    "out": "",
}


def main(arguments: dict[str, str], overrides: list[str]) -> int:
    """Evaluate a run, on its own data set or another one, or a network with weights from a file.

    run       run folder, config key or MLflow run id; without one, name a network and its weights:
              model=mfnet model.weights=final.pth dataset.root=/data/MFNet (scale=paper)
    split     split of the data set
    modality  rgbt, rgb or thermal: what is predicted from; default: what the network is made for
    regions   a file of conf/metric: ring5, ring9, vertical5, horizontal5
    head      of a network with a head per domain: own, source or target
    degradation  of the images: a file of conf/degradation such as thermal_removed or noise, with a
              severity: degradation=noise severity=16; python -m rgbt.robustness takes all of them
    checkpoint  best (by validation mIoU) or last
    trust     modules of yours that the run was made with: trust=my_lab; their code is run
    out       file of the counts; default: evaluations/ in the run folder
    overrides such as dataset=mfnet dataset.root=/data/MFNet data.eval_batch_size=1, and of the
              degradation: degradation.block=16 degradation.seed=1
    """
    from rgbt.build.load_run import open_trained
    from rgbt.build.session import evaluate, result_tables, view_of
    from rgbt.config.stored_config import parse_trust
    from rgbt.evaluation.corrupted import own_words
    from rgbt.tracking.terminal import result_view, show
    from rgbt.training.overview import announce_network

    if Path(arguments["out"] or "x").is_dir():
        raise InputError(f"out={arguments['out']} is a folder; name the file of the counts, x.npz.")
    words, overrides = own_words(overrides)
    trust = parse_trust(arguments["trust"])
    failure = _failure(arguments, words, trust)
    if arguments["regions"] != OWN["regions"]:
        overrides = [*overrides, f"metric={arguments['regions']}"]
    runs_dir = Path(arguments["runs_dir"])
    run, checkpoint = arguments["run"], arguments["checkpoint"]
    stored = open_trained(run, runs_dir, overrides, checkpoint, trust=trust)
    announce_network(stored)
    session = stored.session
    view = view_of(session, arguments["modality"])
    head = _head(arguments["head"])
    if failure is not None:
        session = failure.applied(session, arguments["split"])
    found = evaluate(session, session.model, arguments["split"], view=view, head=head)
    counts = found.counts
    stem = "_".join(
        [session.dataset.name, counts.split, view, counts.partition]
        + ([] if head is None else [f"{head}-head"])
        + ([] if failure is None else [failure.mark])
        + ([] if arguments["checkpoint"] == "best" else [arguments["checkpoint"]])
    )
    path = Path(arguments["out"] or stored.folder / f"{stem}.npz")
    path.parent.mkdir(parents=True, exist_ok=True)
    counts.save(path)
    label = f"{stored.label} {session.dataset.name} {view}{f' {head} head' if head else ''}"
    label += f", {failure.told}" if failure else ""
    tables = result_tables(counts, session.regions, label, stored.step)
    heads = session.domains.told(head or session.domains.tested_head)
    places = [*([("heads", heads)] if heads else []), ("counts", str(path))]
    if found.skipped:
        places.append(("left out", f"{len(found.skipped)} images that cannot be read"))
    show(result_view(tables, path.parent, places))
    return 0


def _head(asked: str) -> TestedHead | None:
    if asked == OWN["head"]:
        return None
    check_choice("head", asked, get_args(TestedHead))
    return cast(TestedHead, asked)


def _failure(arguments: dict[str, str], words: list[str], trust: Collection[str]) -> Failure | None:
    """The degradation and its severity; None where none is asked for."""
    from rgbt.evaluation.corrupted import choose

    if arguments["degradation"] != OWN["degradation"]:
        return choose(arguments["degradation"], words, trust).at(arguments["severity"])
    idle = [*(["severity"] if arguments["severity"] else []), *words]
    if idle:
        key = idle[0].partition("=")[0]
        raise InputError(f"'{key}' has no effect without degradation=..., for example noise.")
    return None


if __name__ == "__main__":
    plain_command(OWN, main)()
