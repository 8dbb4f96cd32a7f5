"""Reads table files: the papers', our studies, and those of the user."""

from __future__ import annotations

from pathlib import Path

from rgbt.checks import InputError, nearest
from rgbt.config.values import check_value
from rgbt.files.yaml_files import read_yaml
from sweeps.table.table import Table

PUBLISHED = Path(__file__).resolve().parents[1] / "tables"  # of the papers
STUDIES = Path(__file__).resolve().parents[1] / "studies"  # ours, which no paper has printed
OWN = Path("tables")  # Tables of the user, in the current folder


def table_names(folder: Path = OWN) -> list[str]:
    """Names for `load_table`: the papers' tables, then those in `folder`."""
    return [
        path.relative_to(root).with_suffix("").as_posix()
        for root in (PUBLISHED, folder)
        for path in sorted(root.rglob("*.yaml"))
    ]


def study_names() -> list[str]:
    """Names for `load_table` of our own studies."""
    return [path.stem for path in sorted(STUDIES.glob("*.yaml"))]


def table_path(name: str, folder: Path = OWN) -> Path:
    """The file of a table; InputError: no such table, or two of that name.

    "spatialseg/table3" is a published table, "spatial_bias" a study of ours, "my/ablation" one in
    the `folder` of the user's tables; or a path that ends in .yaml.
    """
    if name.endswith((".yaml", ".yml")):
        return Path(name).expanduser()
    places = [root / f"{name}.yaml" for root in (PUBLISHED, STUDIES, folder)]
    paths = [path for path in places if path.is_file()]
    if len(paths) > 1:
        raise InputError(f"table={name} is both {paths[0]} and {paths[1]}; give the path of one.")
    if not paths:
        known = [*table_names(folder), *study_names()]
        raise InputError(f"there is no table '{name}'; {nearest(name, known)}.")
    return paths[0]


def is_own(name: str) -> bool:
    """Whether a table is one of the user, which no test of this project has checked."""
    return not table_path(name).resolve().is_relative_to(PUBLISHED.parent)


def load_table(name: str, folder: Path = OWN) -> Table:
    """Read and check a table (see `table_path`); InputError names its file and the wrong key."""
    path = table_path(name, folder)
    table: Table = check_value(str(path), read_yaml(path), Table)
    return table
