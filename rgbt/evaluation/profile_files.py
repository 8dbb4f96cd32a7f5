"""The profile of networks as a table of text, as JSON and as CSV."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

from rgbt.checks import InputError
from rgbt.evaluation.prepared_network import PREDICTION
from rgbt.evaluation.profile import NetworkProfile, Profile
from rgbt.files.atomic import write_atomic
from rgbt.tracking.csv_files import csv_text
from rgbt.tracking.tables import ABSENT, TextTable

COUNTED = (
    "FLOPs: a multiplication and its addition are two operations (papers often print half of it). "
    "Not counted, because they have no formula: {names}."
)
ON_CPU = (
    "Peak memory: resident memory of a fresh process that builds the network and predicts twice, "
    "less the memory of Python and its libraries."
)
ON_GPU = "Peak memory: most that PyTorch allocated for weights, batch and one prediction."
IN_ONNX = (
    "ONNX: onnxruntime computes the class scores from the exported graph, in float32 and with the "
    "same number of threads. FLOPs are those of the network in PyTorch; memory is not measured."
)
TIMES = (
    "Latency of a batch of {batch}: median and quartiles; rounds: {rounds}, unmeasured predictions "
    "before them: {warmup}. Each round measures every network once, in random order."
)
RATIO = (
    "Ratio: median over rounds of the latency divided by that of {first} in the same round, with "
    "the 95 % interval of the median."
)
SHOWN = 8
"""Most operations without a formula that the table names."""


def profile_grid(profile: Profile) -> TextTable:
    """One line per network; memory and times only where they were measured."""
    settings = profile.settings
    title = f"Efficiency on {profile.device}, {profile.threads} threads, torch "
    title += profile.torch_version
    header = ["network", "image", "parameters, M", "trainable, M", "GFLOPs"]
    if settings.measure:
        header += ["peak, MiB", "latency, ms", "quartiles, ms", "images/s", "ratio", "interval"]
    rows = []
    for each in profile.networks:
        row = [
            each.network.name,
            "x".join(map(str, each.network.image_hw)),
            f"{each.parameters / 1e6:.2f}",
            f"{each.trainable / 1e6:.2f}",
            f"{each.flops.total / 1e9:.2f}",
        ]
        rows.append(tuple(row + (_measured(profile, each) if settings.measure else [])))
    return TextTable(title, tuple(header), tuple(rows), tuple(_notes(profile)))


def _measured(profile: Profile, each: NetworkProfile) -> list[str]:
    low, middle, high = each.quartiles
    peak = ABSENT if each.peak_memory is None else f"{each.peak_memory / 2**20:.0f}"
    fields = [peak, f"{middle:.1f}", f"{low:.1f} to {high:.1f}"]
    fields.append(f"{profile.images_per_second(each):.2f}")
    assert each.ratio is not None, "it was measured"
    interval = ABSENT
    if not math.isnan(each.ratio.low):
        interval = f"{each.ratio.low:.3f} to {each.ratio.high:.3f}"
    return [*fields, f"{each.ratio.estimate:.3f}", interval]


def _notes(profile: Profile) -> list[str]:
    """Sentences below the table."""
    settings = profile.settings
    sizes: dict[str, int] = {}
    for each in profile.networks:
        for name, number in each.flops.uncounted.items():
            sizes[name] = sizes.get(name, 0) + number
    names = sorted(sizes, key=lambda name: -sizes[name])
    more = f" and {len(names) - SHOWN} others" if len(names) > SHOWN else ""
    notes = [COUNTED.format(names=(", ".join(names[:SHOWN]) or "none") + more)]
    if not settings.measure:
        return notes
    precisions = sorted({each.network.trainer.precision for each in profile.networks})
    if any(each.peak_memory is not None for each in profile.networks):
        notes.append(ON_CPU if profile.kind == "cpu" else ON_GPU)
    if any(each.network.is_onnx for each in profile.networks):
        notes.append(IN_ONNX)
    values = {"batch": settings.batch_size, "rounds": settings.rounds, "warmup": settings.warmup}
    notes += [TIMES.format(**values), RATIO.format(first=profile.networks[0].network.name)]
    return [*notes, PREDICTION, f"Precision: {', '.join(precisions)}."]


def plain_profile(profile: Profile) -> dict[str, Any]:
    """Plain values of the file; None for what was not measured."""
    settings = profile.settings
    return {
        "device": profile.device,
        "kind": profile.kind,
        "threads": profile.threads,
        "torch": profile.torch_version,
        "batch_size": settings.batch_size,
        "rounds": settings.rounds if settings.measure else 0,
        "warmup": settings.warmup if settings.measure else 0,
        "prediction": PREDICTION,
        "networks": [_plain(profile, each) for each in profile.networks],
    }


def _plain(profile: Profile, each: NetworkProfile) -> dict[str, Any]:
    low, middle, high = map(_or_none, each.quartiles)
    ratio = each.ratio
    return {
        "name": each.network.name,
        "overrides": list(each.network.overrides),
        "image_hw": list(each.network.image_hw),
        "precision": each.network.trainer.precision,
        "parameters": each.parameters,
        "trainable": each.trainable,
        "flops": each.flops.total,
        "uncounted": dict(each.flops.uncounted),
        "peak_memory": each.peak_memory,
        "latency_ms": middle,
        "first_quartile_ms": low,
        "third_quartile_ms": high,
        "images_per_second": None if middle is None else profile.images_per_second(each),
        "ratio": None if ratio is None else ratio.estimate,
        "ratio_low": None if ratio is None else _or_none(ratio.low),
        "ratio_high": None if ratio is None else _or_none(ratio.high),
        "milliseconds": [round(each, 4) for each in each.milliseconds],
    }


def _or_none(value: float) -> float | None:
    return None if math.isnan(value) else value


def json_text(profile: Profile) -> str:
    """The content of a JSON file."""
    return json.dumps(plain_profile(profile), indent=1) + "\n"


def csv_of(profile: Profile) -> str:
    """The content of a CSV file: one line per network, device and settings in each."""
    plain = plain_profile(profile)
    networks = plain.pop("networks")
    del plain["prediction"]
    lines = []
    for each in networks:
        del each["milliseconds"]
        each["overrides"] = " ".join(each["overrides"])
        each["image_hw"] = "x".join(map(str, each["image_hw"]))
        each["uncounted"] = " ".join(each["uncounted"])
        lines.append({**each, **plain})
    values = (["" if value is None else value for value in line.values()] for line in lines)
    return csv_text([list(lines[0]), *values])


FORMATS: dict[str, Callable[[Profile], str]] = {".json": json_text, ".csv": csv_of}


def check_out(path: Path) -> None:
    """Refuse a file of another format, before anything is measured.

    Raises:
        InputError: its name does not end in .json or .csv.
    """
    if path.suffix not in FORMATS:
        raise InputError(f"out={path}: expected a file name that ends in .json or .csv.")


def write_profile(profile: Profile, path: Path) -> None:
    """Write a JSON or CSV file, by the end of its name."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomic(path, FORMATS[path.suffix](profile).encode())
