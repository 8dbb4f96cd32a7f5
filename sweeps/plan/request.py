"""A requested table, and the runs that it needs as points: one per row and seed.

Rows of the same run share a point. How a table is requested is recorded in the tags of its runs.
"""

from __future__ import annotations

import hashlib
import shlex
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from rgbt.checks import InputError, check_choice, nearest, split_list
from rgbt.config.compose import DEFAULT_SCALE, available
from rgbt.config.options import readable_paths, with_home
from rgbt.runs.naming import MACHINE_OVERRIDES
from rgbt.runs.specify import CHECKOUT
from sweeps.plan.claim import PREVIOUS
from sweeps.plan.measurement import Words
from sweeps.plan.planner import Planner
from sweeps.plan.table import (
    PUBLISHED,
    STUDIES,
    Form,
    Row,
    Table,
    is_counted,
    load_table,
    metric_of,
    table_names,
    table_path,
    words_of,
    world_words,
)
from sweeps.point import Outcome, Point

TAG = "rgbt.table/"  # prefix of the tag that names the rows of a run
PRETRAINED = "pretrained."  # pretrained.NETWORK=FILE: initial weights of its rows
TAG_LENGTH = 5000

# Prefix of the tag with the form of the rows, the digest of the settings of the row alone, and the
# words that were typed for all rows; without words, the paper's form has none.
REQUESTED = "rgbt.requested/"

# Nodes of the configuration that no override may change.
ROW_SETTINGS = {
    "seed": "the rows set it; choose seeds=3.",
    "experiment": "the rows set it; choose another table.",
    "metric": "the columns define what is counted; set `regions` in your own table.",
    "consistency": "the columns define what is counted; see rgbt consistency run=...",
}

# Label of a row and seed of its run; a row that is not trained here has the seed
# `analysis.uncertainty.contrasts.FIXED`.
RowSeed = tuple[str, int]


@dataclass(frozen=True)
class ExternalRow:
    """A row whose counts are made from a file of weights, or a folder of predictions."""

    label: str
    kind: str  # "weights" or "predictions"
    path: Path


