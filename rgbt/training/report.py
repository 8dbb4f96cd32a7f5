"""Say what a run works with before its first progress bar, and show its result.

A finished run is shown without torch, and without its store unless it lacks something of the run.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from rich.text import Text

from rgbt.checks import InputError, without_controls
from rgbt.runs.folder import (
    GROUP,
    Description,
    RunFolder,
    read_description,
    read_result,
    read_tables,
)
from rgbt.runs.naming import describe
from rgbt.runs.needs import GB, SPARE_GB, checkpoint_bytes, free_bytes, in_gb, step_gb
from rgbt.runs.provenance import warn_of_result
from rgbt.runs.run_spec import RunSpec
from rgbt.tables import ResultTables, percent, subset_mious
from rgbt.terminal import info, path_lines, print_rich, result_view, warn
from rgbt.tracking.tracker import Tracking
from rgbt.training.next_steps import next_steps

if TYPE_CHECKING:  # they import torch, which takes seconds
    from torch import nn

    from rgbt.assembly.session import Session
    from rgbt.assembly.training_setup import TrainingSetup


def announce_training(setup: TrainingSetup, name: str, folder: Path) -> None:
    """Print device, network, images, their sizes, steps, disk and run folder of a training.

    With rare class sampling, also the probability of each class; on CUDA, the memory of a step
    where it was counted. It warns where disk or memory are too small.
    """
    from rgbt.engine.device import compiles_functions

    session, trainer = setup.session, setup.session.trainer
    compiled = ", functions compiled" * compiles_functions(trainer, session.device)
    trained = {key: net for key, net in setup.others.items() if key in setup.optimizers}
    others = "".join(f", {key} {_millions(net)}" for key, net in trained.items())
    counts = [f"{len(names)} {split}" for split, names in session.names.items()]
    lines = [
        ("device", device_line(session) + compiled),
        ("network", f"{network_line(session)}{others}"),
        ("images", f"{session.dataset.name}: {', '.join(counts)}"),
        ("sizes", ", ".join(f"{name} {text}" for name, text in setup.sizes.items())),
        *(("labels", text) for text in setup.absent),
        *([("drawn", setup.rare.shares())] if setup.rare else []),
        ("steps", f"{trainer.max_steps} {_of_steps(setup)}"),
        *_memory_lines(setup),
        *_disk_lines(session.spec, folder),
        ("folder", str(folder)),
    ]
    _write(name, *(f"  {line}" for line in path_lines(lines).plain.splitlines()))


def _memory_lines(setup: TrainingSetup) -> list[tuple[str, str]]:
    """Compare a step with the memory of the GPU; [] on other devices and where it is not known."""
    import torch

    from rgbt.engine.memory import training_advice
    from rgbt.processes import num_processes
    from rgbt.requirements import NetworkRecord, TransformRecord, record_of

    session = setup.session
    share = session.loading.batch_size // num_processes()
    needed = step_gb(session.spec, share) if session.device.type == "cuda" else None
    if needed is None:
        return []
    size = torch.cuda.get_device_properties(session.device).total_memory / GB
    if needed > size - SPARE_GB:
        network = record_of(session.model, NetworkRecord)
        crop_hw = record_of(session.transform, TransformRecord).crop_hw
        advice = training_advice(session.trainer, share, network, crop_hw)
        warn(f"a step of {share} images needs about {needed:.0f} GB of {size:.0f} GB. {advice}")
    return [("memory", f"about {needed:.0f} GB of {size:.0f} GB")]


def _disk_lines(run: RunSpec, folder: Path) -> list[tuple[str, str]]:
    """Compare the checkpoints of a run with the free disk; [] where their size is not known."""
    size, free = checkpoint_bytes(run), free_bytes(folder)
    if size is None:
        return []
    if size > free:
        warn(f"checkpoints need {in_gb(size)}, but {folder} has {in_gb(free)} free.")
    return [("disk", f"{in_gb(size)} of checkpoints, {in_gb(free)} free")]


def announce_upstream(setup: TrainingSetup, name: str, downstream: str, folder: Path) -> None:
    """Print an upstream run, the run that needs it, network, steps and folder in one line."""
    steps = f"{setup.session.trainer.max_steps} steps {_of_steps(setup)}"
    parts = ", ".join([network_line(setup.session), steps, str(folder)])
    _write(f"upstream run {name} for {downstream}: {parts}")


def announce_network(session: Session) -> None:
    """Print device, network and checkpoint of a prediction in one line."""
    from rgbt.exported.onnx_network import ExportedNetwork  # which is never trained

    checkpoint = f"checkpoint of step {session.step}" if session.step else session.label
    network = network_line(session)
    if isinstance(session.model, ExportedNetwork):
        network = f"{session.model.description.network} in onnxruntime"
    _write(f"{device_line(session)}; {network}; {checkpoint}")


def device_line(session: Session) -> str:
    """Write the device with its precision: "cpu, 2 threads, 32-true"; on CUDA also of products."""
    import torch

    from rgbt.processes import num_processes

    device, number = session.device, num_processes()
    gpu = f" ({torch.cuda.get_device_name(device)})" if device.type == "cuda" else ""
    count = torch.get_num_threads()
    threads = f"{count} thread{'s' * (count > 1)}"
    precision: str = session.trainer.precision
    if device.type == "cuda":
        precision += f", matmul_precision={session.trainer.matmul_precision}"
    if number > 1:
        return f"{number} x {device.type}{gpu}, {threads} each, {precision}"
    return f"{device}{gpu}, {threads}, {precision}"


def network_line(session: Session) -> str:
    """Write class and number of parameters: "Mask2Former, 1.23 M parameters", and trained ones."""
    every, trained = _millions(session.model), _millions(session.model, only_trained=True)
    of_which = f", {trained} trained" if trained != every else ""
    return f"{type(session.model).__name__}, {every} parameters{of_which}"


def _of_steps(setup: TrainingSetup) -> str:
    """Write batch, epochs and validation: "of batch 2 (6 epochs), validated every 3"."""
    session, trainer = setup.session, setup.session.trainer
    batch = session.loading.batch_size * trainer.accumulate
    epochs = trainer.max_steps * trainer.accumulate / setup.steps_per_epoch
    validated = f"validated every {trainer.eval_every}"
    if session.selection_split is None:
        validated = f"not validated: {session.dataset.name} has no {trainer.selection_split}"
    return f"of batch {batch} ({epochs:.3g} epochs), {validated}"


def _write(*lines: str) -> None:
    # This is no message (`info`): drivers of sweeps take the last remark for what went wrong.
    sys.stderr.write(without_controls("".join(f"{line}\n" for line in lines)))


def _millions(network: nn.Module, *, only_trained: bool = False) -> str:
    count = 0
    for parameter in network.parameters():
        if parameter.requires_grad or not only_trained:
            count += parameter.numel()
    return f"{count / 1e6:.2f} M"


def show(run: RunSpec, extra_tags: Mapping[str, str] | None = None) -> None:
    """Print the tables of a finished run, and what differs from the run that is requested now.

    Args:
        run: the requested run, which is finished.
        extra_tags: MLflow tags of the request.
    """
    requested = describe(run, extra_tags)
    folder, tracking = RunFolder(run.folder), run.tracking.build()
    folder.clean()
    known = read_description(folder.path)
    assert known is not None, "a finished run has its description"
    info(
        f"{requested.name} is already finished; its result follows. For a new run, choose "
        "another value of seed=..."
    )
    # A point of a grid may be the default of an experiment: the longer name says what it varies.
    is_longer = len(requested.tags.get(GROUP, "")) > len(known.tags.get(GROUP, ""))
    named = requested if is_longer else known
    merged = Description(named.name, {**known.tags, **named.tags}, known.params)
    tracking.refresh(folder, merged)
    warn_of_result(folder.path)
    _report_other_files(run, folder)
    print_result(run, folder, tracking, is_point=bool(extra_tags))


def print_result(
    run: RunSpec, folder: RunFolder, tracking: Tracking, *, is_point: bool = False
) -> None:
    """Print the tables of a finished run, its folder, and the commands that use it.

    A point of a sweep, which nobody watches, gets its folder alone.
    """
    heads = run.domains.heads_in_words(run.domains.tested_head)
    steps = [] if is_point else next_steps(run, folder)
    links = [*([("heads", heads)] if heads else []), *steps, *tracking.links()]
    print_rich(result_view(_tables_of(folder), folder.path, links))


def print_upstream_result(folder: RunFolder, name: str) -> None:
    """Print the scores and the folder of a finished upstream run in one line."""
    tables = _tables_of(folder)
    values = {"mIoU": tables.regions.miou, **subset_mious(tables.classes)}
    found = ", ".join(f"{part} {percent(value)}" for part, value in values.items())
    print_rich(Text(f"upstream run {name}: {found}  {folder.path}"))


def _tables_of(folder: RunFolder) -> ResultTables:
    tables = read_tables(folder.path)
    assert tables is not None, "a finished run has its tables"
    return tables


def _report_other_files(run: RunSpec, folder: RunFolder) -> None:
    """Report a finished run of the same key that was made on another copy of the data set."""
    if "root" not in run.plain["dataset"]:
        return  # drawn from its settings alone, which are in the key
    result = read_result(folder.path)
    try:
        now = run.dataset.build().fingerprint()
    except InputError:
        return  # a result can be shown without its data
    if result is not None and result["dataset"] != now:
        info(
            f"this run was trained on other files of the data set ({result['dataset'][:8]}, now "
            f"{now[:8]}). To train on the present files, set runs_dir=... or dataset.name=..."
        )
