"""Tables as files: a published one in ``sweeps/tables``, one's own in ``tables``, both checked."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, ClassVar, Literal

from rgbt.checks import InputError, nearest
from rgbt.files.yaml_files import read_yaml
from rgbt.metrics.pairs import Protocol
from sweeps.evaluation import Head
from sweeps.table.checks import check_table

PUBLISHED = Path(__file__).resolve().parents[1] / "tables"
"""The papers' tables, part of the package."""

OWN = Path("tables")
"""One's own tables, in the folder that the command is called from."""

Origin = Literal[
    "own_method",
    "own_baseline",
    "own_run_of_other_method",
    "own_run_of_other_method_inferred",
    "imported",
    "imported_inferred",
    "mixed",
]
STRICT: dict[str, Any] = {"extra": "forbid", "allow_inf_nan": False}


@dataclass(frozen=True, kw_only=True)
class Column:
    """One column: a score, a difference or mean of others, a size, or what cannot be computed yet.

    Attributes:
        name: as in the rows' `values`.
        metric: a name of `rgbt.metrics.names`, or class/<name>/acc, class/<name>/region/<n>;
            ``{key}`` stands for that entry of the row's settings.
        minus: (a, b): column a minus column b.
        mean: mean of two or more other columns of the row, e.g. of day and night.
        parameters: millions of parameters of the row's network, counted without any run and always
            at scale=paper; critics are not counted.
        needs: the part that must exist before the column can be computed.
        modality: what is predicted from; "default": what the network is made for.
        frames: of a consistency metric: which two predictions it compares, see
            `rgbt.metrics.pairs`.
        head: of a network with a head per domain which one predicts, see `sweeps.evaluation.Head`.
        degradation: what fails of the images, a file of ``conf/degradation``; None: they are clean.
        severity: of the degradation; may be left out where it has one alone.
        printed: whether the paper has the column; false: ours alone.
        best: which value of the column is marked.
    """

    __pydantic_config__: ClassVar[dict[str, Any]] = STRICT

    name: str
    metric: str | None = None
    minus: tuple[str, str] | None = None
    mean: tuple[str, ...] | None = None
    parameters: bool = False
    needs: str | None = None
    modality: Literal["default", "rgbt", "rgb", "thermal"] = "default"
    frames: Protocol | None = None
    head: Head = "as trained"
    degradation: str | None = None
    severity: float | None = None
    printed: bool = True
    best: Literal["highest", "lowest", "none"] = "highest"

    @property
    def sources(self) -> tuple[str, ...]:
        """The columns that it is computed from; () for all but differences and means."""
        return self.minus or self.mean or ()


@dataclass(frozen=True, kw_only=True)
class Factor:
    """The x axis of the figure.

    Attributes:
        name: its label.
        axis: "log" for values > 0.
    """

    __pydantic_config__: ClassVar[dict[str, Any]] = STRICT

    name: str
    axis: Literal["linear", "log"] = "linear"


@dataclass(frozen=True, kw_only=True)
class Row:
    """One row.

    Attributes:
        label: as printed.
        origin: whose numbers are printed; None for one's own table.
        proposed: whether the row is the method that the paper proposes.
        settings: what the paper says about the row, by name.
        experiment: a file of ``conf/experiment``; None: shown as published only.
        overrides: of `python -m rgbt.run`, at every scale.
        at: further overrides by scale; they win over all others of the row.
        x: where the row lies on the axis of `Table.factor`.
        needs: the part that must exist before the row can be run.
        without: columns that the row's network has no score for: neither they nor what is computed
            from them is evaluated.
        values: printed values by column; None where the paper prints a dash.
        doubtful: columns whose printed value carries the row's remarks as a footnote.
        remarks: one sentence each.
    """

    __pydantic_config__: ClassVar[dict[str, Any]] = STRICT

    label: str
    origin: Origin | None = None
    proposed: bool = False
    settings: Mapping[str, Any] = field(default_factory=dict)
    experiment: str | None = None
    overrides: tuple[str, ...] = ()
    at: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    x: float | None = None
    needs: str | None = None
    without: tuple[str, ...] = ()
    values: Mapping[str, float | None] = field(default_factory=dict)
    doubtful: tuple[str, ...] = ()
    remarks: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True)
