"""Measure networks side by side: parameters, operations, peak memory and time of a prediction.

The networks alternate: each round measures every network once, in an order that is drawn for the
round. Other load on the machine so affects all of them, and the ratio of two times of one round is
more exact than the times themselves.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
from torch.nn.attention import SDPBackend, sdpa_kernel
from torch.utils.flop_counter import FlopCounterMode

from rgbt.checks import InputError
from rgbt.engine.progress import progress
from rgbt.evaluation.profiled_network import PreparedNetwork, ProfiledNetwork, check_networks
from rgbt.files.atomic import write_atomic
from rgbt.randomness import numpy_generator
from rgbt.runs.provenance import machine
from rgbt.tables import ABSENT, TextTable, csv_text

# Confidence of the interval of a ratio.
CONFIDENCE = 0.95

FLOPS = (
    "FLOPs: of convolutions and matrix products; a multiplication and its addition are two "
    "operations (papers often print half of it)."
)
MEASURED = (
    "Latency of a batch of {batch_size}: median and quartiles of {rounds} rounds, after {warmup} "
    "unmeasured predictions. Each round measures every network once, in random order.",
    "Ratio: median over rounds of the latency divided by that of {first} in the same round, with "
    "the 95 % interval of the median.",
    "A prediction is normalisation, forward pass, resizing of the class scores to the image, and "
    "argmax. Reading of files and transfer to the device are not part of it.",
    "Peak memory: most that PyTorch allocated on a GPU for weights, batch and one prediction.",
)


@dataclass(frozen=True)
class ProfileSettings:
    """How networks are measured."""

    batch_size: int = 1  # images of a prediction
    rounds: int = 20  # measured predictions of each network
    warmup: int = 3  # predictions before them that are not measured
    measure: bool = True  # False: parameters and operations only


# Header of the printed table -> column of `Profile.networks`, unit, decimals.
COLUMNS = {
    "parameters, M": ("parameters", 1e6, 2),
    "trainable, M": ("trainable", 1e6, 2),
    "GFLOPs": ("flops", 1e9, 2),
    "peak, MiB": ("peak_memory", 2**20, 0),
    "latency, ms": ("latency_ms", 1, 1),
    "quartile": ("first_quartile_ms", 1, 1),
    "to": ("third_quartile_ms", 1, 1),
    "images/s": ("images_per_second", 1, 2),
    "ratio": ("ratio", 1, 3),
    "from": ("ratio_low", 1, 3),
    "up to": ("ratio_high", 1, 3),
}


@dataclass(frozen=True)
class Profile:
    """Networks that were measured in one run.

    Attributes:
        setup: kind of the device ("cpu", "cuda" or "mps"), its model, threads, version of PyTorch,
            settings.
        networks: a row per network, in the order of the request; None where nothing was measured.
            FLOPs and milliseconds (of every round) are of one batch, peak_memory is in bytes; ratio
            is that to the first network, ratio_low and ratio_high the ends of its interval.
    """

    setup: dict[str, Any]
    networks: pd.DataFrame

    def grid(self) -> TextTable:
        """One line per network; memory and times only where they were measured."""
        names, found = self.networks["name"], {"image": list(self.networks["image_hw"])}
        for header, (key, unit, digits) in COLUMNS.items():
            values = self.networks[key].astype(float) / unit
            if values.notna().any():
                found[header] = [f"{v:.{digits}f}" if v == v else ABSENT for v in values]
        notes = [FLOPS]
        if self.setup["measure"]:
            notes += [each.format(first=names[0], **self.setup) for each in MEASURED]
            notes.append(f"Precision: {', '.join(sorted(set(self.networks['precision'])))}.")
        title = "Efficiency on {device}, {threads} threads, torch {torch}".format(**self.setup)
        rows = tuple(zip(names, *found.values(), strict=True))
        return TextTable(title, ("network", *found), rows, tuple(notes))

    def write(self, path: Path) -> None:
        """Write a JSON file with all numbers, or a CSV file with one line per network."""
        if path.suffix == ".json":
            networks = json.loads(self.networks.to_json(orient="records", double_precision=15))
            text = json.dumps({**self.setup, "networks": networks}, indent=1) + "\n"
        else:
            flat = self.networks.drop(columns="milliseconds").assign(**self.setup).astype(object)
            rows = flat.where(flat.notna(), "").itertuples(index=False, name=None)
            text = csv_text([tuple(flat.columns), *rows])
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomic(path, text.encode())


def check_out(path: Path) -> None:
    """Refuse a file of another format, before anything is measured."""
    if path.suffix not in (".json", ".csv"):
        raise InputError(f"out={path}: expected a file name that ends in .json or .csv.")


def profile(networks: Sequence[ProfiledNetwork], settings: ProfileSettings) -> Profile:
    """Measure networks in one run, with a progress bar; all are on the device together.

    Raises InputError for names or devices that do not fit, or images that a network cannot predict.
    """
    check_networks(networks)
    rounds = settings.rounds if settings.measure else 0
    rows: list[dict[str, Any]] = []
    prepared: list[PreparedNetwork] = []
    with progress() as display:
        task = display.add_task("preparing", total=len(networks), note="")
        for network in networks:
            display.update(task, note=network.name)
            prepared.append(PreparedNetwork(network, settings.batch_size))
            rows.append(_prepare(prepared[-1], settings))
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
        low, middle, high = np.percentile(times, [25, 50, 75])
        row |= {"latency_ms": middle, "first_quartile_ms": low, "third_quartile_ms": high}
        row["images_per_second"] = 1000 * settings.batch_size / middle
        ratio = ratio_of(times, rows[0]["milliseconds"])
        row |= zip(("ratio", "ratio_low", "ratio_high"), ratio, strict=True)
    device = prepared[0].device
    on_gpu = device.type == "cuda"
    setup = {
        "device": torch.cuda.get_device_name(device) if on_gpu else str(machine()["cpu"]),
        "kind": device.type,
        "threads": torch.get_num_threads(),
        "torch": torch.__version__,
        **asdict(settings),
    }
    return Profile(setup, pd.DataFrame(rows))


def _prepare(prepared: PreparedNetwork, settings: ProfileSettings) -> dict[str, Any]:
    """Count and measure what needs no rounds, and warm the network up."""
    network = prepared.network
    flops = count_flops(prepared.predict)
    if network.is_onnx:
        prepared.use_onnx()
    peak = prepared.peak_memory() if settings.measure and not network.is_onnx else None
    for _ in range(settings.warmup if settings.measure else 0):
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


def ratio_of(times: Sequence[float], first: Sequence[float]) -> tuple[float, float, float]:
    """Median of the ratios of each round, and the ends of its interval; NaN below six rounds.

    The interval has no assumption about the distribution: its ends are two of the sorted ratios
    (Conover, Practical Nonparametric Statistics, 3rd ed., Sec. 3.2). It holds the true median in at
    least 95 % of repetitions if rounds are independent.
    """
    from scipy.stats import binom

    ratios = np.sort(np.divide(times, first))
    # Largest rank for which at most 2.5 % is the probability that more ratios are below the median.
    rank = int(binom.ppf((1 - CONFIDENCE) / 2, len(ratios), 0.5)) - 1
    middle = float(np.median(ratios))
    if rank < 0:
        return middle, math.nan, math.nan
    return middle, float(ratios[rank]), float(ratios[-1 - rank])
