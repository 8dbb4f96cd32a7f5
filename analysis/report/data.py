"""What the page shows, as plain data, read once from the store.

Scores are in percent, `Var` in squared percent points, times in seconds. None: there is no value.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

from rgbt.runs.run_spec import NOT_IN_KEY

Uncertainty = Literal["images", "seeds", "images and seeds", "none"]
VerdictWord = Literal["holds", "contradicted", "undecided", "not run"]
ShownForm = Literal["paper", "released", "both"]
"""Rows as the text of the paper describes them, as its release made them, or both."""


@dataclass(frozen=True, kw_only=True)
class RunEntry:
    """One run: what a click on any of its numbers shows.

    Attributes:
        status: "FINISHED", "RUNNING", "FAILED" or "KILLED".
        scale: "demo", "bench" or "paper".
        group: what seeds of one method share, or "".
        studies: names of the studies that the run is part of.
        table_rows: table -> row that the run belongs to.
        split: that the scores are of.
        partition: e.g. "ring5".
        classes: K names.
        unscored: those of them that are left out of means.
        notes: about absent classes.
        scores: by name of the metric (`rgbt.metrics.names`).
        region_ious: R values, region 1 first.
        class_region_ious: K rows of R values.
        commit: git commit, "+" after it for uncommitted changes, or "".
        started: ISO 8601, UTC.
        seconds: from its start to its end, without the further evaluations of tables.
        resumed: whether several processes worked on it, so that `seconds` contains pauses.
        command: as typed.
        repeat: command that makes the run again.
        dataset: fingerprint of the data set.
        config: dotted key -> value as text.
        hardware: GPUs, else processor and cores; without the name of the machine.
        versions: of Python and of the packages that decide the numbers.
    """

    key: str
    name: str
    run_id: str
    status: str
    experiment: str
    scale: str
    seed: int | None
    group: str
    studies: tuple[str, ...]
    table_rows: Mapping[str, str]
    split: str = "test"
    partition: str = ""
    classes: tuple[str, ...] = ()
    unscored: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    scores: Mapping[str, float]
    region_ious: tuple[float, ...] = ()
    class_region_ious: tuple[tuple[float, ...], ...] = ()
    images: int = 0
    commit: str
    started: str
    seconds: float | None
    command: str
    repeat: str
    host: str
    dataset: str
    config: Mapping[str, str]
    hardware: str = ""
    resumed: bool = False
    versions: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class CellEntry:
    """One cell of a table.

    Attributes:
        mean: over seeds.
        sd: over seeds (n - 1).
        low: lower end of the 95 % interval of the mean, `high` its upper end.
        covers: what the interval is over.
        difference: mean minus published.
        reason: why there is no value, or seeds are missing.
        rank: 1 shown to be better than all other rows of ours, 2 than all but the first, else 0.
        values: of each run, in the order of `runs`; empty: not known. Shown beside the run.
    """

    mean: float | None = None
    sd: float | None = None
    seeds: int = 0
    low: float | None = None
    high: float | None = None
    covers: Uncertainty = "none"
    published: float | None = None
    difference: float | None = None
    reason: str = ""
    runs: tuple[str, ...] = ()
    rank: int = 0
    values: tuple[float | None, ...] = ()


@dataclass(frozen=True, kw_only=True)
class ClaimEntry:
    """A statement of a paper about its own table, with the verdict of our runs.

    Attributes:
        name: unique in the table.
        says: the statement in our words.
        source: its place in the paper.
        verdict: "not run" where a row that it needs has no score.
        contrast: the rows and the column whose numbers are shown, such as "Ny - baseline, Var".
        estimate: the contrast, mean over paired seeds.
        low: lower end of its 95 % interval, `high` its upper end.
        covers: what the interval is over.
        printed: the same contrast of the printed values.
        as_printed: whether the printed values agree with the statement; None: some are missing.
        smallest: the smallest difference that these seeds and images could have shown.
        seeds: paired seeds; 0 where nothing has seeds.
        seeds_needed: with which the present estimate would be decided; inf: no number of seeds.
        missing: rows without a finished run.
        reason: why it is undecided or not run; one sentence, or "".
        runs: keys of the runs of its rows.
    """

    name: str
    says: str
    source: str
    remarks: tuple[str, ...] = ()
    verdict: VerdictWord
    contrast: str
    estimate: float | None = None
    low: float | None = None
    high: float | None = None
    covers: Uncertainty = "none"
    printed: float | None = None
    as_printed: bool | None = None
    smallest: float | None = None
    seeds: int = 0
    seeds_needed: float | None = None
    missing: tuple[str, ...] = ()
    reason: str = ""
    runs: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True)
class FormsEntry:
    """Differences of the forms of a table, as text: released less paper, by row and column."""

    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


@dataclass(frozen=True, kw_only=True)
class TableEntry:
    """One table, ours beside the paper.

    Attributes:
        name: e.g. "spatialseg/table3"; `number` as printed.
        scale: "demo", "bench" or "paper"; "" where nothing was run yet.
        data: what the printed values were measured on.
        best: by column, "highest", "lowest" or "none".
        proposed: by row, whether it is the method that the paper proposes.
        cells: by row, then by column.
        extra: further words of the command as typed, or "": the rows that were selected, and
            overrides of every row.
        form: what the rows of ours are run as.
        claims: of the paper about this table.
        forms: differences of the forms where both were run; else None.
    """

    name: str
    paper: str
    number: str
    caption: str
    scale: str
    data: str
    unit: str
    columns: tuple[str, ...]
    best: tuple[str, ...]
    rows: tuple[str, ...]
    proposed: tuple[bool, ...]
    cells: tuple[tuple[CellEntry, ...], ...]
    notes: tuple[str, ...]
    command: str
    extra: str = ""
    form: ShownForm = "paper"
    claims: tuple[ClaimEntry, ...] = ()
    forms: FormsEntry | None = None

    @property
    def at_paper_scale(self) -> bool:
        """Whether values may be compared with the printed ones; also where nothing was run."""
        return self.scale in ("", "paper")


@dataclass(frozen=True, kw_only=True)
class TrialEntry:
    """One trial of a study.

    Attributes:
        number: from 0.
        state: "complete", "pruned", "failed", "running" or "waiting".
        params: name -> value as text.
        values: of the objectives; () where it is not complete.
        on_front: whether no other trial dominates it.
    """

    number: int
    state: str
    params: Mapping[str, str]
    values: tuple[float, ...]
    on_front: bool
    runs: tuple[str, ...]


@dataclass(frozen=True, kw_only=True)
class StudyEntry:
    """One search, grid or list.

    Attributes:
        kind: "search", "grid" or "list".
        maximize: whether more is better, by objective.
        note: its report in Markdown.
        command: that created it, or "".
    """

    name: str
    kind: str
    objectives: tuple[str, ...]
    maximize: tuple[bool, ...]
    trials: tuple[TrialEntry, ...]
    note: str
    command: str


@dataclass(frozen=True, kw_only=True)
class DifferenceEntry:
    """A difference between paper and release, and its effect where the store has both.

    Attributes:
        paper: setting and sentence, as `released`.
        source: paper section, equation or table.
        effect: sentence with the paired difference and its interval, or why there is none.
        runs: keys of the runs behind it.
    """

    topic: str
    paper: str
    released: str
    source: str
    effect: str
    runs: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True)
class ContrastEntry:
    """Two methods compared in one score; the score of `method` less that of `reference`.

    Attributes:
        question: what is compared, in words.
        source: table or section of the paper, or that it is not in one.
        reference: group of the runs that are compared against.
        method: group of the other runs.
        scale: "demo", "bench" or "paper"; "" where the runs are missing.
        values: mean over seeds of the reference and of the method.
        seeds: of the reference and of the method.
        low: lower end of the 95 % interval of the difference, `high` its upper end.
        p: of the difference.
        verdict: one sentence about `expected`, or which runs are missing.
        command: that compares the same runs.
    """

    question: str
    source: str
    reference: str
    method: str
    metric: str
    expected: str
    scale: str = ""
    values: tuple[float, float] | None = None
    seeds: tuple[int, int] = (0, 0)
    difference: float | None = None
    low: float | None = None
    high: float | None = None
    covers: Uncertainty = "none"
    p: float | None = None
    verdict: str
    command: str


@dataclass(frozen=True, kw_only=True)
class PagePicture:
    """A picture inside the page: title, caption, data address ("data:image/png;base64,...")."""

    title: str
    caption: str
    address: str
    width: int
    height: int


@dataclass(frozen=True, kw_only=True)
class ReportData:
    """Everything on the page.

    Attributes:
        made: ISO 8601, UTC.
        store: address of the store, passwords hidden.
        runs: newest first.
        tables: those with runs first, then those that wait.
        remarks: what could not be read, one sentence each.
        contrasts: declared comparisons, see `analysis.report.contrasts`.
        silent: configuration keys (with all below them) in which runs that are the same run may
            differ: paths, labels, hardware.
    """

    title: str
    made: str
    store: str
    command: str
    runs: tuple[RunEntry, ...]
    tables: tuple[TableEntry, ...]
    studies: tuple[StudyEntry, ...]
    masks: tuple[PagePicture, ...]
    differences: tuple[DifferenceEntry, ...]
    remarks: tuple[str, ...] = field(default=())
    contrasts: tuple[ContrastEntry, ...] = ()
    silent: tuple[str, ...] = NOT_IN_KEY
