"""A table file: where it is; its columns, rows and printed values; and what they must fulfil."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal

from annotated_types import Interval, MinLen
from pydantic import AfterValidator, BeforeValidator, NonNegativeInt, model_validator

from analysis.uncertainty.blocks import NamedBlocks
from rgbt.checks import InputError, check_choice, nearest
from rgbt.config.compose import available, chosen_scale
from rgbt.config.values import check_value
from rgbt.files.yaml_files import read_yaml
from rgbt.metrics import names
from rgbt.metrics.measurement import Statistics
from rgbt.metrics.named import PAIR_SCORES, details_of_metric, parse
from rgbt.metrics.pairs import Protocol
from sweeps.plan.claim import OTHERS, PREVIOUS, Claim, Strict, check_different
from sweeps.plan.design import Design
from sweeps.plan.measurement import Head, Words

PUBLISHED = Path(__file__).resolve().parents[1] / "tables"  # tables of the papers
STUDIES = Path(__file__).resolve().parents[1] / "studies"  # our tables, which no paper has printed
OWN = Path("tables")  # tables of the user, in the current folder

Form = Literal["paper", "released"]  # what a row is run as

# Ending of the label of a row in its released form, beside the row of the paper's form.
RELEASED = ", released"

# Metrics of the most important columns of a table.
HEADLINES = (names.MIOU, names.VAR, names.TC, names.CA, names.CA_RELEASED)


@dataclass(frozen=True, kw_only=True)
class Column(Strict):
    """One column: a score, a difference or mean of others, or the efficiency of the network.

    Attributes:
        name: as in the rows' `values`.
        metric: a name of `rgbt.metrics.names`, or class/<name>/acc, class/<name>/region/<n>, or of
            details (`rgbt.metrics.details`) with their default bins, such as distance/10-20;
            ``{key}`` is replaced by that entry of the row's settings.
        minus: (a, b): column a minus column b.
        mean: of two or more other columns of the row, e.g. of day and night.
        efficiency: of the row's network, without any run: millions of "parameters" at scale=paper
            (`sweeps.score.efficiency`), or the "speed" that the paper prints, which is shown alone.
        modality: what is predicted from; "default": what the network is made for.
        frames: of a consistency metric: its protocol, see `rgbt.metrics.pairs`.
        head: of a network with a head per domain, the one that predicts.
        corruption: of the images, NAME or NAME:IMAGE with a file of ``conf/corruption``.
        severity: of the corruption; may be omitted if the corruption has a single one.
        batch_norm: statistics of batch normalisation, see `rgbt.metrics.measurement.Statistics`.
        batch_norm_splits: splits whose images give them; (): the test split.
        printed: whether the paper has the column; false: ours alone.
        best: which value of the column is marked.
    """

    name: str
    metric: str | None = None
    minus: tuple[str, str] | None = None
    mean: Annotated[tuple[str, ...], MinLen(2)] | None = None
    efficiency: Literal["parameters", "speed"] | None = None
    modality: Literal["default", "rgbt", "rgb", "thermal"] = "default"
    frames: Protocol | None = None
    head: Head = "as trained"
    corruption: str | None = None
    severity: float | None = None
    batch_norm: Statistics = "as trained"
    batch_norm_splits: tuple[str, ...] = ()
    printed: bool = True
    best: Literal["highest", "lowest", "none"] = "highest"

    @property
    def sources(self) -> tuple[str, ...]:
        """The columns that it is computed from; () for all but differences and means."""
        return self.minus or self.mean or ()

    @model_validator(mode="after")
    def _check(self) -> Column:
        kinds = ("metric", "minus", "mean", "efficiency")
        given = [key for key in kinds if getattr(self, key) is not None]
        if len(given) != 1:
            raise ValueError(f"expected one of {', '.join(kinds)}, got {given}.")
        of_pairs = (self.metric or "").rpartition("/")[2] in PAIR_SCORES
        if of_pairs != (self.frames is not None):
            raise ValueError(
                f"'frames' is needed for {', '.join(PAIR_SCORES)}, and only for these."
            )
        if of_pairs or self.metric is None:  # these would have no effect
            for key in ("modality", "head", "corruption", "batch_norm"):
                if getattr(self, key) not in (None, "as trained", "default"):
                    raise ValueError(f"'{key}' is only for scores of single frames.")
        return self


@dataclass(frozen=True, kw_only=True)
class ReleasedForm(Strict):
    """How the release makes a row; what is None is as in the paper's form.

    `remarks` say what the release does differently, one sentence each.
    """

    experiment: str | None = None
    overrides: tuple[str, ...] | None = None
    at: Mapping[str, tuple[str, ...]] | None = None
    remarks: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True)
class Row(Strict):
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
        same_as: label of an earlier row that may be the same run.
        network: overrides that describe the row's network for an evaluation with a file of weights;
            (): those of `experiment`, if there is one.
        without: columns that the row's network has no score for; columns computed from them are
            left out too.
        tested_in: name -> overrides of the data set with which the row's network is tested too.
        values: printed values by column; None where the paper prints a dash.
        lists: those of the published row, where they are not those of the table.
        doubtful: columns whose printed value carries the row's remarks as a footnote.
        remarks: one sentence each.
    """

    label: str
    group: str = ""
    origin: str | None = None
    proposed: bool = False
    settings: Mapping[str, Any] = field(default_factory=dict)
    experiment: str | None = None
    overrides: tuple[str, ...] = ()
    at: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    released: ReleasedForm | None = None
    same_as: str | None = None
    network: tuple[str, ...] = ()
    without: tuple[str, ...] = ()
    tested_in: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    values: Mapping[str, float | None] = field(default_factory=dict)
    lists: str = ""
    doubtful: tuple[str, ...] = ()
    remarks: tuple[str, ...] = ()

    @model_validator(mode="after")
    def _check(self) -> Row:
        if self.experiment is None and (self.overrides or self.released):
            raise ValueError("'experiment' has no value; without it overrides have no effect.")
        released = self.released.experiment if self.released else None
        for experiment in (self.experiment, released):
            if experiment is not None:
                check_choice("experiment", experiment, available("experiment"))
        return self


