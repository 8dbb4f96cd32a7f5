"""Describe data, device and network on stderr before the first progress bar of a command."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from torch import nn

from rgbt.assembly.session import Session
from rgbt.checks import without_controls
from rgbt.processes import num_processes
from rgbt.terminal import path_lines

if TYPE_CHECKING:  # it imports Lightning Fabric, which only a training needs
    from rgbt.assembly.training_setup import TrainingSetup

MILLION = 1e6


def announce_training(setup: TrainingSetup, name: str, folder: Path) -> None:
    """Print device, network, images, their sizes, steps and run folder of a training.

    With rare class sampling, also the probability of each class.
    """
    session, trainer = setup.session, setup.session.trainer
    trained = {key: net for key, net in setup.others.items() if key in setup.optimizers}
    others = "".join(f", {key} {_millions(net)}" for key, net in trained.items())
    counts = [f"{len(names)} {split}" for split, names in setup.names.items()]
    lines = [
        ("device", device_line(session)),
        ("network", f"{network_line(session)}{others}"),
        ("images", f"{session.dataset.name}: {', '.join(counts)}"),
        ("sizes", ", ".join(f"{name} {h}x{w}" for name, (h, w) in setup.sizes.items())),
        *([("drawn", setup.rare.shares())] if setup.rare else []),
        ("steps", f"{trainer.max_steps} {_of_steps(setup)}"),
        ("folder", str(folder)),
    ]
    _write(name, *(f"  {line}" for line in path_lines(lines).plain.splitlines()))


def announce_upstream(setup: TrainingSetup, name: str, downstream: str) -> None:
    """Print an upstream run, the run that needs it, network, steps and folder in one line."""
    session = setup.session
    steps = f"{session.trainer.max_steps} steps {_of_steps(setup)}"
    parts = [network_line(session), steps, str(session.spec.folder)]
    _write(f"upstream run {name} for {downstream}: {', '.join(parts)}")


def announce_network(session: Session) -> None:
    """Print device, network and checkpoint of a prediction in one line."""
    from rgbt.exported.onnx_network import ExportedNetwork  # which is never trained

    checkpoint = f"checkpoint of step {session.step}" if session.step else session.label
    if isinstance(session.model, ExportedNetwork):
        network = f"{session.model.description.network} in onnxruntime"
    else:
        network = network_line(session)
    _write(f"{device_line(session)}; {network}; {checkpoint}")


def device_line(session: Session) -> str:
    """The device with its precision: "cpu, 2 threads, 32-true"."""
    device = session.device
    gpu = f" ({torch.cuda.get_device_name(device)})" if device.type == "cuda" else ""
    threads = torch.get_num_threads()
    plural = "" if threads == 1 else "s"
    name, each = f"{device}", ""
    if num_processes() > 1:
        name, each = f"{num_processes()} x {device.type}", " each"
    return f"{name}{gpu}, {threads} thread{plural}{each}, {session.trainer.precision}"


def network_line(session: Session) -> str:
    """Class and number of parameters: "Mask2Former, 1.23 M parameters", and of trained ones."""
    every, trained = _millions(session.model), _millions(session.model, only_trained=True)
    of_which = f", {trained} trained" if trained != every else ""
    return f"{type(session.model).__name__}, {every} parameters{of_which}"


def _of_steps(setup: TrainingSetup) -> str:
    """Batch, epochs and validation: "of batch 2 (6 epochs), validated every 3"."""
    session, trainer = setup.session, setup.session.trainer
    batch = session.loading.batch_size * trainer.accumulate
    epochs = trainer.max_steps * trainer.accumulate / setup.steps_per_epoch()
    validated = f"validated every {trainer.eval_every}"
    if session.selection_split is None:
        validated = f"not validated: {session.dataset.name} has no {trainer.selection_split}"
    return f"of batch {batch} ({epochs:.3g} epochs), {validated}"


def _write(*lines: str) -> None:
    # Not as a message (`info`): drivers of sweeps take the last remark for what went wrong.
    sys.stderr.write(without_controls("".join(f"{line}\n" for line in lines)))


def _millions(network: nn.Module, *, only_trained: bool = False) -> str:
    parameters = (p for p in network.parameters() if p.requires_grad or not only_trained)
    return f"{sum(each.numel() for each in parameters) / MILLION:.2f} M"
