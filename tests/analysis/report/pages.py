"""A realistic store for the tests of the page: 60 runs, 25 tables, 2 studies.

Captions, rows and printed values are the papers' (sweeps/tables); scores are drawn around those of
real runs at demo scale.
"""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import cv2
import numpy as np

from analysis.report.data import (
    CellEntry,
    ClaimEntry,
    DifferenceEntry,
    PagePicture,
    ReportData,
    RunEntry,
    StudyEntry,
    TableEntry,
    TrialEntry,
    VerdictWord,
)
from analysis.report.studies import pareto_front
from rgbt.randomness import numpy_generator
from sweeps.table.load_table import load_table, table_names
from sweeps.table.table import Table

CLASSES = ("unlabeled", "car", "person", "bike", "curve", "car_stop", "guardrail", "cone", "bump")
PROFILE = np.array([43.0, 48.6, 52.6, 50.5, 44.6])
SEEDS = (0, 1, 2)
RUN_TABLES = ("spatialseg/table3", "spatialseg/table4", "spatialseg/table5", "spatialseg/table6")
"""Their 20 rows have three runs each."""

LUCKY = 5
"""Of these rows the one with the highest mIoU; two of its three runs stand behind it."""

ALSO = {"crm/table3a": 2, "spatialseg/table7": 3, "multihead/table2": 2}
"""Tables of which the last rows are run: with one column, with 18, with three."""

CONFIG = {
    **{f"recipe.option_{number}": f"value {number % 7}" for number in range(90)},
    "masker.patch_size": "16",
    "masker.sigma_div": "4",
    "recipe.demo_steps": "240",
}


def run_entry(row: int, seed: int, table: str = "spatialseg/table3", label: str = "Ny") -> RunEntry:
    """A finished run of row number `row` (over all tables), whose scores lie around real ones."""
    rng = numpy_generator(seed, "report", row)
    key = hashlib.sha256(f"{row} {seed}".encode()).hexdigest()[:12]
    group = f"grbm scale=demo sigma_div={2**row}" if row else "crm scale=demo"
    ious = PROFILE + rng.normal(0, 1.4) + rng.normal(0, 0.7, 5)
    by_class = ious + rng.normal(0, 4, (len(CLASSES), 1)) + rng.normal(0, 2, (len(CLASSES), 5))
    experiment = "grbm" if row else "crm"
    scores = {"mIoU": ious.mean() + 0.9, "Var": ious.var(), "mAcc": ious.mean() + 13.2}
    scores |= {f"region/{index + 1}": value for index, value in enumerate(ious)}
    scores |= {f"class/{name}": by_class[k].mean() for k, name in enumerate(CLASSES)}
    override = f" masker.sigma_div={2**row}" if row else ""
    repeat = f"python -m rgbt.run +experiment={experiment} scale=demo{override} seed={seed}"
    return RunEntry(
        key=key,
        name=f"{group} seed={seed}",
        run_id=hashlib.md5(key.encode()).hexdigest(),
        status="FINISHED",
        experiment=experiment,
        scale="demo",
        seed=seed,
        group=group,
        studies=(),
        table_rows={table: label},
        split="test",
        partition="ring5",
        classes=CLASSES,
        scores={name: float(value) for name, value in scores.items()},
        region_ious=tuple(map(float, ious)),
        class_region_ious=tuple(tuple(map(float, values)) for values in by_class),
        images=100,
        commit=["44fd6f73f3070b382b58382b53cbf41db941fbd8+", "c3870df37d" * 4][row % 2],
        started=f"2026-11-{21 - row // 8:02d}T{23 - row:02d}:{10 + seed}:01+00:00",
        seconds=184.3 + 20 * seed,
        command=f"/home/user/rgbt/.venv/bin/python -m rgbt.run scale=demo runs_dir=/tmp/t3 "
        f"+experiment={experiment}{override} seed={seed}",
        repeat=f"git checkout 44fd6f73f3 && {repeat}",
        host="lab-2 (2 CPU cores, Intel Xeon 2.60 GHz)",
        dataset="78cbf1ddd753b67c49173ac5a9abb553871db73aa2c8c91d5c0ba03277a9c51b",
        config={
            **CONFIG,
            "masker.sigma_div": str(2**row) if row else "None",
            "seed": str(seed),
            "recipe.demo_steps": str(240 + row),
            "runs_dir": f"/data/{row}",
        },
    )


def ranks(values: Sequence[float | None], best: str) -> list[int]:
    """1 for the best, 2 for the second best, 0 for others."""
    if best == "none":
        return [0] * len(values)
    there = sorted({v for v in values if v is not None}, reverse=best == "highest")[:2]
    return [there.index(value) + 1 if value in there else 0 for value in values]


