"""The columns of efficiency: size, operations, memory and speed of the networks of the rows.

No run is needed: all are those of the networks at scale=paper, which the papers print, whatever
scale the rows are run at. `rgbt profile` counts and measures the networks of all rows in one run,
so that their ratios are fair; the numbers and the name of the device are kept in a file.
"""

from __future__ import annotations

import json
import math
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from rgbt.checks import InputError
from rgbt.config.command import composing
from rgbt.config.component import build
from rgbt.config.compose import compose
from rgbt.files.atomic import write_atomic
from rgbt.runs.provenance import machine
from rgbt.terminal import info
from sweeps.table.cells import NO_VALUE, CellId, TableCell
from sweeps.table.request import TableRequest
from sweeps.table.table import COUNTED, MEASURED, Column, Row

SCALE = "paper"
"""Scale of all networks."""

IMAGE_HW = (480, 640)
"""Height and width of the images of a row without `settings.image_hw`: those of MFNet."""

FILE = "efficiency.json"
"""In the folder of the table: what was measured, and the answer of `rgbt profile`."""

NOT_NETWORK = ("model.weights=", "tracking", "runs_dir=")
"""Beginnings of overrides that say nothing about a network."""

KEYS = {
    "gflops": ("flops", 1e9),
    "peak_memory": ("peak_memory", 2**20),
    "latency": ("latency_ms", 1.0),
    "images_per_second": ("images_per_second", 1.0),
}
"""Column -> key of a network in the file, and its unit there."""


@dataclass(frozen=True)
class _Networks:
    """The networks of the rows.

    Attributes:
        parameters: network -> its millions of parameters.
        rows: label -> network: overrides and the size of its images.
        errors: label -> why its network cannot be built.
    """

    parameters: dict[tuple[str, ...], float] = field(default_factory=dict)
    rows: dict[str, tuple[tuple[str, ...], tuple[int, int]]] = field(default_factory=dict)
    errors: dict[str, str] = field(default_factory=dict)


def efficiency_cells(request: TableRequest, folder: Path) -> dict[CellId, TableCell]:
    """The cells of all columns of efficiency, of the rows that the project can run.

    Numbers that need `rgbt profile` are read from `FILE` if it has those of the same networks and
    machine; otherwise all are measured again and the file is replaced.

    Args:
        request: the table; overrides of every row apply to the networks too.
        folder: of the files of the table.

    Returns:
        values in the units of `Column.efficiency`; of a network that cannot be built or measured,
        the reason.
    """
    table = request.table
    columns = [column for column in table.columns if column.efficiency is not None]
    rows = [row for row in table.runnable_rows if set(columns) & set(table.columns_of(row))]
    networks = _networks(request, rows)
    cells: dict[CellId, TableCell] = {}
    profiled: Mapping[str, Any] = {}
    reason = ""
    kinds = {column.efficiency for column in columns}
    if networks.rows and kinds - {"parameters"}:
        try:
            profiled = _profile(networks, folder, measure=bool(kinds & set(MEASURED)))
        except InputError as error:
            reason = str(error)
    for row in rows:
        for column in set(columns) & set(table.columns_of(row)):
            cells[row.label, column.name] = _cell(row, column, networks, profiled, reason)
    return cells


def exact_sizes(request: TableRequest) -> dict[CellId, float]:
    """Millions of parameters of the cells that claims of the table are about."""
    named = {name for claim in request.table.claims for name in claim.columns}
    columns = [each for each in request.table.columns if each.efficiency == "parameters"]
    wanted = [column for column in columns if column.name in named]
    networks = _networks(request, request.table.runnable_rows if wanted else [])
    return {
        (label, column.name): networks.parameters[overrides]
        for label, (overrides, _) in networks.rows.items()
        for column in wanted
    }


def _networks(request: TableRequest, rows: Sequence[Row]) -> _Networks:
    """The network of every row, counted once if rows share it."""
    at_paper = replace(request, scale=SCALE, pretrained={})
    found = _Networks()
    for row in rows:
        words = at_paper.overrides(row.label, 0)[:-1]
        overrides = tuple(word for word in words if not word.lstrip("+~").startswith(NOT_NETWORK))
        try:
            if overrides not in found.parameters:
                found.parameters[overrides] = million_parameters(overrides)
        except InputError as error:
            found.errors[row.label] = str(error)
        else:
            height, width = row.settings.get("image_hw", IMAGE_HW)
            found.rows[row.label] = overrides, (height, width)
    return found


