"""The parts of a table file: columns, rows, the printed values."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar, Literal

from rgbt.checks import InputError
from rgbt.config.compose import chosen_scale
from rgbt.metrics.pairs import Protocol
from sweeps.evaluation import BatchNorm, Head
from sweeps.table.claim import Claim
from sweeps.table.design import Design

Origin = Literal[
    "own_method",
    "own_baseline",
    "own_run_of_other_method",
    "own_run_of_other_method_inferred",
    "imported",
    "imported_inferred",
    "mixed",
]
Form = Literal["paper", "released"]
"""What a row is run as: as the paper's text describes it, or as its release made it."""

Efficiency = Literal["parameters", "gflops", "peak_memory", "latency", "images_per_second"]
"""What a network needs: millions of parameters, GFLOPs, MiB, milliseconds for one image, images per
second."""

COUNTED: tuple[Efficiency, ...] = ("parameters", "gflops")
"""The same on every machine."""

MEASURED: tuple[Efficiency, ...] = ("peak_memory", "latency", "images_per_second")
"""Of one device; shown with the ratio to the first row."""

STRICT: dict[str, Any] = {"extra": "forbid", "allow_inf_nan": False}


@dataclass(frozen=True, kw_only=True)
class Column:
    """One column: a score, a difference or mean of others, or the efficiency of the network.

    Attributes:
        name: as in the rows' `values`.
        metric: a name of `rgbt.metrics.names`, or class/<name>/acc, class/<name>/region/<n>, or of
            details (`rgbt.metrics.details`) with their default bins, such as distance/10-20;
            ``{key}`` is replaced by that entry of the row's settings.
        minus: (a, b): column a minus column b.
        mean: mean of two or more other columns of the row, e.g. of day and night.
        efficiency: of the row's network, counted or measured without any run and always at
            scale=paper (`sweeps.table.efficiency`); discriminators are not part of it. The images
            have the size `settings.image_hw` of the row, or 480 x 640.
        modality: what is predicted from; "default": what the network is made for.
        frames: of a consistency metric: which two predictions it compares, see
            `rgbt.metrics.pairs`.
        head: of a network with a head per domain, the one that predicts; see
            `sweeps.evaluation.Head`.
        corruption: of the images, NAME or NAME:IMAGE with a file of ``conf/corruption``; None: they
            are clean.
        severity: of the corruption; may be omitted if the corruption has a single one.
        batch_norm: statistics of batch normalisation, see `sweeps.evaluation.BatchNorm`.
        batch_norm_splits: splits whose images give them; (): the test split.
        printed: whether the paper has the column; false: ours alone.
        best: which value of the column is marked.
    """

    __pydantic_config__: ClassVar[dict[str, Any]] = STRICT

    name: str
    metric: str | None = None
    minus: tuple[str, str] | None = None
    mean: tuple[str, ...] | None = None
    efficiency: Efficiency | None = None
    modality: Literal["default", "rgbt", "rgb", "thermal"] = "default"
    frames: Protocol | None = None
    head: Head = "as trained"
    corruption: str | None = None
    severity: float | None = None
    batch_norm: BatchNorm = "as trained"
    batch_norm_splits: tuple[str, ...] = ()
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
class ReleasedForm:
    """How the release makes a row; what is None is as in the paper's form.

    Attributes:
        experiment: instead of `Row.experiment`.
        overrides: instead of `Row.overrides`.
        at: instead of `Row.at`.
        remarks: what the release does differently, one sentence each.
    """

    __pydantic_config__: ClassVar[dict[str, Any]] = STRICT

    experiment: str | None = None
    overrides: tuple[str, ...] | None = None
    at: Mapping[str, tuple[str, ...]] | None = None
    remarks: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True)
