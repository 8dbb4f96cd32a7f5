"""Train a run after its upstream runs, in as many processes as it has devices.

A finished upstream run is used as it is. An interrupted one is resumed, and the command waits for
one that another process trains. Of several processes, which torchrun or srun start, process 0 looks
at files for all of them (`computed_once`).
"""

from __future__ import annotations

import os
import signal
import socket
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager

import torch
from torch import distributed

from rgbt.assembly.training_setup import validate
from rgbt.checks import InputError, RunError
from rgbt.cores import sleep_while_waiting
from rgbt.data.loaders import check_batch_size
from rgbt.engine.batch_norm import check_batch_norm_parts
from rgbt.engine.fabric import open_fabric
from rgbt.engine.settings import TrainerSettings
from rgbt.files.plain_files import check_links
from rgbt.processes import computed_once, num_processes
from rgbt.runs.provenance import other_code
from rgbt.runs.run_spec import RunSpec
from rgbt.runtime.group import Group, group_from_environment
from rgbt.runtime.signals import WORDS, Stopped
from rgbt.terminal import info, warn
from rgbt.training.train import predict_labels, train_run

# Part of every error message about a lost connection between CPUs.
LOST_CONNECTION = "gloo/transport"

# Time in which torchrun or srun ends a process because another one has failed, in seconds.
GRACE_S = 5.0

# Time that torchrun waits for the step in progress and its checkpoint, in seconds.
SHUTDOWN_S = 300

# Interval between two checks of a run that another process trains.
POLL_S = 1.0


def start(run: RunSpec, extra_tags: Mapping[str, str], words: Sequence[str]) -> int:
    """Train a run after its upstream runs, see `run_pipeline`; returns the exit code.

    `words` are the arguments of ``rgbt run`` that describe it. InputError: the devices do not fit
    the processes or the batch.
    """
    group = group_from_environment()
    size = group.size if group else _num_devices(run.trainer)
    for spec in run.pending if size > 1 else ():
        check_batch_size(spec.data, size)
        check_batch_norm_parts(spec.trainer.batch_norm_parts, size)
    if group is None and size > 1:
        return launch(size, words)
    with _taking_part(group, run.trainer):
        run_pipeline(run, extra_tags)
    return 0


def _num_devices(trainer: TrainerSettings) -> int:
    """Count the devices that a run uses: `trainer.devices`, where "auto" means all GPUs."""
    found = torch.cuda.device_count() if trainer.accelerator in ("auto", "cuda") else 0
    if trainer.devices == "auto":
        return max(1, found)
    if found and trainer.devices > found:
        raise InputError(
            f"trainer.devices={trainer.devices}, but this machine shows {found} GPUs (see "
            "nvidia-smi and CUDA_VISIBLE_DEVICES)."
        )
    return trainer.devices


@contextmanager
def _taking_part(group: Group | None, trainer: TrainerSettings) -> Iterator[None]:
    """Connect the processes of a run, if there are several; one of them reports an error."""
    if group is None:
        yield
        return
    try:
        open_fabric(trainer)
        yield
    except Exception as error:
        is_lost = isinstance(error, distributed.DistError) or LOST_CONNECTION in str(error)
        if group.rank == 0 and not is_lost:
            raise
        # The process that failed first reports it; this one is ended meanwhile, or failed alone.
        try:
            time.sleep(GRACE_S)
        except Stopped as stop:
            sys.exit(stop.code)
        sys.stdout, sys.stderr = sys.__stdout__, sys.__stderr__
        title = f"process {group.rank} of {group.size}"
        if is_lost:
            raise RunError(f"{title} lost another one; rerun the command to resume.") from error
        if isinstance(error, InputError | RunError):
            raise type(error)(f"{title}: {error}") from error
        raise
    distributed.destroy_process_group()


