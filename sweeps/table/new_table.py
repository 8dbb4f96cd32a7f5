"""Writes an ablation as a table file: ``rgbt reproduce new table=my/ablation ...``."""

from __future__ import annotations

import itertools
import math
import re
import sys
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from rgbt.checks import InputError
from rgbt.config.command import composing
from rgbt.config.compose import PIXELS
from rgbt.config.options import Help
from rgbt.files.atomic import write_atomic
from sweeps.table.load_table import OWN as FOLDER
from sweeps.table.load_table import PUBLISHED, load_table
from sweeps.worker.planner import specify_run

RINGS = 5
END = "\n..."
"""PyYAML's mark behind a single value."""

LOG_FROM = 8.0
"""Ratio of the largest to the smallest value from which the axis of the figure is logarithmic."""

HEAD = """\
# {title}
# Run:     rgbt reproduce table={name} seeds=3 workers=2
# Preview: rgbt reproduce table={name} seeds=3 dry_run=true
# A row is the command `rgbt run +experiment=<experiment> <overrides>`. You can add, change and
# remove rows: finished runs are reused, only missing runs are started.
"""

COLUMNS = """\
# Further columns:
#   metric: mAcc, mPrecision, mF1, pixel_accuracy, class/person, class/person/acc,
#     class/person/region/1, day/mIoU, night/mIoU
#   modality: thermal            predict without RGB
#   head: source                 predict with one head of a network with two
#   corruption: noise, severity: 16    corrupted images (docs/how-to/measure-robustness.md)
#   {name: both, mean: [day, night]}, {name: gain, minus: [day, night]}    from other columns
#   {name: TC, metric: TC, frames: aligned}, also CA    docs/how-to/measure-consistency.md
#   {name: size, efficiency: parameters}    also gflops, peak_memory, latency, images_per_second
columns:
"""

ROWS = """\
# Further keys of a row: values: {mIoU: 61.79} (published values, shown beside ours),
# remarks: [a footnote], settings: {key: value}, at: {paper: [model=mask2former_swin_s]},
# without: [a column that the row's network has no score for]
rows:
"""


@dataclass(frozen=True)
class VariedOverride:
    """An override with one value, or several to vary: its key and values as text."""

    key: str
    values: tuple[str, ...]

    @property
    def numbers(self) -> tuple[float, ...] | None:
        """The values, where it is varied and all are numbers."""
        try:
            numbers = tuple(float(value) for value in self.values)
        except ValueError:
            return None
        return numbers if len(numbers) > 1 and all(map(math.isfinite, numbers)) else None


@dataclass(frozen=True)
class NewOptions:
    """Options of ``rgbt reproduce new``."""

    table: Annotated[str, Help("name of the new table: my/ablation for tables/my/ablation.yaml")]
    experiment: Annotated[str, Help("experiment of all rows: a file of conf/experiment")]


def new(options: NewOptions, overrides: list[str]) -> int:
    """Write your own table, which `rgbt reproduce table=my/ablation` runs.

    Overrides with comma lists are the varied keys: masker.sigma_div=1,2,4 masker.patch_size=32,64
    """
    path = write_new(options.table, options.experiment, overrides)
    rows = len(load_table(options.table).rows)
    sys.stdout.write(
        f"{path} has {rows} rows; run them with\n"
        f"rgbt reproduce table={options.table} seeds=3 workers=2\n"
    )
    return 0


