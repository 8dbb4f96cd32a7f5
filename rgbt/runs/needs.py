"""What a run needs before it starts: files, room on the disk, memory of the device.

Nothing is read or written but configuration files. Networks are built on torch's device "meta",
which takes no memory, once for runs that differ in numbers alone.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from rgbt.config.stored_config import EXTERNAL
from rgbt.files.yaml_files import read_yaml
from rgbt.runs.run_spec import RunSpec
from rgbt.runs.source_code import checkout_code
from rgbt.runs.starts import sizes_of, starts_of

if TYPE_CHECKING:  # it takes seconds
    import torch
    from torch import nn

GB = 1e9
GIB = 2.0**30
SPARE_GB = 2.0  # of a GPU: for CUDA itself and fragments
MEMORY: list[dict[str, Any]] = read_yaml(Path(__file__).with_name("memory.yaml"))

# What a run lacks: "data", "checkout", "weights" -> in words.
Lacking = dict[str, str]
STOPPING = ("data", "checkout")  # of these, what a run cannot start without

_sizes: dict[str, int] = {}  # bytes of checkpoints by the digest of what decides them


def lacking(run: RunSpec) -> Lacking:
    """Return what `run` and the unfinished runs upstream of it lack, in the order of this file.

    "data" and "checkout" stop it. Without "weights" it starts from random values, and not as
    published. The run may be unchecked, with settings that have no value yet ("???").
    """
    found: dict[str, dict[str, None]] = {"data": {}, "checkout": {}, "weights": {}}
    for spec in _with_upstream(run):
        model, dataset = spec.plain["model"], spec.plain["dataset"]
        root = dataset.get("root")
        if root == "???":
            found["data"][f"dataset.root=FOLDER of {dataset.get('name')}"] = None
        elif root is not None and not Path(root).expanduser().is_dir():
            found["data"][f"dataset.root={root}, which is no folder"] = None
        if model.get("_target_") == EXTERNAL and not checkout_code(model):
            what = f"module of {model.get('constructor')}"
            given = model.get("checkout")
            where = "FOLDER of the author's code" if given == "???" else f"{given}"
            found["checkout"][f"model.checkout={where} ({what})"] = None
        if files := missing_files(spec):
            found["weights"][" or ".join(files)] = None
    return {kind: "; ".join(words) for kind, words in found.items() if words}


def missing_files(run: RunSpec) -> list[str]:
    """Return the published files, one of which the recipe of a run starts from and it does not."""
    if not run.plain["scale"]["pretrained"] or run.weights is not None:
        return []
    return [f"{start.file} ({start.origin})" for start in starts_of(run.name, run.plain["model"])]


def _with_upstream(run: RunSpec) -> tuple[RunSpec, ...]:
    """Return the runs upstream of this one, each after those it depends on; then this."""
    order: dict[int, RunSpec] = {}
    for spec in run.upstream:
        order |= {id(found): found for found in _with_upstream(spec)}
    return (*order.values(), run)


def checkpoint_bytes(run: RunSpec) -> int | None:
    """Return the bytes of ``last.pt`` and ``best.pt`` of a run; InputError: a setting is wrong.

    None for a network of another author, whose code only a run executes.
    """
    plain = run.plain
    if plain["model"].get("_target_") == EXTERNAL:
        return None
    model = {key: value for key, value in plain["model"].items() if key not in ("weights", "fresh")}
    scheme = {key: value for key, value in plain["scheme"].items() if isinstance(value, Mapping)}
    averaging = plain["trainer"]["averaging"]
    parts = (model, scheme, plain["scheme"]["_target_"], plain["optimizer"]["_target_"], averaging)
    digest = json.dumps(parts, sort_keys=True)
    if digest not in _sizes:
        _sizes[digest] = _checkpoint_bytes(run, averaging != "none")
    return _sizes[digest]


def _checkpoint_bytes(run: RunSpec, is_averaged: bool) -> int:
    import torch

    from rgbt.requirements import SchemeRecord, record_of

    run.use(("model", "loss", "masker", "scheme", "optimizer", "domains"))
    with torch.device("meta"):
        network = run.model.build()
    # No checkpoint holds class weights, so that no label is read to compute them.
    ones = np.ones((1, 255), np.int64)
    built = run.build("masker", "loss", "optimizer", class_pixels=lambda: ones)
    # A feature distance has no parameters, but wants the classes of a data set that may be missing.
    values = {key: value for key, value in run.scheme.values.items() if key != "feature_distance"}
    parts = {"model": network, "loss": built["loss"], "masker": built["masker"]}
    scheme = replace(run.scheme, values=values).build(**parts, domains=run.domains, dataset=None)
    record, builder = record_of(scheme, SchemeRecord), built["optimizer"]
    optimizers = [builder(network, without=without) for without in record.optimizers.values()]
    optimizers += [build(record.networks[name]) for name, build in record.builders.items()]
    weights = _tensor_bytes([network])
    others = _tensor_bytes(record.networks.values())
    state = sum(map(_state_bytes, optimizers))
    return weights * (3 if is_averaged else 2) + others + state  # best.pt has the evaluated ones


def _tensor_bytes(networks: Iterable[nn.Module]) -> int:
    tensors = [tensor for network in networks for tensor in network.state_dict().values()]
    return sum(tensor.nbytes for tensor in tensors)


def _state_bytes(optimizer: torch.optim.Optimizer) -> int:
    """Return the bytes of the moments that an optimizer keeps; a step would import for seconds."""
    import torch

    total = 0
    for group in optimizer.param_groups:
        if isinstance(optimizer, torch.optim.Adam | torch.optim.AdamW):
            moments = 2
        elif isinstance(optimizer, torch.optim.SGD):
            moments = int(group["momentum"] > 0)
        else:  # RMSprop; of what a user chose, at least one
            moments = 1 + int(group.get("momentum", 0) > 0) + int(group.get("centered", False))
        total += moments * sum(parameter.nbytes for parameter in group["params"])
    return total


def free_bytes(folder: Path) -> int:
    """Return the free bytes of the disk of a folder, which need not exist."""
    known = folder.absolute()
    while not known.exists():
        known = known.parent
    return shutil.disk_usage(known).free


def in_gb(number: float) -> str:
    """Write bytes as "1.9 GB", and less than 0.1 GB as "50 MB"."""
    return f"{number / GB:.1f} GB" if number >= GB / 10 else f"{number / 1e6:.0f} MB"


def step_gb(run: RunSpec, batch_size: int) -> float | None:
    """Return GB that a training step of `batch_size` images needs on CUDA; None: not counted.

    Counted were `MEMORY`: networks with the training step, and activations grow with the pixels.
    """
    from rgbt.geometry.padding import padded_hw

    model, crop_hw = run.plain["model"], run.plain["scale"]["crop_hw"]
    scheme = run.plain["scheme"]["_target_"].rpartition(".")[2]
    for row in MEMORY if crop_hw is not None else ():
        is_same = all(model.get(key) == size for key, size in sizes_of(row["model"]).items())
        if row["scheme"] != scheme or not is_same:
            continue
        first, further = row["first"], row["further"]
        if run.plain["trainer"]["activation_checkpointing"]:
            first, further = row["recomputed"]
        rows, columns = padded_hw(tuple(crop_hw))
        pixels = rows * columns / (row["crop"][0] * row["crop"][1])
        images = first - row["state"] + further * (batch_size - 1)
        return float((row["state"] + images * pixels) * GIB / GB)
    return None
