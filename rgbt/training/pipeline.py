"""Train a run after its upstream runs, in topological order.

A finished upstream run is used as it is. An interrupted one is resumed, and the command waits for
one that another process trains. Of several processes of a run, process 0 looks at files, and the
others do as it found (`agreed`).
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager

from rgbt.assembly.load_run import with_weights
from rgbt.assembly.training_setup import validate
from rgbt.checks import InputError
from rgbt.evaluation.request import EvaluationRequest
from rgbt.files.atomic import is_held
from rgbt.files.plain_files import check_links
from rgbt.processes import agreed, alone, num_processes, rank
from rgbt.runs.provenance import other_code
from rgbt.runs.run_spec import WEIGHTS, Dependency, RunSpec
from rgbt.terminal import info, warn
from rgbt.training.train import train

POLL_S = 1.0
"""Interval between two checks of a run that another process trains."""


def run_pipeline(run: RunSpec, extra_tags: Mapping[str, str]) -> None:
    """Train a run after the runs upstream of it.

    The whole pipeline is validated before the first run starts.

    Args:
        run: the requested run.
        extra_tags: MLflow tags of the requested run; its upstream runs do not get them.

    Raises:
        InputError: see `validate` and `train`; the message names the upstream run that is wrong.
    """
    upstream = run.upstream
    for spec in upstream:
        check_links(spec.folder)
    for dependency in run.dependencies if run.fresh else ():  # fresh=true does not repeat them
        spec = dependency.run
        made_by = other_code(spec.folder) if spec.is_finished else None
        if made_by is not None:
            warn(
                f"the upstream run {spec.folder} ({dependency.key}) was trained by other code "
                f"({made_by}) and is used as it is. To train it again, run "
                f"+experiment={spec.name} with fresh=true."
            )
    if agreed(run.is_finished) and not run.fresh:
        train(run, extra_tags)  # shows the result
        return
    specs = topological_order(run)
    if rank() == 0:
        _validate(specs, run)
    for spec in specs:
        teachers = [each for each in spec.dependencies if each.key != WEIGHTS]
        with _naming(spec, run):
            for teacher in teachers if rank() == 0 else ():
                _predict_labels(spec, teacher)
            agreed(None)  # process 0 has written the labels
            if spec is run:
                train(run, extra_tags)
            else:
                _train_upstream(spec, run)


def topological_order(run: RunSpec) -> list[RunSpec]:
    """The unfinished runs upstream of a run, each after those that it depends on, then the run."""
    order: dict[str, RunSpec] = {}
    for spec in run.upstream:
        if not agreed(spec.is_finished):
            order |= {each.key: each for each in topological_order(spec)}
    return [*order.values(), run]


@contextmanager
def _naming(spec: RunSpec, run: RunSpec) -> Iterator[None]:
    """Name the upstream run in an error of it."""
    try:
        yield
    except InputError as error:
        if spec is run:
            raise
        raise InputError(f"upstream run {spec.name} of {run.name}: {error}") from error


@alone()
def _validate(specs: Sequence[RunSpec], run: RunSpec) -> None:
    """Validate a run and those upstream of it, unless all that it depends on is there already."""
    labels = [run.labels_folder(name) for name in run.domains.named]
    has_labels = all(each is None or each.is_dir() for each in labels)  # renamed when complete
    if has_labels and all(each.is_finished for each in run.upstream):
        return
    for spec in specs:
        with _naming(spec, run):
            validate(spec)


def _train_upstream(spec: RunSpec, run: RunSpec) -> None:
    is_waiting = False
    while not agreed(spec.is_finished):
        if agreed(is_held(spec.folder / "lock")):
            if not is_waiting:
                info(f"{spec.folder} is being trained by another process; waiting for it.")
            is_waiting = True
            time.sleep(POLL_S)
            continue
        try:
            train(spec, upstream_of=run.name)
        except InputError:
            # Another process may have started it since the look, and even finished it.
            if num_processes() > 1 or not (spec.is_finished or is_held(spec.folder / "lock")):
                raise


@alone()
def _predict_labels(spec: RunSpec, teacher: Dependency) -> None:
    """Predict the pseudo-labels of a run with the network of an upstream run."""
    name = teacher.key.split(".")[1]
    folder, domain = spec.labels_folder(name), spec.domains.named[name]
    assert folder is not None, "the domain takes labels of an upstream run"
    if folder.is_dir():
        return
    checkpoint = teacher.checkpoint.removesuffix(".pt")
    # Its configuration is the one that this command composed; its folder may be a copy.
    session = with_weights(teacher.run, teacher.run.folder, checkpoint, teacher.run.plain)
    from rgbt.evaluation.images import write_pseudo_labels  # few runs have a teacher

    write_pseudo_labels(
        session,
        teacher.run.folder.name,
        EvaluationRequest(split=domain.split, view=domain.teacher_view),
        folder,
        threshold=domain.threshold,
    )