def _cell(
    row: Row, column: Column, networks: _Networks, profiled: Mapping[str, Any], reason: str
) -> TableCell:
    """The value of one row, or the reason why there is none."""
    kind = column.efficiency
    if row.label in networks.errors:
        return TableCell(math.nan, math.nan, 0, networks.errors[row.label], NO_VALUE)
    if kind == "parameters":
        return TableCell(networks.parameters[networks.rows[row.label][0]], math.nan, 0)
    if not profiled:
        return TableCell(math.nan, math.nan, 0, reason, NO_VALUE)
    by_name = {each["name"]: each for each in profiled["networks"]}
    names = list(_names(networks).values())
    mine = by_name[_names(networks)[row.label]]
    key, unit = KEYS[str(kind)]
    if mine[key] is None:
        missing = f"this device does not report the {column.name}"
        return TableCell(math.nan, math.nan, 0, missing, NO_VALUE)
    if kind in COUNTED:
        return TableCell(mine[key] / unit, math.nan, 0)
    device = f"{profiled['device']}, {profiled['threads']} threads, torch {profiled['torch']}"
    ratio = _ratio(str(kind), mine, by_name[names[0]])
    return TableCell(mine[key] / unit, math.nan, 0, ratio=ratio, device=device)


def _ratio(kind: str, mine: Mapping[str, Any], first: Mapping[str, Any]) -> float:
    """Memory or speed divided by that of the first row."""
    if kind == "peak_memory":
        return float(mine[kind] / first[kind])
    # The median of the ratios of single rounds, which is more exact than the ratio of medians.
    return float(mine["ratio"] if kind == "latency" else 1 / mine["ratio"])


def _names(networks: _Networks) -> dict[str, str]:
    """Label -> name of its network in the profile: the first label that has the same one."""
    firsts: dict[tuple[tuple[str, ...], tuple[int, int]], str] = {}
    return {label: firsts.setdefault(each, label) for label, each in networks.rows.items()}


def _profile(networks: _Networks, folder: Path, *, measure: bool) -> Mapping[str, Any]:
    """What `rgbt profile` writes about the networks, from `FILE` or measured now."""
    import torch

    here = machine()
    entries = {
        name: {
            "overrides": list(networks.rows[name][0]),
            "image_hw": list(networks.rows[name][1]),
        }
        for name in dict.fromkeys(_names(networks).values())
    }
    wanted = {
        "networks": entries,
        "measure": measure,
        "machine": [here["host"], here["cpu"], *here["gpus"]],
        "torch": torch.__version__,
    }
    path = folder / FILE
    stored = _stored(path)
    if stored.get("wanted") == wanted:
        if measure:
            info(f"memory and speed are those in {path}; remove the file to measure them again.")
        return dict(stored["profile"])
    profiled = _run_profile(entries, measure=measure)
    folder.mkdir(parents=True, exist_ok=True)
    content = json.dumps({"wanted": wanted, "profile": profiled}, indent=1)
    write_atomic(path, f"{content}\n".encode())
    return profiled


def _stored(path: Path) -> dict[str, Any]:
    """The content of the file; {} where it is missing or no JSON, so that it is made again."""
    try:
        plain = json.loads(path.read_text())
    except (OSError, ValueError):
        return {}
    return plain if isinstance(plain, dict) else {}


def _run_profile(entries: Mapping[str, Any], *, measure: bool) -> dict[str, Any]:
    """Call `rgbt profile`, whose progress is shown.

    Raises:
        InputError: it failed; its message.
    """
    with tempfile.TemporaryDirectory() as temporary:
        file, out = Path(temporary) / "networks.yaml", Path(temporary) / "profile.json"
        file.write_text(json.dumps(entries))
        words = [f"networks={file}", f"out={out}", f"measure={str(measure).lower()}"]
        done = subprocess.run(
            [sys.executable, "-m", "rgbt.profile", *words],
            stdout=subprocess.DEVNULL,
            stderr=None if sys.stderr.isatty() else subprocess.PIPE,
            text=True,
            check=False,
        )
        if done.returncode:
            lines = [line for line in (done.stderr or "").splitlines() if line.strip()]
            why = lines[-1].removeprefix("rgbt: ") if lines else "its message is above"
            raise InputError(f"rgbt profile failed: {why}")
        profiled: dict[str, Any] = json.loads(out.read_text())
    return profiled


def million_parameters(overrides: Sequence[str]) -> float:
    """Millions of parameters of the network that overrides of `python -m rgbt.run` describe.

    Only the node `model` is built, on torch's device "meta": no data set is read, its `root` may be
    missing, and no memory is used. Discriminators belong to the scheme and are not counted; frozen
    parameters are.

    Raises:
        InputError: overrides that Hydra or the network's constructor refuses.
    """
    import torch

    with composing(overrides), torch.device("meta"):
        network = build(compose(overrides).model)
    count: int = sum(parameter.numel() for parameter in network.parameters())
    return count / 1e6
