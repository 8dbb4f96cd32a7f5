"""Writes an ablation as a table file: ``rgbt reproduce new table=my/ablation ...``."""

from __future__ import annotations

import re
import sys
from dataclasses import dataclass
from typing import Annotated

from rgbt.checks import InputError
from rgbt.config.options import Help

HEAD = """\
# Run:     rgbt reproduce table={name} seeds=3 workers=2
# Preview: rgbt reproduce table={name} seeds=3 dry_run=true
# A row is the command `rgbt run +experiment=<experiment> <overrides>`. You can add, change and
# remove rows: finished runs are reused, only missing runs are started.
# Further keys of columns and rows: docs/how-to/add-a-table.md
"""


@dataclass(frozen=True)
class NewOptions:
    """Options of ``rgbt reproduce new``."""

    table: Annotated[str, Help("name of the new table: my/ablation for tables/my/ablation.yaml")]
    experiment: Annotated[str, Help("experiment of all rows: a file of conf/experiment")]


def new(options: NewOptions, overrides: list[str]) -> int:
    """Write your own table, which `rgbt reproduce table=my/ablation` runs.

    Overrides with comma lists are the varied keys: masker.sigma_div=1,2,4 masker.patch_size=32,64
    """
    import yaml

    from rgbt.config.compose import PIXELS
    from rgbt.config.overrides import composing
    from rgbt.files.atomic import write_atomic
    from sweeps.plan.planner import specify_run
    from sweeps.plan.table import OWN, PUBLISHED
    from sweeps.point import short_names
    from sweeps.space import grid_points, split

    name, experiment = options.table, options.experiment
    path = OWN / f"{name}.yaml"
    if path.exists() or (PUBLISHED / f"{name}.yaml").exists():
        raise InputError(f"table={name} already exists; edit it, or choose another name.")
    if not path.resolve().is_relative_to(OWN.resolve()):
        raise InputError(f"table={name}: expected a name such as my/ablation, without extension.")
    with composing(overrides):
        fixed, varied, _ = split(overrides)
    if wrong := {"seed", "runs_dir"} & {word.partition("=")[0] for word in overrides}:
        raise InputError(f"{min(wrong)}=...: choose it when you run the table.")
    if not varied:
        raise InputError("no key is varied; give a comma list, such as masker.sigma_div=1,2,4.")
    short = {key: end.lstrip("+") for key, end in short_names(varied).items()}
    rows = []
    for point in grid_points(fixed, varied):
        specify_run([f"+experiment={experiment}", *point.overrides])
        words = [word.partition("=") for word in point.overrides]
        text = " ".join(f"{short[key]}={value}" for key, _, value in words if key in short)
        # Hydra escapes ${px:64} inside a list; which value it has depends on the scale.
        label = PIXELS.sub(r"\1px", re.sub(r"\\(.)", r"\1", text)).replace("'", "")
        rows.append({"label": label, "experiment": experiment, "overrides": list(point.overrides)})
    paper, _, number = name.rpartition("/")
    table = {
        "paper": paper or "own",
        "number": number,
        "caption": f"{experiment} with {' and '.join(short.values())} varied.",
        "data": "the data set of each row",
        "columns": [
            *({"name": f"IoU{n}", "metric": f"region/{n}"} for n in range(1, 6)),
            {"name": "mIoU", "metric": "mIoU"},
            {"name": "Var", "metric": "Var", "best": "lowest"},
        ],
        "rows": rows,
    }
    text = yaml.safe_dump(table, sort_keys=False, width=1000)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomic(path, f"{HEAD.format(name=name)}{text}".encode())
    sys.stdout.write(
        f"{path} has {len(rows)} rows; run them with\n"
        f"rgbt reproduce table={name} seeds=3 workers=2\n"
    )
    return 0