@dataclass(frozen=True)
class TableRequest:
    """A table to compute.

    Attributes:
        table: with the rows that are shown; see `select_rows`.
        extra: overrides that win over those of the rows.
        pretrained: files of initial weights by the name of the network.
        external: rows that are evaluated and not trained.
        chosen: options that make it another table, as they were typed: rows=..., form=both.
        until_decided: whether seeds are added until claims are decided.
        digests: of the settings of the rows without `extra` and `pretrained`, by label.
    """

    name: str
    table: Table
    scale: str
    seeds: tuple[int, ...] = (0,)
    extra: tuple[str, ...] = ()
    pretrained: Mapping[str, str] = field(default_factory=dict)
    form: Form = "paper"
    external: tuple[ExternalRow, ...] = ()
    chosen: tuple[str, ...] = ()
    until_decided: bool = False
    digests: Mapping[str, str] = field(default_factory=dict)

    def overrides(self, label: str, seed: int) -> tuple[str, ...]:
        """Return the overrides of the run of row `label` with that seed."""
        row = row_named(label, self.table)
        experiment, *others = self.table.overrides(row, self.scale, self.form)
        scale = () if self.scale == DEFAULT_SCALE else (f"scale={self.scale}",)
        file = self.pretrained.get(_model_of(others))
        weights = () if file is None else readable_paths([f"model.weights={file}"])
        fold = self.table.of_fold(self.scale, seed)
        return (experiment, *scale, *fold, *others, *self.extra, *weights, f"seed={seed}")

    @property
    def trained_rows(self) -> list[Row]:
        """The rows whose network is trained: those that can be run and are not evaluated."""
        evaluated = {row.label for row in self.external}
        return [row for row in self.table.runnable_rows if row.label not in evaluated]

    def points(self, row_seeds: Sequence[RowSeed] | None = None) -> list[Point]:
        """Return the points of some rows and seeds, by default of all, seed by seed.

        A table with columns of efficiency alone needs no run.
        """
        if row_seeds is None:
            labels = [row.label for row in self.trained_rows]
            is_run = any(is_counted(column) for column in self.table.columns)
            row_seeds = [(label, seed) for seed in self.seeds for label in labels if is_run]
        sharing: dict[tuple[str, ...], list[str]] = {}
        for label, seed in row_seeds:
            sharing.setdefault(self.overrides(label, seed), []).append(label)
        points = []
        for overrides, labels in sharing.items():
            more = f" (and {len(labels) - 1} more)" if len(labels) > 1 else ""
            label = f"{labels[0]}{more} {overrides[-1]}"
            evaluations = self.evaluations(labels)
            points.append(Point(label, overrides, {}, self.tags(labels), evaluations=evaluations))
        return points

    def tags(self, labels: Sequence[str]) -> dict[str, str]:
        """Return the MLflow tags of the run of the rows `labels`: what requested it, and how."""
        tags = {TAG + self.name: " | ".join(labels)[:TAG_LENGTH]}
        words = self.deciding_words()
        if words or self.form != "paper":
            how = [self.form, self.digests.get(labels[0], ""), *words]
            tags[REQUESTED + self.name] = shlex.join(how)
        return tags

    def evaluations(self, labels: Collection[str]) -> tuple[Words, ...]:
        """Return the measurements that the rows `labels` need beside the test of their runs."""
        needed: dict[Words, None] = {}
        for row in self.table.runnable_rows:
            if row.label not in labels:
                continue
            for column in filter(is_counted, self.table.columns_of(row)):
                needed[words_of(column, self.table)] = None
                needed |= dict.fromkeys(world_words(column, self.table, row).values())
        return tuple(words for words in needed if words)

    def runs(self, outcomes: Sequence[Outcome]) -> dict[RowSeed, Outcome]:
        """Return the outcome of every row and seed that has one."""
        by_overrides = {outcome.point.overrides: outcome for outcome in outcomes}
        seeds = sorted({seed_of(overrides) for overrides in by_overrides})
        found = {}
        for row in self.trained_rows:
            for seed in seeds:
                outcome = by_overrides.get(self.overrides(row.label, seed))
                if outcome is not None:
                    found[row.label, seed] = outcome
        return found

    def typed_overrides(self) -> tuple[str, ...]:
        """Return the overrides of all rows, as they were typed."""
        files = (f"{PRETRAINED}{model}={file}" for model, file in self.pretrained.items())
        return (*self.extra, *files)

    @property
    def is_confirming(self) -> bool:
        """Whether its seeds are those that the table declares."""
        return bool(self.seeds) and self.seeds == self.table.confirm

    def deciding_words(self) -> list[str]:
        """Return the words typed for all rows that are of the runs, and not of the machine."""
        machine = (*MACHINE_OVERRIDES, f"{CHECKOUT}=")
        words = self.typed_overrides()
        return [word for word in words if not word.lstrip("+~").startswith(machine)]

    @property
    def typed(self) -> tuple[str, ...]:
        """Further words that make it another table, as they were typed."""
        files = (f"{row.kind}.{row.label}={row.path}" for row in self.external)
        return (*files, *self.chosen)

    @property
    def variant(self) -> str:
        """The scale and the form; with a short hash where other words make it another table."""
        typed = (*self.typed_overrides(), *self.typed)
        shown = [word for word in typed if not word.startswith("dataset.root=")]
        digest = hashlib.sha256("\n".join(sorted(shown)).encode()).hexdigest()[:6]
        form = "" if self.form == "paper" else f"-{self.form}"
        return f"{self.scale}{form}-{digest}" if shown else f"{self.scale}{form}"

    @property
    def study(self) -> str:
        """Name of the study that runs it: other rows, seeds or scales have another driver."""
        seeds = [] if self.until_decided else map(str, self.seeds)
        return " ".join([f"table/{self.name}", self.variant, *seeds])


