"""Open Lightning Fabric for a training, in one process or in one of several."""

from __future__ import annotations

import logging
from datetime import timedelta

import torch
from lightning_fabric import Fabric
from lightning_fabric.plugins.environments.lightning import LightningEnvironment
from lightning_fabric.plugins.environments.slurm import SLURMEnvironment
from lightning_fabric.plugins.environments.torchelastic import TorchElasticEnvironment
from lightning_fabric.strategies.ddp import DDPStrategy
from torch import nn

from rgbt.engine.device import choose_device
from rgbt.engine.settings import TrainerSettings
from rgbt.runtime.group import group_from_environment

# Fabric sets itself to INFO when imported, and would repeat the configuration in a line, and with
# trainer.matmul_precision=highest recommend TF32.
logging.getLogger("lightning_fabric").setLevel(logging.WARNING)

PATIENCE = timedelta(days=7)  # process 0 may wait for the training of another command


def open_fabric(trainer: TrainerSettings) -> Fabric:
    """Open Fabric for the device of this process; of several, it connects them the first time."""
    device, group = choose_device(trainer), group_from_environment()
    if group is None:
        # Without an environment, Fabric reads the variables of SLURM, also for a single process.
        alone = LightningEnvironment()
        return Fabric(
            accelerator=device.type, devices=1, precision=trainer.precision, plugins=[alone]
        )
    environment = TorchElasticEnvironment if TorchElasticEnvironment.detect() else SLURMEnvironment
    devices, visible = [device] * group.local_size, 0
    if device.type == "cuda" and (visible := torch.cuda.device_count()) > 1:
        devices = [torch.device("cuda", index) for index in range(group.local_size)]
    fabric = Fabric(
        accelerator=device.type,
        devices=1 if visible == 1 else group.local_size,  # SLURM may show each process its own GPU
        num_nodes=group.size // group.local_size,
        precision=trainer.precision,
        strategy=_OneProcessPerDevice(
            parallel_devices=devices,
            cluster_environment=environment(),
            # What is not on a GPU goes through gloo, which waits without using a core.
            process_group_backend="cpu:gloo,cuda:nccl" if device.type == "cuda" else "gloo",
            timeout=PATIENCE,
        ),
    )
    fabric.launch()
    return fabric


class _OneProcessPerDevice(DDPStrategy):
    """Places and connects the processes; the loop averages gradients (`rgbt.processes`)."""

    def setup_module(self, module: nn.Module) -> nn.Module:  # type: ignore[override]
        return module
