"""Open Lightning Fabric for a training, in one process or in one process for each device."""

from __future__ import annotations

import logging
from datetime import timedelta

import torch
from lightning_fabric import Fabric
from lightning_fabric.plugins.environments.cluster_environment import ClusterEnvironment
from lightning_fabric.plugins.environments.lightning import LightningEnvironment
from lightning_fabric.strategies.ddp import DDPStrategy
from torch import nn

from rgbt.checks import InputError
from rgbt.engine.device import choose_device
from rgbt.engine.settings import TrainerSettings
from rgbt.processes import num_processes
from rgbt.runtime.group import Group, group_from_environment

# Fabric sets itself to INFO when imported, and would repeat the configuration in a line.
logging.getLogger("lightning_fabric").setLevel(logging.WARNING)

PATIENCE = timedelta(days=7)
"""Time that processes wait for each other: process 0 does some work alone, and may wait for an
upstream run that another command trains."""

CPU, CUDA = "gloo", "cpu:gloo,cuda:nccl"
"""Connections of the processes; what is not on a GPU goes through gloo, which waits idly."""


def open_fabric(trainer: TrainerSettings) -> Fabric:
    """Device and precision of a training; within a connected group, those of this process.

    Raises:
        InputError: the machine has no such device.
    """
    group = group_from_environment() if num_processes() > 1 else None
    if group is not None:
        return group_fabric(trainer, group)
    # Without an environment, Fabric reads the variables of SLURM, also for a single process.
    return Fabric(
        accelerator=choose_device(trainer).type,
        devices=1,
        precision=trainer.precision,
        plugins=[LightningEnvironment()],
    )


def group_fabric(trainer: TrainerSettings, group: Group) -> Fabric:
    """Device, precision and connection of this process of a group; connects it the first time.

    Raises:
        InputError: the machine has no such devices, or they do not support the precision.
    """
    device = _device(trainer, group)
    # A job of SLURM may show each process its own GPU alone.
    shown = torch.cuda.device_count() if device.type == "cuda" else group.local_size
    index = group.local_rank if shown > 1 else 0
    places = [torch.device("cuda", index)] if device.type == "cuda" else [device]
    strategy = _OneProcessPerDevice(
        parallel_devices=places * group.local_size,
        cluster_environment=_Environment(group),
        process_group_backend=CUDA if device.type == "cuda" else CPU,
        timeout=PATIENCE,
    )
    fabric = Fabric(
        accelerator=device.type,
        strategy=strategy,
        devices=min(shown, group.local_size),
        num_nodes=group.size // group.local_size,
        precision=trainer.precision,
    )
    fabric.launch()
    return fabric


def _device(trainer: TrainerSettings, group: Group) -> torch.device:
    """The type of the devices of the group, which this machine has.

    Raises:
        InputError: it has too few of them.
    """
    num_gpus = torch.cuda.device_count()
    if trainer.accelerator == "cpu" or (trainer.accelerator == "auto" and not num_gpus):
        return torch.device("cpu")
    if trainer.accelerator == "mps":
        raise InputError(
            f"trainer.accelerator=mps has one device, but trainer.devices={group.local_size}; "
            "set trainer.devices=1."
        )
    if num_gpus < group.local_size and num_gpus != 1:
        raise InputError(too_few_gpus(group.local_size, num_gpus))
    if num_gpus == 1 and group.is_supervised:
        raise InputError(too_few_gpus(group.local_size, num_gpus))
    return torch.device("cuda")


def too_few_gpus(requested: int, found: int) -> str:
    """The message about more devices than this machine has GPUs."""
    return (
        f"trainer.devices={requested}, but this machine shows {found} GPU{'s' * (found != 1)} "
        "(see nvidia-smi and CUDA_VISIBLE_DEVICES); set trainer.devices to at most that number, or "
        "to auto."
    )


class _OneProcessPerDevice(DDPStrategy):
    """Places and connects the processes; networks are not wrapped, and nothing is launched.

    Gradients are averaged by the training loop (`rgbt.engine.gradients`).
    """

    def setup_module(self, module: nn.Module) -> nn.Module:  # type: ignore[override]
        return module

    def _configure_launcher(self) -> None:
        self._launcher = None


class _Environment(ClusterEnvironment):
    """A `Group` as Fabric reads it."""

    def __init__(self, group: Group) -> None:
        super().__init__()
        self._group = group

    @property
    def creates_processes_externally(self) -> bool:
        return True

    @property
    def main_address(self) -> str:
        return self._group.address

    @property
    def main_port(self) -> int:
        return self._group.port

    @staticmethod
    def detect() -> bool:
        return False

    def world_size(self) -> int:
        return self._group.size

    def set_world_size(self, size: int) -> None:
        del size

    def global_rank(self) -> int:
        return self._group.rank

    def set_global_rank(self, rank: int) -> None:
        del rank

    def local_rank(self) -> int:
        return self._group.local_rank

    def node_rank(self) -> int:
        return self._group.rank // self._group.local_size