def make_request(
    name: str,
    scale: str,
    words: Sequence[str] = (),
    *,
    form: str = "paper",
    rows: str = "",
    planner: Planner | None = None,
) -> TableRequest:
    """Read a table and what was typed for it, for seed 0.

    Its rows are selected (``rows=...``), both forms are compared (``form=both``), and of `words`,
    pretrained.NETWORK=FILE, weights.ROW=FILE and predictions.ROW=FOLDER are read; the others are
    overrides of every row. With a `planner`, rows that would be one run are refused; a test has
    compared those of the project as they are.

    InputError: a word that does not fit the table, or a file with the name of a published table.
    """
    check_choice("scale", scale, available("scale"))
    table, published = load_table(name), table_names(PUBLISHED)
    if name.endswith((".yaml", ".yml")):
        path = table_path(name).resolve()
        name = f"{table.paper}/{path.stem}"
        if name in published and not path.is_relative_to(PUBLISHED):
            raise InputError(f"table={path}: '{name}' is a published table; change `paper`.")
    chosen = [f"rows={rows}"] if rows else []
    if rows:
        table = select_rows(table, rows)
    if form == "both":
        table = table.both_forms()
        chosen.append("form=both")
    external, others = external_rows(words, table)
    extra: list[str] = []
    pretrained: dict[str, str] = {}
    for word in others:
        if word.startswith(PRETRAINED):
            model, _, file = word.removeprefix(PRETRAINED).partition("=")
            pretrained[model] = file
        else:
            extra.append(word)
    request = TableRequest(
        name,
        table,
        scale,
        extra=tuple(extra),
        pretrained=pretrained,
        form="released" if form == "released" else "paper",
        external=tuple(external),
        chosen=tuple(chosen),
    )
    known = {_model_of(table.overrides(row, scale, request.form)) for row in table.runnable_rows}
    for model in pretrained:
        check_choice(f"{PRETRAINED}NETWORK of {name} at scale={scale}", model, known - {""})
    is_tested = name in (*published, *table_names(STUDIES))
    if planner is not None and (request.typed_overrides() or external or not is_tested):
        check_equal_runs(request, planner)
    return request


def check_overrides(words: Sequence[str]) -> None:
    """Refuse overrides that belong to the rows or columns of a table."""
    for word in words:
        key = word.lstrip("+~").partition("=")[0].rpartition("@")[2].partition(".")[0]
        if key in ROW_SETTINGS:
            raise InputError(f"'{word}': {ROW_SETTINGS[key]}")


def row_named(word: str, table: Table) -> Row:
    """Return the row with this label, or with this number from 1 on; InputError: there is none."""
    rows = {str(number): row for number, row in enumerate(table.rows, start=1)}
    rows |= {row.label: row for row in table.rows}
    if word not in rows:
        labels = [row.label for row in table.rows]
        raise InputError(f"there is no row '{word}' in the table; {nearest(word, labels)}.")
    return rows[word]


def select_rows(table: Table, text: str) -> Table:
    """Return the table with the rows of ``rows=A,H`` alone, and with the claims about them.

    A row is named by its label or its number (labels with commas: by the number), several by the
    name of their group (`Row.group`).
    """
    chosen: set[str] = set()
    for word in split_list(text, "rows"):
        group = {row.label for row in table.rows if row.group == word}
        chosen |= group or {row_named(word, table).label}
    origin = _origins(table)
    rows = [replace(row, same_as=origin[row.label]) for row in table.rows if row.label in chosen]

    # "Better than all others" is another statement where some of the others are missing.
    claims = table.claims
    if len(rows) < len(table.rows):
        known = {*chosen, PREVIOUS}
        known |= {str(row.settings.get("method")) for row in rows if row.group}
        claims = tuple(claim for claim in claims if {*claim.rows, *claim.against} <= known)
    return replace(table, rows=tuple(rows), claims=claims)


