"""Train a run with as many processes as it has devices: alone, as a supervisor, or as one of them.

torch is imported by the processes that train, and not by the one that starts them.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager

from rgbt.checks import InputError, RunError
from rgbt.engine.settings import TrainerSettings
from rgbt.runs.run_spec import RunSpec
from rgbt.runtime.group import Group, group_from_environment
from rgbt.runtime.member import LOST, report_errors

OF_GLOO = "gloo/transport"
"""In the message of every error of a lost connection between CPUs."""


def start(run: RunSpec, extra_tags: Mapping[str, str], words: Sequence[str]) -> int:
    """Train a run after its upstream runs, or show it if it is finished; returns the exit code.

    Args:
        run: the requested run.
        extra_tags: MLflow tags of the requested run.
        words: arguments of ``rgbt run`` that describe it.

    Raises:
        InputError: the devices do not fit the processes or the batch; see `run_pipeline`.
    """
    group = group_from_environment()
    if group is not None:
        _check_group(run.trainer, group)
        _check_devices(run, group.size)
        _train_in(group, run, extra_tags)
        return 0
    is_shown = run.is_finished and not run.fresh
    devices = 1 if is_shown else _num_devices(run.trainer)
    if not is_shown:
        _check_devices(run, devices)
    if devices > 1:
        from rgbt.training.launcher import launch

        return launch(devices, words)
    from rgbt.training.pipeline import run_pipeline

    run_pipeline(run, extra_tags)
    return 0


def _num_devices(trainer: TrainerSettings) -> int:
    """Devices of this machine that a run uses: `trainer.devices`, where "auto" means all GPUs."""
    if trainer.devices != "auto":
        return trainer.devices
    if trainer.accelerator in ("cpu", "mps"):
        return 1
    import torch  # takes a second: only where it must look

    return max(1, torch.cuda.device_count())


def _check_group(trainer: TrainerSettings, group: Group) -> None:
    if trainer.devices not in ("auto", group.local_size):
        raise InputError(
            f"trainer.devices={trainer.devices}, but {group.started_by} started "
            f"{group.local_size} processes on each machine; set trainer.devices={group.local_size}."
        )


def _check_devices(run: RunSpec, num_processes: int) -> None:
    """Refuse a batch that the processes cannot share, before anything is started.

    Raises:
        InputError: of the run or of an unfinished upstream run.
    """
    for upstream in run.upstream:
        if not upstream.is_finished:
            _check_devices(upstream, num_processes)
    if run.data.batch_size % num_processes:
        from rgbt.data.loaders import check_batch_size  # with torch: only for its message

        check_batch_size(run.data, num_processes)
    if run.trainer.batch_norm_parts != 1:
        from rgbt.engine.batch_norm import check_batch_norm_parts

        check_batch_norm_parts(run.trainer.batch_norm_parts, num_processes)


def _train_in(group: Group, run: RunSpec, extra_tags: Mapping[str, str]) -> None:
    """Do the part of this process in the training of a run and its upstream runs."""
    from torch import distributed

    from rgbt.engine.fabric import group_fabric
    from rgbt.training.follow import follow
    from rgbt.training.members import dismiss
    from rgbt.training.pipeline import run_pipeline

    report_errors()
    group_fabric(run.trainer, group)
    with _losing_connection(group):
        if group.rank > 0:
            follow(run)
        else:
            try:
                run_pipeline(run, extra_tags)
            except Exception:
                dismiss()
                raise
            dismiss()
    distributed.destroy_process_group()


@contextmanager
def _losing_connection(group: Group) -> Iterator[None]:
    """Turn the loss of another process into one message, or that of the supervisor."""
    from torch import distributed

    try:
        yield
    except RuntimeError as error:
        if not isinstance(error, distributed.DistError) and OF_GLOO not in str(error):
            raise
        if group.is_supervised:
            sys.exit(LOST)
        raise RunError(
            "another process of this run ended; its own message says why. Rerun the command to "
            "resume from the last checkpoint."
        ) from error