def write_new(name: str, experiment: str, overrides: Sequence[str], folder: Path = FOLDER) -> Path:
    """Write the file of a new table; every row is composed and checked before.

    Args:
        name: e.g. "my/ablation".
        experiment: a file of ``conf/experiment``.
        overrides: of `python -m rgbt.run`; comma lists are varied, all with all.
        folder: of the user's tables.

    Raises:
        InputError: the file exists already, nothing is varied, or a row does not fit.
    """
    path = folder / f"{name}.yaml"
    if path.exists():
        raise InputError(f"{path} already exists; edit it, or choose another name.")
    if (PUBLISHED / f"{name}.yaml").exists():
        raise InputError(f"table={name} is a published table; choose another name.")
    if name.endswith((".yaml", ".yml")) or Path(name).is_absolute() or ".." in Path(name).parts:
        raise InputError(f"table={name}: expected a name such as my/ablation, without extension.")
    factors = [_factor(override) for override in overrides]
    for factor in factors:
        if factor.key == "seed":
            raise InputError("seed=...: choose the seeds when you run the table: seeds=3.")
        if factor.key == "runs_dir":
            raise InputError("runs_dir=...: choose the folder of runs when you run the table.")
    if not any(len(factor.values) > 1 for factor in factors):
        raise InputError("no key is varied; give a comma list, such as masker.sigma_div=1,2,4.")
    points = list(itertools.product(*(factor.values for factor in factors)))
    for point in points:
        chosen = [f"{f.key}={value}" for f, value in zip(factors, point, strict=True)]
        every = [f"+experiment={experiment}", *chosen]
        specify_run(every)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomic(path, _text(name, experiment, factors, points).encode())
    return path


def _factor(override: str) -> VariedOverride:
    from hydra.core.override_parser.overrides_parser import OverridesParser

    with composing([override]):
        parsed = OverridesParser.create().parse_override(override)
        key, _, value = override.partition("=")
        is_varied = parsed.is_sweep_override()
        return VariedOverride(key, tuple(parsed.sweep_string_iterator()) if is_varied else (value,))


def _text(
    name: str, experiment: str, factors: Sequence[VariedOverride], points: Sequence[Sequence[str]]
) -> str:
    """The file."""
    varied = [factor for factor in factors if len(factor.values) > 1]
    folder, _, last = name.rpartition("/")
    title = f"{experiment} with " + " and ".join(_short(f.key, varied) for f in varied) + " varied"
    parts = [
        HEAD.format(title=f"Own table: {title}.", name=name),
        *_lines(paper=folder or "own", number=last, caption=f"{title}."),
        *_lines(data="the data set of each row", unit="percent"),
        COLUMNS,
        *(f"  - {{name: IoU{n}, metric: region/{n}}}\n" for n in range(1, RINGS + 1)),
        "  - {name: mIoU, metric: mIoU}\n",
        "  - {name: Var, metric: Var, best: lowest}\n",
    ]
    axis = varied[0] if len(varied) == 1 and varied[0].numbers is not None else None
    if axis is not None and axis.numbers is not None:
        low, high = min(axis.numbers), max(axis.numbers)
        scale = "log" if low > 0 and high / low >= LOG_FROM else "linear"
        parts += _lines(factor={"name": _short(axis.key, varied), "axis": scale})
    rows = (_row(experiment, factors, point, axis) for point in points)
    return "".join([*parts, ROWS, *rows])


def _row(
    experiment: str,
    factors: Sequence[VariedOverride],
    point: Sequence[str],
    axis: VariedOverride | None,
) -> str:
    varied = [factor for factor in factors if len(factor.values) > 1]
    pairs = list(zip(factors, point, strict=True))
    words = [f"{_short(factor.key, varied)}={value}" for factor, value in pairs if factor in varied]
    # Hydra escapes ${px:64} inside a list; which value it has depends on the scale.
    label = PIXELS.sub(r"\1px", re.sub(r"\\(.)", r"\1", " ".join(words))).replace("'", "")
    overrides = [f"{factor.key}={value}" for factor, value in pairs]
    lines = _lines(label=label, experiment=experiment, overrides=overrides)
    if axis is not None:
        lines += _lines(x=float(point[list(factors).index(axis)]))
    return "  - " + textwrap.indent("".join(lines), "    ").lstrip()


def _short(key: str, varied: Sequence[VariedOverride]) -> str:
    """The last part of a key where that is unique."""
    last = key.lstrip("+").rpartition(".")[2]
    ends = [factor.key.lstrip("+").rpartition(".")[2] for factor in varied]
    return last if ends.count(last) == 1 else key.lstrip("+")


def _lines(**entries: Any) -> list[str]:
    """``key: value`` lines of YAML, each value in one line."""
    import yaml

    texts = {
        key: yaml.safe_dump(value, sort_keys=False, default_flow_style=True, width=10_000)
        for key, value in entries.items()
    }
    return [f"{key}: {text.partition(END)[0].rstrip()}\n" for key, text in texts.items()]
