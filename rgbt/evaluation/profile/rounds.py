"""Measure networks side by side: parameters, operations, peak memory and time of a prediction.

The networks alternate: each round measures every network once, in an order that is drawn for the
round. Other load on the machine so affects all of them, and the ratio of two times of one round is
more exact than the times themselves.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
from torch.nn.attention import SDPBackend, sdpa_kernel
from torch.utils.flop_counter import FlopCounterMode

from rgbt.checks import InputError
from rgbt.evaluation.profile.networks import PreparedNetwork, ProfiledNetwork, check_networks
from rgbt.files.atomic import write_atomic
from rgbt.randomness import numpy_generator
from rgbt.runs.provenance import machine
from rgbt.tables import ABSENT, TextTable, csv_text
from rgbt.terminal import progress

FLOPS = (
    "FLOPs: of convolutions and matrix products; a multiplication and its addition are two "
    "operations (papers often print half of it)."
)
MEASURED = (
    "Latency of a batch of {batch_size}: median of {rounds} rounds, after {warmup} unmeasured "
    "predictions. Each round measures every network once, in random order.",
    "Ratio: median over rounds of the latency divided by that of {first} in the same round.",
    "A prediction is normalisation, forward pass, resizing of the class scores to the image, and "
    "argmax. Reading of files and transfer to the device are not part of it.",
    "Peak memory: most that PyTorch allocated on a GPU for weights, batch and one prediction.",
)

# Header of the printed table -> column of the result of `profile`, unit, decimals.
COLUMNS = {
    "parameters, M": ("parameters", 1e6, 2),
    "trainable, M": ("trainable", 1e6, 2),
    "GFLOPs": ("flops", 1e9, 2),
    "peak, MiB": ("peak_memory", 2**20, 0),
    "latency, ms": ("latency_ms", 1, 1),
    "images/s": ("images_per_second", 1, 2),
    "ratio": ("ratio", 1, 3),
}


def profile_grid(networks: pd.DataFrame, setup: Mapping[str, Any]) -> TextTable:
    """Make the table of a profile: a line per network, memory and times where they are known."""
    names, found = networks["name"], {"image": list(networks["image_hw"])}
    for header, (key, unit, digits) in COLUMNS.items():
        values = networks[key].astype(float) / unit
        if values.notna().any():
            found[header] = [f"{v:.{digits}f}" if v == v else ABSENT for v in values]
    notes = [FLOPS]
    if setup["measure"]:
        notes += [note.format(first=names[0], **setup) for note in MEASURED]
        notes.append(f"Precision: {', '.join(sorted(set(networks['precision'])))}.")
    title = "Efficiency on {device}, {threads} threads, torch {torch}".format(**setup)
    rows = tuple(zip(names, *found.values(), strict=True))
    return TextTable(title, ("network", *found), rows, tuple(notes))


def write_profile(networks: pd.DataFrame, setup: Mapping[str, Any], path: Path) -> None:
    """Write a JSON file with all numbers, or a CSV file with one line per network."""
    if path.suffix == ".json":
        rows = json.loads(networks.to_json(orient="records", double_precision=15))
        text = json.dumps({**setup, "networks": rows}, indent=1) + "\n"
    else:
        flat = networks.drop(columns="milliseconds").assign(**setup).astype(object)
        lines = flat.where(flat.notna(), "").itertuples(index=False, name=None)
        text = csv_text([tuple(flat.columns), *lines])
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomic(path, text.encode())


def check_out(path: Path) -> None:
    """Refuse a file of another format, before anything is measured."""
    if path.suffix not in (".json", ".csv"):
        raise InputError(f"out={path}: expected a file name that ends in .json or .csv.")


def profile(
    networks: Sequence[ProfiledNetwork], *, batch_size: int = 1, rounds: int = 20, warmup: int = 3
) -> tuple[pd.DataFrame, dict[str, Any]]:
    """Measure networks in one run, with a progress bar; all are on the device together.

    Args:
        networks: what is measured; ratios are to the first.
        batch_size: images of a prediction.
        rounds: measured predictions of each network; 0: count parameters and operations only.
        warmup: predictions before them that are not measured.

    Returns:
        a row per network, None where nothing was measured (FLOPs and milliseconds, of every round,
        are of one batch, peak_memory is in bytes), and the setup: kind of the device ("cpu",
        "cuda" or "mps"), its model, threads, version and precision of PyTorch, settings.

    Raises:
        InputError: names or devices that do not fit, or images that a network cannot predict.
    """
    check_networks(networks)
    rows: list[dict[str, Any]] = []
    prepared: list[PreparedNetwork] = []
    with progress() as display:
        task = display.add_task("preparing", total=len(networks), note="")
        for network in networks:
            display.update(task, note=network.name)
            prepared.append(PreparedNetwork(network, batch_size))
            rows.append(_prepare(prepared[-1], warmup, measures=rounds > 0))
            display.advance(task)
        display.update(task, description="measuring", total=rounds, completed=0, note="rounds")
        for number in range(rounds):
            # Drawn, so that no network always follows the same other one.
            for index in numpy_generator(0, "profile", number).permutation(len(networks)):
                start = time.perf_counter()
                prepared[index].predict()
                rows[index]["milliseconds"].append(1000 * (time.perf_counter() - start))
            display.advance(task)
    for row in rows if rounds else ():
        times = row["milliseconds"]
        row["latency_ms"] = float(np.median(times))
        row["images_per_second"] = 1000 * batch_size / row["latency_ms"]
        row["ratio"] = float(np.median(np.divide(times, rows[0]["milliseconds"])))
    device = prepared[0].device
    on_gpu = device.type == "cuda"
    setup = {
        "device": torch.cuda.get_device_name(device) if on_gpu else str(machine()["cpu"]),
        "kind": device.type,
        "threads": torch.get_num_threads(),
        "torch": torch.__version__,
        "matmul_precision": torch.get_float32_matmul_precision(),
        "batch_size": batch_size,
        "rounds": rounds,
        "warmup": warmup,
        "measure": rounds > 0,
    }
    return pd.DataFrame(rows), setup


def _prepare(prepared: PreparedNetwork, warmup: int, *, measures: bool) -> dict[str, Any]:
    """Count and measure what needs no rounds, and warm the network up."""
    network = prepared.network
    flops = count_flops(prepared.predict)
    if network.is_onnx:
        prepared.use_onnx()
    peak = prepared.peak_memory() if measures and not network.is_onnx else None
    for _ in range(warmup if measures else 0):
        prepared.predict()
    return {
        "name": network.name,
        "overrides": " ".join(network.overrides),
        "image_hw": "x".join(map(str, network.image_hw)),
        "precision": network.trainer.precision,
        **dict.fromkeys(key for key, _, _ in COLUMNS.values()),  # None: not measured
        "parameters": prepared.parameters,
        "trainable": prepared.trainable,
        "flops": flops,
        "peak_memory": peak,
        "milliseconds": [],
    }


def count_flops(call: Callable[[], object]) -> int:
    """Operations of convolutions and matrix products of one call, by `torch.utils.flop_counter`.

    Attention is computed as matrix products and a softmax, because the fused operation of some
    devices has no formula. So every device gives the same count.
    """
    with sdpa_kernel(SDPBackend.MATH), FlopCounterMode(display=False) as counter:
        call()
    return int(counter.get_total_flops())
