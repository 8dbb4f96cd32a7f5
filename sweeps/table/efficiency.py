"""The columns of efficiency: size, operations, memory and speed of the networks of the rows.

No run is needed: all are those of the networks at scale=paper, which the papers print, whatever
scale the rows are run at. The networks of all rows are measured together, so that their ratios are
fair (`rgbt.evaluation.profile`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from rgbt.checks import InputError, one_line
from rgbt.config.command import composing
from rgbt.config.component import build
from rgbt.config.compose import compose
from sweeps.table.cells import NO_VALUE, CellId, TableCell
from sweeps.table.request import TableRequest
from sweeps.table.table import COUNTED, MEASURED

SCALE = "paper"  # of all networks
IMAGE_HW = (480, 640)  # of MFNet, for rows without settings.image_hw
NOT_NETWORK = ("model.weights=", "tracking", "runs_dir=")  # overrides that begin so

KEYS = {
    **{"gflops": ("flops", 1e9), "peak_memory": ("peak_memory", 2**20)},
    **{"latency": ("latency_ms", 1.0), "images_per_second": ("images_per_second", 1.0)},
}
"""Column -> key of a network in a profile, and its unit there."""

Network = tuple[tuple[str, ...], tuple[int, int]]  # overrides and the size of the images


def efficiency_cells(request: TableRequest) -> dict[CellId, TableCell]:
    """The cells of all columns of efficiency; the reason, where a network cannot be measured."""
    columns = [column for column in request.table.columns if column.efficiency is not None]
    rows = {
        row.label: {each.name: each for each in request.table.columns_of(row) if each in columns}
        for row in request.table.runnable_rows
    }
    rows = {label: each for label, each in rows.items() if each}
    networks = {label: network_of(request, label) for label in rows}
    errors: dict[str, str] = {}
    millions: dict[tuple[str, ...], float] = {}
    for label, (words, _) in networks.items():
        try:
            millions[words] = millions.get(words) or million_parameters(words)
        except InputError as error:
            errors[label] = str(error)
    # Rows of one network share its measurement, which has the label of the first of them.
    firsts: dict[Network, str] = {}
    names = {
        label: firsts.setdefault(each, label)
        for label, each in networks.items()
        if label not in errors
    }
    kinds = {str(column.efficiency) for column in columns} - {"parameters"}
    measured: dict[str, dict[str, Any]] = {}
    device = reason = ""
    if kinds and firsts:
        try:
            device, measured = profiled(firsts, measure=bool(kinds & set(MEASURED)))
        except (InputError, RuntimeError) as error:  # RuntimeError: memory of the device
            reason = one_line(error)

    cells: dict[CellId, TableCell] = {}
    for label, of_row in rows.items():
        for name, column in of_row.items():
            kind = str(column.efficiency)
            own = measured.get(names.get(label, ""), {})
            key, unit = KEYS.get(kind, ("", 1.0))
            if label not in errors and kind == "parameters":
                cells[label, name] = TableCell(millions[networks[label][0]], math.nan, 0)
            elif own.get(key) is None:
                why = errors.get(label) or reason or f"this device does not report the {name}"
                cells[label, name] = TableCell(math.nan, math.nan, 0, why, NO_VALUE)
            elif kind in COUNTED:
                cells[label, name] = TableCell(own[key] / unit, math.nan, 0)
            else:
                # Of speed the median of the ratios of single rounds, which is more exact.
                first = next(iter(measured.values()))
                ratio = own[key] / first[key] if kind == "peak_memory" else own["ratio"]
                ratio = 1 / ratio if kind == "images_per_second" else ratio
                value = own[key] / unit
                cells[label, name] = TableCell(value, math.nan, 0, ratio=ratio, device=device)
    return cells


def exact_sizes(request: TableRequest) -> dict[CellId, TableCell]:
    """Millions of parameters of the cells that claims of the table are about."""
    claimed = {name for claim in request.table.claims for name in claim.columns}
    columns = [each for each in request.table.columns if each.efficiency == "parameters"]
    if not claimed & {column.name for column in columns}:
        return {}
    kept = tuple(column for column in columns if column.name in claimed)
    cells = efficiency_cells(replace(request, table=replace(request.table, columns=kept)))
    return {each: cell for each, cell in cells.items() if not math.isnan(cell.mean)}


def network_of(request: TableRequest, label: str) -> Network:
    """The network of a row at `SCALE`; overrides of every row apply to it too."""
    (row,) = (each for each in request.table.rows if each.label == label)
    words = replace(request, scale=SCALE, pretrained={}).overrides(label, 0)[:-1]
    overrides = tuple(word for word in words if not word.lstrip("+~").startswith(NOT_NETWORK))
    height, width = row.settings.get("image_hw", IMAGE_HW)
    return overrides, (height, width)


def profiled(
    networks: Mapping[Network, str], *, measure: bool
) -> tuple[str, dict[str, dict[str, Any]]]:
    """The device, and what `rgbt profile` counts and measures of networks with these names."""
    from rgbt.evaluation.profile import ProfileSettings, profile
    from rgbt.evaluation.profiled_network import from_overrides

    found = profile(
        [from_overrides(name, words, image_hw) for (words, image_hw), name in networks.items()],
        ProfileSettings(measure=measure),
    )
    device = "{device}, {threads} threads, torch {torch}".format(**found.setup)
    by_name = found.networks.astype(object).where(found.networks.notna(), None)
    return device, by_name.set_index("name").to_dict(orient="index")


def million_parameters(overrides: Sequence[str]) -> float:
    """Millions of parameters of the network that overrides of `python -m rgbt.run` describe.

    It is built on torch's device "meta". Discriminators are not counted. InputError: as refused.
    """
    import torch

    with composing(overrides), torch.device("meta"):
        network = build(compose(overrides).model)
    count: int = sum(parameter.numel() for parameter in network.parameters())
    return count / 1e6