class Row:
    """One row.

    Attributes:
        label: as printed.
        group: rows with the same word are chosen together by ``rows=WORD``; "": none.
        origin: whose numbers are printed; None in a table of the user.
        proposed: whether the row is the method that the paper proposes.
        settings: what the paper says about the row, by name.
        experiment: a file of ``conf/experiment``; None: shown as published only.
        overrides: of `python -m rgbt.run`, at every scale.
        at: further overrides by scale; they win over all others of the row.
        released: how the release makes the row; None: the same way, as far as known.
        same_as: label of an earlier row that may be the same run, e.g. where one small network
            stands for two backbones at scale=demo.
        network: overrides that describe the row's network for an evaluation with a file of weights;
            (): those of `experiment`, if there is one.
        x: where the row lies on the axis of `Table.factor`.
        without: columns that the row's network has no score for; columns computed from them are
            left out too.
        tested_in: name -> overrides of the data set with which the row's network is tested too.
        values: printed values by column; None where the paper prints a dash.
        doubtful: columns whose printed value carries the row's remarks as a footnote.
        remarks: one sentence each.
    """

    __pydantic_config__: ClassVar[dict[str, Any]] = STRICT

    label: str
    group: str = ""
    origin: Origin | None = None
    proposed: bool = False
    settings: Mapping[str, Any] = field(default_factory=dict)
    experiment: str | None = None
    overrides: tuple[str, ...] = ()
    at: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    released: ReleasedForm | None = None
    same_as: str | None = None
    network: tuple[str, ...] = ()
    x: float | None = None
    without: tuple[str, ...] = ()
    tested_in: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    values: Mapping[str, float | None] = field(default_factory=dict)
    doubtful: tuple[str, ...] = ()
    remarks: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True)
class Table:
    """One table.

    Attributes:
        paper: folder of its file; in a table of the user, any name.
        number: as printed, e.g. "TABLE III".
        caption: in our words.
        data: what the printed values were measured on.
        unit: of the values, e.g. "percent".
        at: overrides of every row by scale.
        regions: a file of ``conf/metric`` the table is evaluated with, or "as trained".
        absent: how a class without a pixel scores, see `rgbt.metrics.scores`; None: by the
            convention of the data set (`rgbt.metrics.counts.Counts.absent`).
        columns: in order.
        factor: x axis of the figure; None: no figure over a factor.
        forms: one sentence per form that says what the rows are run as.
        claims: what the paper says about the table.
        remarks: footnotes of the whole table, one sentence each.
        design: a factorial design whose rows follow `rows`; None: there is none.
        rows: in order; may be omitted beside a design.
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
    columns: tuple[Column, ...]
    factor: Factor | None = None
    forms: Mapping[Form, str] = field(default_factory=dict)
    claims: tuple[Claim, ...] = ()
    remarks: tuple[str, ...] = ()
    design: Design | None = None
    rows: tuple[Row, ...] = ()

    @property
    def runnable_rows(self) -> list[Row]:
        """The rows that the project can run today."""
        return [row for row in self.rows if row.experiment is not None]

    def columns_of(self, row: Row) -> tuple[Column, ...]:
        """The columns of the row, in their order: without `Row.without`."""
        left_out, last = set(row.without), -1
        while last < len(left_out):
            last = len(left_out)
            left_out |= {each.name for each in self.columns if left_out & set(each.sources)}
        return tuple(column for column in self.columns if column.name not in left_out)

    def overrides(self, row: Row, scale: str, form: Form = "paper") -> tuple[str, ...]:
        """Overrides of `python -m rgbt.run` that make the row, beside ``scale=...`` itself.

        Raises:
            InputError: the row has no experiment.
        """
        if row.experiment is None:
            raise InputError(f"row '{row.label}' has no experiment; it is shown as published only.")
        chosen = row.released if form == "released" and row.released else ReleasedForm()
        overrides = row.overrides if chosen.overrides is None else chosen.overrides
        at = row.at if chosen.at is None else chosen.at
        experiment = chosen.experiment or row.experiment
        shared, own = (each.get(chosen_scale(scale, each), ()) for each in (self.at, at))
        return (f"+experiment={experiment}", *shared, *overrides, *own)