@dataclass(frozen=True, kw_only=True)
class Table(Strict):
    """One table.

    Attributes:
        paper: folder of its file; in a table of the user, any name.
        data: what the printed values were measured on.
        lists: which lists the published rows were trained and their checkpoints selected on.
        at: overrides of every row by scale.
        folds: data set for cross-validation by scale, with choices NAME_fold0, NAME_fold1, ...: a
            run of seed s has the fold s modulo their number, and so other test images than others.
        blocks: by scale, neighbouring images that are drawn together for an interval
            (`analysis.uncertainty.blocks`; default: auto).
        regions: a file of ``conf/metric`` the table is evaluated with, or "as trained".
        absent: how a class without a pixel scores, see `rgbt.metrics.scores`; None: by the
            convention of the data set (`rgbt.metrics.counts.Counts.absent`).
        forms: one sentence per form that says what the rows are run as.
        confirm: seeds that judge the claims, declared before any of them is run; (): none.
        remarks: footnotes of the whole table; a mapping has one for a scale (`remarks_at`).
        design: a factorial design whose rows follow `rows`.
    """

    paper: str
    # YAML reads `number: 1` as a number.
    number: Annotated[str, BeforeValidator(lambda n: str(n) if type(n) is int else n)]
    caption: str
    data: str
    lists: str = ""
    unit: str = "percent"
    at: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    folds: Mapping[str, str] = field(default_factory=dict)
    blocks: Mapping[str, NamedBlocks | Annotated[int, Interval(ge=1)]] = field(default_factory=dict)
    regions: str = "as trained"
    absent: Literal["released", "exclude"] | None = None
    columns: tuple[Column, ...]
    forms: Mapping[Form, str] = field(default_factory=dict)
    confirm: Annotated[tuple[NonNegativeInt, ...], AfterValidator(check_different)] = ()
    claims: tuple[Claim, ...] = ()
    remarks: tuple[str | dict[str, str], ...] = ()
    design: Design | None = None
    rows: tuple[Row, ...] = ()

    @model_validator(mode="after")
    def _add_rows_of_design(self) -> Table:
        if not self.rows and self.design is None:
            raise ValueError("'rows' has no value.")
        of_design = () if self.design is None else self.design.rows()
        return replace(self, rows=(*self.rows, *(Row(**row) for row in of_design)))

    @model_validator(mode="after")
    def _check(self) -> Table:
        check_different([column.name for column in self.columns])
        check_different([row.label for row in self.rows])
        check_different([claim.name for claim in self.claims])
        released = [row.released.at for row in self.rows if row.released]
        remarks = [remark for remark in self.remarks if isinstance(remark, dict)]
        for at in (self.at, *(row.at for row in self.rows), *released, *remarks):
            for scale in at or ():
                check_choice("at", scale, available("scale"))
        for scale, name in self.folds.items():
            check_choice("folds", scale, available("scale"))
            check_choice("folds", f"{name}_fold0", available("dataset"))
        if self.regions != "as trained":
            check_choice("regions", self.regions, available("metric"))
        self._check_columns()
        self._check_rows()
        for claim in self.claims:
            self._check_claim(claim)
        return self

    def _check_columns(self) -> None:
        known = [column.name for column in self.columns if is_counted(column)]
        for column in self.columns:
            for name in column.sources:  # they are computed in order
                check_choice(f"column '{column.name}'", name, known)
            if column.sources:
                known.append(column.name)
        for name in self.design.outcomes if self.design else ():
            check_choice("design.outcomes", name, self._names)
        of_pairs = [column.name for column in self.columns if column.frames is not None]
        if of_pairs and self.design and self.design.tested:
            raise ValueError(f"column '{of_pairs[0]}': pairs of frames are not tested in worlds.")

    def _check_rows(self) -> None:
        printed = [column.name for column in self.columns if column.printed]
        metrics = [column.metric for column in self.columns if column.metric is not None]
        earlier: list[str] = []
        for row in self.rows:
            where = f"row '{row.label}'"
            if row.same_as is not None:
                check_choice(f"{where}, same_as (an earlier row)", row.same_as, earlier)
            earlier.append(row.label)
            for name in row.without:
                check_choice(f"{where}, without", name, self._names)
            for name in (*row.values, *row.doubtful):
                check_choice(f"{where}, printed column", name, printed)
            for metric in metrics:
                for key in re.findall(r"{(\w+)}", metric):
                    check_choice(f"{where}, settings for '{metric}'", key, row.settings)
                parse(metric.format_map(row.settings))

    def _check_claim(self, claim: Claim) -> None:
        where, design = f"claim '{claim.name}'", self.design
        labels, names = [row.label for row in self.rows], self._names
        if claim.effect:
            if design is None:
                raise ValueError(f"{where}: an effect is one of a design.")
            labels, names = [method.name for method in design.methods], list(design.outcomes)
            for letter in claim.effect:
                check_choice(f"{where}, effect", letter, design.letters)
            if claim.part:
                check_choice(f"{where}, part", claim.part, design.parts)
        against = () if claim.against in ((OTHERS,), (PREVIOUS,)) else claim.against
        for label in (*claim.rows, *against):
            check_choice(f"{where}, rows", label, labels)
        minus = () if claim.minus_column is None else (claim.minus_column,)
        for name in (*claim.columns, *minus):
            check_choice(f"{where}, columns", name, names)
        if not claim.columns or not list(claim.pairs(labels)):
            raise ValueError(f"{where}: there is nothing to compare.")

    @property
    def _names(self) -> list[str]:
        return [column.name for column in self.columns]

    @property
    def runnable_rows(self) -> list[Row]:
        """The rows that the project can run today."""
        return [row for row in self.rows if row.experiment is not None]

    def remarks_at(self, scale: str) -> tuple[str, ...]:
        """Return the footnotes at a scale: those of all, and those of it or of its files."""
        found: list[str] = []
        for remark in self.remarks:
            if isinstance(remark, str):
                found.append(remark)
            elif (name := chosen_scale(scale, remark)) in remark:
                found.append(remark[name])
        return tuple(found)

    def columns_of(self, row: Row) -> tuple[Column, ...]:
        """Return the columns of the row, in their order: without `Row.without`."""
        left_out = set(row.without)
        kept = []
        for column in self.columns:  # a column follows those that it is computed from
            if left_out & {column.name, *column.sources}:
                left_out.add(column.name)
            else:
                kept.append(column)
        return tuple(kept)

    def of_fold(self, scale: str, seed: int) -> tuple[str, ...]:
        """Return the override of the fold of a seed at a scale; () without folds."""
        if scale not in self.folds:
            return ()
        name = self.folds[scale]
        number = sum(choice.startswith(f"{name}_fold") for choice in available("dataset"))
        return (f"dataset={name}_fold{seed % number}",)

    def overrides(self, row: Row, scale: str, form: Form = "paper") -> tuple[str, ...]:
        """Return the overrides of a run that make the row, beside ``scale=...`` and its fold."""
        if row.experiment is None:
            raise InputError(f"row '{row.label}' has no experiment; it is shown as published only.")
        chosen = row.released if form == "released" and row.released else ReleasedForm()
        overrides = row.overrides if chosen.overrides is None else chosen.overrides
        at = row.at if chosen.at is None else chosen.at
        experiment = chosen.experiment or row.experiment
        shared = self.at.get(chosen_scale(scale, self.at), ())
        own = at.get(chosen_scale(scale, at), ())
        return (f"+experiment={experiment}", *shared, *overrides, *own)

    def headlines(self) -> list[Column]:
        """Return the columns of `HEADLINES`, over all images or those of the day or the night."""
        shown = {f"{part}{metric}" for part in ("", "day/", "night/") for metric in HEADLINES}
        return [column for column in self.columns if column.metric in shown]

    def both_forms(self) -> Table:
        """Return the table with a second row for every row that the release makes differently.

        Its claims are that the released form scores higher; those of the paper are left out, as
        they are about the rows of one form. InputError: no row has a released form of its own.
        """
        rows: list[Row] = []
        claims: list[Claim] = []
        compared = self.headlines() or [column for column in self.columns if is_counted(column)]
        for row in self.rows:
            rows.append(row)
            if row.released is None:
                continue
            label = f"{row.label}{RELEASED}"
            own = {key: value for key, value in vars(row.released).items() if value is not None}
            rows.append(
                replace(row, **own, label=label, released=None, same_as=row.label, doubtful=())
            )
            for column in compared:
                if column not in self.columns_of(row):
                    continue
                claim = Claim(
                    name=f"{label}, {column.name}",
                    says=f"{row.label}: the released form has a higher {column.name}.",
                    source="form=both",
                    rows=(label,),
                    against=(row.label,),
                    columns=(column.name,),
                    expected="higher",
                )
                claims.append(claim)
        if not claims:
            raise InputError(
                f"form=both: no row of {self.paper}, {self.number} has a released form of its own; "
                "use form=paper."
            )
        return replace(self, rows=tuple(rows), claims=tuple(claims))