class Table:
    """One table.

    Attributes:
        paper: folder of its file; one's own name for one's own.
        number: as printed, e.g. "TABLE III".
        caption: in own words.
        data: what the printed values were measured on.
        unit: of the values, e.g. "percent".
        at: overrides of every row by scale.
        regions: a file of ``conf/metric`` the table is evaluated with, or "as trained".
        absent: how a class without a pixel scores, see `rgbt.metrics.scores`; None: by the
            convention of the data set (`rgbt.metrics.counts.Counts.absent`).
        needs: the part that must exist before any row can be run.
        columns: in order.
        factor: x axis of the figure; None: no figure over a factor.
        remarks: footnotes of the whole table, one sentence each.
        rows: in order.
    """

    __pydantic_config__: ClassVar[dict[str, Any]] = STRICT

    paper: str
    number: str
    caption: str
    data: str
    unit: str = "percent"
    at: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    regions: str = "as trained"
    absent: Literal["released", "exclude"] | None = None
    needs: str | None = None
    columns: tuple[Column, ...]
    factor: Factor | None = None
    remarks: tuple[str, ...] = ()
    rows: tuple[Row, ...]

    def runnable(self, row: Row) -> bool:
        """Whether the project can run the row today."""
        return row.experiment is not None and row.needs is None and self.needs is None

    def columns_of(self, row: Row) -> tuple[Column, ...]:
        """The columns that the row has, in their order: without those that it leaves out."""
        left_out, last = set(row.without), -1
        while last < len(left_out):
            last = len(left_out)
            left_out |= {each.name for each in self.columns if left_out & set(each.sources)}
        return tuple(column for column in self.columns if column.name not in left_out)

    def overrides(self, row: Row, scale: str) -> tuple[str, ...]:
        """Overrides of `python -m rgbt.run` that make the row, beside ``scale=...`` itself.

        Raises:
            InputError: the row has no experiment.
        """
        if row.experiment is None:
            raise InputError(f"row '{row.label}' has no experiment; it is shown as published only.")
        shared, own = self.at.get(scale, ()), row.at.get(scale, ())
        return (f"+experiment={row.experiment}", *shared, *row.overrides, *own)


def table_names(folder: Path = OWN) -> list[str]:
    """Names for `load_table`: the papers' tables, then those in `folder`."""
    return [
        path.relative_to(place).with_suffix("").as_posix()
        for place in (PUBLISHED, folder)
        for path in sorted(place.rglob("*.yaml"))
    ]


def load_table(name: str, folder: Path = OWN) -> Table:
    """Read and check a table.

    Args:
        name: "spatialseg/table3" for a published table, "my/ablation" for one in `folder`, or a
            path that ends in .yaml.
        folder: where one's own tables lie.

    Raises:
        InputError: no such table, two of that name, an unreadable file, an unknown key or column,
            a wrong type; the sentence names file, row and key.
    """
    path = _find(name, folder)
    table = _typed(read_yaml(path), path)
    check_table(table, str(path))
    return table


def _find(name: str, folder: Path) -> Path:
    if name.endswith((".yaml", ".yml")):
        path = Path(name).expanduser()
        if not path.is_file():
            raise InputError(f"table={name}: there is no such file.")
        return path
    found = [path for place in (PUBLISHED, folder) if (path := place / f"{name}.yaml").is_file()]
    if len(found) > 1:
        raise InputError(f"table={name} is {found[0]} as well as {found[1]}; name the file.")
    if not found:
        raise InputError(f"there is no table '{name}'; {nearest(name, table_names(folder))}.")
    return found[0]


def _typed(plain: Any, path: Path) -> Table:
    import pydantic

    try:  # Read as JSON: a list may be a tuple, but a number is no text and text no number.
        text = json.dumps(plain, default=str)
        return pydantic.TypeAdapter(Table).validate_json(text, strict=True)
    except pydantic.ValidationError as error:
        first = error.errors()[0]
        raise InputError(f"{path}, {_sentence(first, plain)}") from None


SHAPES: dict[str, type[Any]] = {"rows": Row, "columns": Column, "factor": Factor}


def _sentence(error: Mapping[str, Any], plain: Any) -> str:
    """What pydantic refused, with the row and the key it stands in and the nearest known key."""
    *parents, last = error["loc"] or ("the whole file",)
    if isinstance(last, int):
        last = f"{parents.pop()}[{last}]"
    place = _place(parents, plain)
    if error["type"] == "unexpected_keyword_argument":
        shape = SHAPES[parents[0]] if parents else Table
        return f"{place}'{last}' is not a key; {nearest(str(last), _keys(shape))}."
    if error["type"] == "missing":
        return f"{place}'{last}' has no value; give one."
    reason = error["msg"].replace("Input", "input").replace("valid array", "list")
    got = json.dumps(error["input"], default=str)
    return f"{place}'{last}': {reason}, got {got}."


def _keys(shape: type[Any]) -> list[str]:
    return [entry.name for entry in fields(shape)]


def _place(parents: list[str | int], plain: Any) -> str:
    """Where in the file: ("rows", 3, "values") is ``row 'Ny/4', values:``."""
    words = [str(parent) for parent in parents]
    if len(parents) > 1 and isinstance(index := parents[1], int):
        entry = plain[parents[0]][index]
        title = entry.get("label", entry.get("name")) if isinstance(entry, dict) else None
        words[:2] = [f"{words[0].removesuffix('s')} {index + 1 if title is None else repr(title)}"]
    return "".join(f"{word}, " for word in words).removesuffix(", ") + (": " if words else "")
