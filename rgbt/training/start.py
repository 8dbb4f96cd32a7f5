"""Train a run in as many processes as it has devices: here, or by torchrun, which this starts."""

from __future__ import annotations

import os
import signal
import socket
import sys
import time
from collections.abc import Mapping, Sequence

from rgbt.checks import InputError, RunError
from rgbt.engine.settings import TrainerSettings
from rgbt.runs.run_spec import RunSpec
from rgbt.runtime.group import Group, group_from_environment
from rgbt.runtime.signals import WORDS, Stopped
from rgbt.terminal import info

OF_GLOO = "gloo/transport"
"""In the message of every error of a lost connection between CPUs."""

GRACE_S = 5.0
"""Time in which torchrun or srun ends a process because another one has failed, in seconds."""

SHUTDOWN_S = 300
"""Time that torchrun waits for the step in progress and its checkpoint, in seconds."""


def start(run: RunSpec, extra_tags: Mapping[str, str], words: Sequence[str]) -> int:
    """Train a run after its upstream runs; returns the exit code.

    Args:
        run: the requested run.
        extra_tags: MLflow tags of the requested run.
        words: arguments of ``rgbt run`` that describe it.

    Raises:
        InputError: the devices do not fit the processes or the batch; see `run_pipeline`.
    """
    from rgbt.data.loaders import check_batch_size
    from rgbt.engine.batch_norm import check_batch_norm_parts
    from rgbt.training.pipeline import run_pipeline, topological_order

    group = group_from_environment()
    size = group.size if group else _num_devices(run.trainer)
    for spec in topological_order(run):
        check_batch_size(spec.data, size)
        check_batch_norm_parts(spec.trainer.batch_norm_parts, size)
    if group is not None:
        _take_part(group, run, extra_tags)
        return 0
    if size > 1:
        return launch(size, words)
    run_pipeline(run, extra_tags)
    return 0


def _num_devices(trainer: TrainerSettings) -> int:
    """Devices of this machine that a run uses: `trainer.devices`, where "auto" means all GPUs."""
    import torch

    found = torch.cuda.device_count() if trainer.accelerator in ("auto", "cuda") else 0
    if trainer.devices == "auto":
        return max(1, found)
    if found and trainer.devices > found:
        raise InputError(
            f"trainer.devices={trainer.devices}, but this machine shows {found} GPUs (see "
            "nvidia-smi and CUDA_VISIBLE_DEVICES)."
        )
    return trainer.devices


def _take_part(group: Group, run: RunSpec, extra_tags: Mapping[str, str]) -> None:
    """Do the part of this process in the training of a run and its upstream runs."""
    from torch import distributed

    from rgbt.engine.fabric import open_fabric
    from rgbt.training.pipeline import run_pipeline

    try:
        open_fabric(run.trainer)
        run_pipeline(run, extra_tags)
    except Exception as error:
        is_lost = isinstance(error, distributed.DistError) or OF_GLOO in str(error)
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

    # Threads of one process that wait in a loop would take the cores of the others.
    preferred = {"OMP_WAIT_POLICY": "PASSIVE", "OMP_NUM_THREADS": "1"}
    if any(name == "lo" for _, name in socket.if_nameindex()):
        # Otherwise gloo looks up the name of this machine, which containers may not know.
        preferred["GLOO_SOCKET_IFNAME"] = "lo"
    for name, value in preferred.items():
        os.environ.setdefault(name, value)
    heard = [each.name for each in WORDS if signal.getsignal(each) is not signal.SIG_IGN]  # nohup
    options = [f"--signals-to-handle={','.join(heard)}", f"--shutdown-timeout={SHUTDOWN_S}"]
    known = get_args_parser().format_help()  # older versions of torch have neither
    options = [each for each in options if each.partition("=")[0] in known]
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