def cell(values: Sequence[float], keys: Sequence[str], printed: float | None) -> CellEntry:
    """Mean over seeds with an interval of a width that depends on the values' spread."""
    mean, sd = float(np.mean(values)), float(np.std(values, ddof=1))
    return CellEntry(
        mean=mean,
        sd=sd,
        seeds=len(values),
        low=mean - 1.2 - sd,
        high=mean + 1.1 + sd,
        covers="images and seeds",
        published=printed,
        difference=None if printed is None else mean - printed,
        reason="" if len(values) == len(SEEDS) else "2 of 3 seeds: seed 2 failed at step 113.",
        runs=tuple(keys),
        values=tuple(values),
    )


def _value(run: RunEntry, column: str, printed: float | None, rng: np.random.Generator) -> float:
    named = column.replace("IoU", "region/") if column[:3] == "IoU" else column
    known = run.scores.get(named)
    return float((printed or 40.0) - 11 + rng.normal(0, 1)) if known is None else known


def table_entry(name: str, runs_by_row: dict[int, list[RunEntry]]) -> TableEntry:
    """A published table with runs behind some of its rows."""
    table = load_table(name)
    rng = numpy_generator(0, name)
    rows = [
        [
            _cell_of(table, row, column, runs_by_row.get(row, []), rng)
            for column in range(len(table.columns))
        ]
        for row in range(len(table.rows))
    ]
    for index, column in enumerate(table.columns):
        whole = [row[index].mean if row[index].seeds == len(SEEDS) else None for row in rows]
        ours = ranks(whole, column.best)
        for row, rank in zip(rows, ours, strict=True):
            row[index] = replace(row[index], rank=rank)
    notes = [
        *table.remarks,
        *(f"{row.label}: {note}" for row in table.rows for note in row.remarks),
    ]
    return TableEntry(
        name=name,
        paper=table.paper,
        number=table.number,
        caption=table.caption,
        scale="demo" if runs_by_row else "",
        data=table.data,
        unit=table.unit,
        columns=tuple(column.name for column in table.columns),
        best=tuple(column.best for column in table.columns),
        rows=tuple(row.label for row in table.rows),
        proposed=tuple(row.proposed for row in table.rows),
        cells=tuple(tuple(row) for row in rows),
        notes=tuple(notes),
        command=f"rgbt reproduce table={name} scale=demo seeds=0,1,2",
    )


def claim(name: str, verdict: VerdictWord, **others: Any) -> ClaimEntry:
    """A claim about the first table; one with a verdict has numbers."""
    numbers: dict[str, Any] = {}
    if verdict != "not run":
        numbers = {"estimate": -1.25, "low": -3.5, "high": 1.0, "covers": "images and seeds"}
        numbers |= {"smallest": 2.25, "seeds": 3, "seeds_needed": 12.0}
    given = {
        "says": f"The statement called {name}.",
        "source": "Sec. V-C1, second paragraph",
        "contrast": "Ny/4 - CRM baseline, Var",
        "printed": -2.47,
        "as_printed": True,
    }
    return ClaimEntry(name=name, verdict=verdict, **{**numbers, **given, **others})


def claims(table: TableEntry) -> tuple[ClaimEntry, ...]:
    """One claim of each verdict; in a table without runs one that is not run."""
    waiting = claim(
        "waiting", "not run", as_printed=False, missing=table.rows[:1], reason="row has no run."
    )
    if not table.scale:
        return (waiting,)
    keys = table.cells[-1][0].runs
    return (
        claim("true", "holds", runs=keys, low=-2.0, high=-0.5),
        claim("false", "contradicted", runs=keys, remarks=("A reading of ours.",)),
        claim("open", "undecided", runs=keys, reason="Below 2.25, nothing can be shown."),
        waiting,
    )


def _cell_of(
    table: Table, row: int, column: int, runs: list[RunEntry], rng: np.random.Generator
) -> CellEntry:
    name = table.columns[column].name
    printed = table.rows[row].values.get(name)
    if not runs:
        reason = "Not run yet." if table.rows[row].experiment else ""
        return CellEntry(published=printed, reason=reason)
    return cell([_value(run, name, printed, rng) for run in runs], [r.key for r in runs], printed)


def search(runs: Sequence[RunEntry]) -> StudyEntry:
    """A search with two objectives: 40 trials, of which 5 were pruned and one failed."""
    rng = numpy_generator(0, "search")
    states = ["pruned" if n % 8 == 7 else "failed" if n == 12 else "complete" for n in range(40)]
    points = [
        (float(rng.normal(49, 1.2)), float(rng.gamma(8, 1.6))) if state == "complete" else ()
        for state in states
    ]
    front = pareto_front(points, (True, False))
    trials = [
        TrialEntry(
            number=number,
            state=state,
            params={
                "masker.sigma_div": str(2 ** int(rng.integers(0, 6))),
                "optimizer.lr": f"{10 ** rng.uniform(-4, -2):.3g}",
            },
            values=point,
            on_front=number in front,
            runs=tuple(run.key for run in runs[number % 20 : number % 20 + 2]),
        )
        for number, (point, state) in enumerate(zip(points, states, strict=True))
    ]
    note = (
        "# Study masks\n\nKind: search. Objectives: highest `val/mIoU`, lowest `val/Var`.\n\n"
        "**Importance of the parameters**\n\n| parameter | for val/mIoU, % | for val/Var, % |\n"
        "| --- | ---: | ---: |\n| masker.sigma_div | 61.20 | 48.11 |\n| optimizer.lr | 30.0 | 9.7 |"
        "\n\n- rough: 34 complete trials, 50 are recommended.\n"
    )
    names = {"objectives": ("val/mIoU", "val/Var"), "maximize": (True, False)}
    command = "python -m rgbt.run -m +search=grbm"
    return StudyEntry(
        name="masks", kind="search", **names, trials=tuple(trials), note=note, command=command
    )