def external_rows(words: Sequence[str], table: Table) -> tuple[list[ExternalRow], list[str]]:
    """Return the external rows in the order of the table, and all words that name none."""
    found: dict[str, ExternalRow] = {}
    others = []
    for word in words:
        kind, _, rest = word.partition(".")
        if kind not in ("weights", "predictions"):
            others.append(word)
            continue
        labels = [row.label for row in table.rows if rest.startswith(f"{row.label}=")]
        name = max(labels, key=len, default=rest.partition("=")[0])  # a label may hold "="
        row, typed = row_named(name, table), rest[len(name) + 1 :]
        path = Path(with_home(typed)).absolute()
        is_there = path.is_file() if kind == "weights" else bool(typed) and path.is_dir()
        if not is_there:
            what = "file of weights" if kind == "weights" else "folder of label images"
            raise InputError(f"'{word}': expected {kind}.ROW=PATH with the path of a {what}.")
        if kind == "weights" and not row.network and row.experiment is None:
            raise InputError(f"'{word}': the row has no network; give predictions.ROW=FOLDER.")
        found[row.label] = ExternalRow(row.label, kind, path)
    return [found[row.label] for row in table.rows if row.label in found], others


def check_equal_runs(request: TableRequest, planner: Planner) -> None:
    """Refuse rows that are one run with the same scores, unless the table says so (`same_as`).

    Rows that cannot be composed or lack a checkout are left to the planning.
    """
    origin = _origins(request.table)
    counted = [column for column in request.table.columns if is_counted(column)]
    seen: dict[tuple[Any, ...], str] = {}
    for row in request.trained_rows:
        try:
            key = planner.specify((*planner.base, *request.overrides(row.label, 0))).key
        except InputError:
            continue
        metrics = [metric_of(column, row) for column in counted]
        same = seen.setdefault((key, *metrics), row.label)
        if origin[same] != origin[row.label]:
            raise InputError(
                f"the rows '{same}' and '{row.label}' of {request.name} would be the same run "
                f"({key}) at scale={request.scale}, form={request.form}; remove the override "
                f"that makes them equal, or write same_as: {same} in the table."
            )


def row_digests(request: TableRequest, planner: Planner) -> dict[str, str]:
    """Return the digest of the settings of every trained row, without what was typed for all.

    By it a report knows whether a row is the one of today, without composing the words of a run. It
    is recorded with these words alone: without them there are no digests.
    """
    if not request.deciding_words():
        return {}
    alone = replace(request, extra=(), pretrained={})
    rows = request.trained_rows
    return {row.label: planner.row_digest(alone.overrides(row.label, 0)) for row in rows}


def seed_of(overrides: Sequence[str]) -> int:
    """Return the seed of the overrides of a row, which end with it."""
    return int(overrides[-1].removeprefix("seed="))


def seeds_of(text: str) -> tuple[int, ...]:
    """Read the seeds of ``seeds=3`` (these are 0, 1, 2), ``seeds=0,4,7`` or ``seeds=[7]``."""
    words = text.strip("[]").split(",")
    if all(word.strip().isdecimal() for word in words):
        numbers = tuple(map(int, words))
        seeds = tuple(range(numbers[0])) if text.isdecimal() else numbers
        if seeds and len(set(seeds)) == len(seeds):
            return seeds
    raise InputError(
        f"seeds={text}: expected a number (3: seeds 0, 1, 2), a list of different seeds (0,4,7), "
        "confirm, or until_decided."
    )


def _origins(table: Table) -> dict[str, str]:
    origin: dict[str, str] = {}
    for row in table.rows:
        same = row.same_as or row.label  # perhaps a row that was not selected
        origin[row.label] = origin.get(same, same)
    return origin


def _model_of(overrides: Sequence[str]) -> str:
    named = [word.partition("=")[2] for word in overrides if word.startswith("model=")]
    return named[-1] if named else ""