def metric_of(column: Column, row: Row) -> str:
    """Fill placeholders of the column's metric, such as ``{class}``, from the row's settings."""
    return str(column.metric).format_map(row.settings)


def words_of(column: Column, table: Table) -> Words:
    """Return the measurement that a column needs; (): the test that every run ends with."""
    if column.frames is not None:
        return (f"frames={column.frames}",)
    given: dict[str, Any] = {
        "modality": column.modality,
        "regions": table.regions,
        "head": column.head,
        "corruption": column.corruption or "",
        "severity": "" if column.severity is None else f"{column.severity:g}",
        "batch_norm": column.batch_norm,
        "batch_norm_splits": ",".join(column.batch_norm_splits),
        "details": details_of_metric(str(column.metric)) or "",
    }
    usual = ("", "default", "as trained")
    return tuple(f"{key}={value}" for key, value in given.items() if value not in usual)


def world_words(column: Column, table: Table, row: Row) -> dict[str, Words]:
    """Return the measurement that a column needs in every world of `Row.tested_in`, by name."""
    usual = words_of(column, table)
    return {name: (*usual, *overrides) for name, overrides in row.tested_in.items()}


def is_counted(column: Column) -> bool:
    """Whether the column is a score of counts, not computed from other columns."""
    return column.metric is not None


def table_names(*folders: Path) -> list[str]:
    """Return the names for `load_table` of the tables in folders."""
    names = []
    for folder in folders:
        for path in sorted(folder.rglob("*.yaml")):
            names.append(path.relative_to(folder).with_suffix("").as_posix())
    return names


def table_path(name: str) -> Path:
    """Find the file of a table; InputError: no such table, or two of that name.

    "spatialseg/table3" is a published table, "spatial_bias" a study of ours, "my/ablation" one of
    the user; or a path that ends in .yaml.
    """
    if name.endswith((".yaml", ".yml")):
        return Path(name).expanduser()
    folders = (PUBLISHED, STUDIES, OWN)
    paths = [folder / f"{name}.yaml" for folder in folders if (folder / f"{name}.yaml").is_file()]
    if len(paths) > 1:
        raise InputError(f"table={name} is both {paths[0]} and {paths[1]}; give the path of one.")
    if not paths:
        raise InputError(f"there is no table '{name}'; {nearest(name, table_names(*folders))}.")
    return paths[0]


def load_table(name: str) -> Table:
    """Read and check a table (see `table_path`); InputError names its file and the wrong key."""
    path = table_path(name)
    table: Table = check_value(str(path), read_yaml(path), Table)
    return table