def grid(runs: Sequence[RunEntry]) -> StudyEntry:
    """A grid of 12 points with one objective."""
    best = max(runs[:12], key=lambda run: run.scores["mIoU"])
    trials = [
        TrialEntry(
            number=number,
            state="complete",
            params={"masker.patch_size": str(8 * 2 ** (number % 4)), "seed": str(number // 4)},
            values=(run.scores["mIoU"],),
            on_front=run is best,
            runs=(run.key,),
        )
        for number, run in enumerate(runs[:12])
    ]
    names = {"objectives": ("mIoU",), "maximize": (True,), "note": "", "command": "rgbt run -m"}
    return StudyEntry(name="patch-size/grid", kind="grid", trials=tuple(trials), **names)


def mask(patch: int) -> PagePicture:
    """A mask of random square patches, as CRM Fig. 5 shows."""
    cells = numpy_generator(0, "mask", patch).random((120 // patch + 1, 160 // patch + 1)) < 0.5
    image = np.kron(cells, np.ones((patch, patch)))[:120, :160].astype(np.uint8) * 255
    png = base64.b64encode(cv2.imencode(".png", image)[1].tobytes()).decode()
    return PagePicture(
        title=f"Patches of {patch} pixels",
        caption="Half of the cells are masked in RGB, the others in thermal.",
        address=f"data:image/png;base64,{png}",
        width=160,
        height=120,
    )


DIFFERENCES = (
    DifferenceEntry(
        topic="GRBM cells",
        paper="masker.cell_position=centre: the distance of a cell is that of its centre.",
        released="masker.cell_position=corner: the distance of a cell is that of its corner.",
        source="SpatialSeg, Sec. IV-B, Eq. 7",
        effect="Released minus paper: mIoU +0.42 [-0.81, +1.66].",
    ),
    DifferenceEntry(
        topic="Absent classes",
        paper="A class without a pixel is left out of the mean.",
        released="It counts as 0.",
        source="SpatialSeg, Sec. V-A",
        effect="No two runs differ only in this setting.",
    ),
)


def report(num_rows: int = 20) -> ReportData:
    """The whole store; `num_rows` of at most 20 rows are run, with three seeds each."""
    names = [*RUN_TABLES, *(name for name in table_names() if name not in RUN_TABLES)]
    places = [(name, row) for name in RUN_TABLES for row in range(len(load_table(name).rows))]
    runs: list[RunEntry] = []
    behind: dict[str, dict[int, list[RunEntry]]] = {name: {} for name in names}
    for number, (name, row) in enumerate(places[:num_rows]):
        label = load_table(name).rows[row].label
        made = [run_entry(number, seed, name, label) for seed in SEEDS]
        if number == LUCKY:
            made = [replace(run, scores={**run.scores, "mIoU": 70.0 + run.seed}) for run in made]
        behind[name][row] = made[:2] if number == LUCKY else made
        runs += made
    for name, count in ALSO.items() if num_rows == len(places) else ():
        last = len(load_table(name).rows)
        behind[name] = {last - 1 - n: runs[3 * n : 3 * n + 3] for n in range(count)}
    if num_rows > 5:
        gone = {"scores": {}, "region_ious": (), "class_region_ious": (), "images": 0}
        runs[17] = replace(runs[17], status="FAILED", seconds=None, **gone)
    tables = [table_entry(name, behind[name]) for name in names]
    tables = [replace(table, claims=claims(table)) for table in tables]
    tables.sort(key=lambda table: not table.scale)
    return ReportData(
        title="RGB-thermal segmentation: what was run, beside the papers",
        made="2026-11-22T09:30:00+00:00",
        store="sqlite:////data/lab/runs/mlflow.db",
        command="rgbt report runs_dir=/data/lab/runs out=report/",
        runs=tuple(runs),
        tables=tuple(tables),
        studies=(search(runs), grid(runs)) if runs else (),
        masks=tuple(mask(patch) for patch in (8, 16, 32, 64)),
        differences=DIFFERENCES,
        remarks=("Run 0b1c2d3e4f50 has no counts_test.npz; its intervals are missing.",),
    )