def launch(num_processes: int, words: Sequence[str]) -> int:
    """Run ``rgbt run`` with these words in so many processes by torchrun; returns its exit code."""
    from torch.distributed.elastic.multiprocessing.api import SignalException
    from torch.distributed.elastic.multiprocessing.errors import ChildFailedError
    from torch.distributed.run import get_args_parser, main

    sleep_while_waiting()
    preferred = {"OMP_NUM_THREADS": "1"}
    if any(name == "lo" for _, name in socket.if_nameindex()):
        # Otherwise gloo looks up the name of this machine, which containers may not know.
        preferred["GLOO_SOCKET_IFNAME"] = "lo"
    for name, value in preferred.items():
        os.environ.setdefault(name, value)
    heard = [sent.name for sent in WORDS if signal.getsignal(sent) is not signal.SIG_IGN]  # nohup
    options = []
    known = get_args_parser().format_help()  # older versions of torch have neither of these
    if "--signals-to-handle" in known:
        options.append(f"--signals-to-handle={','.join(heard)}")
    if "--shutdown-timeout" in known:
        options.append(f"--shutdown-timeout={SHUTDOWN_S}")
    options += ["--standalone", "--local-addr=127.0.0.1", f"--nproc-per-node={num_processes}"]
    try:
        main([*options, "-m", "rgbt.run", *words])
    except SignalException as stop:
        return 128 + int(stop.sigval)
    except ChildFailedError as failed:
        rank, failure = failed.get_first_failure()
        if failure.exitcode > 0:  # it has said why
            return failure.exitcode
        name = signal.Signals(-failure.exitcode).name
        info(f"process {rank} of {num_processes} was stopped by {name}; rerun to resume.")
        return 128 - failure.exitcode
    return 0


def run_pipeline(run: RunSpec, extra_tags: Mapping[str, str]) -> None:
    """Train a run after those upstream of it; all are validated before the first one starts.

    Args:
        run: the requested run.
        extra_tags: MLflow tags of the requested run; its upstream runs do not get them.

    Raises:
        InputError: see `train_run`; the message names the upstream run that is wrong.
    """
    for dependency in run.dependencies:
        folder = dependency.run.folder
        check_links(folder)
        if not (run.fresh and dependency.run.is_finished):
            continue
        made_by = other_code(folder)
        if made_by is not None:  # fresh=true does not repeat it
            warn(
                f"the upstream run {folder} ({dependency.key}) was trained by other code "
                f"({made_by}) and is used as it is. To train it again, run "
                f"+experiment={dependency.run.name} with fresh=true."
            )
    for spec in computed_once(lambda: _validated(run)):
        with _naming(spec, run):
            if spec.dependencies:
                _predict_labels(spec)
            if spec.key == run.key:
                train_run(spec, extra_tags)
            else:
                _train_upstream(spec, run.name)


def _validated(run: RunSpec) -> tuple[RunSpec, ...]:
    """Return the runs to train in order, after validating several, or one that lacks labels."""
    specs = run.pending
    if len(specs) > 1 or (run.dependencies and run.missing_labels):
        for spec in specs:
            with _naming(spec, run):
                validate(spec)
    return specs


def _predict_labels(spec: RunSpec) -> None:
    computed_once(lambda: predict_labels(spec))


@contextmanager
def _naming(spec: RunSpec, run: RunSpec) -> Iterator[None]:
    """Name the upstream run in an error of it."""
    try:
        yield
    except InputError as error:
        if spec.key == run.key:
            raise
        raise InputError(f"upstream run {spec.name} of {run.name}: {error}") from error


def _train_upstream(spec: RunSpec, downstream: str) -> None:
    is_waiting = False
    while True:
        is_finished, is_locked = computed_once(lambda: (spec.is_finished, spec.is_locked))
        if is_finished:
            return
        if is_locked:
            if not is_waiting:
                info(f"{spec.folder} is being trained by another process; waiting for it.")
            is_waiting = True
            time.sleep(POLL_S)
            continue
        try:
            train_run(spec, upstream_of=downstream)
        except InputError:
            # Another process may have started it since the look, and even finished it.
            if num_processes() > 1 or not (spec.is_finished or spec.is_locked):
                raise
