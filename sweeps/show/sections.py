"""Parts of the pages of results as Markdown: tables, papers, runs, networks."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from rgbt.checks import InputError, one_line
from rgbt.config.compose import DEFAULT_SCALE
from rgbt.metrics import names
from rgbt.metrics.named import value
from rgbt.runs.folder import GROUP, SEED
from rgbt.runs.provenance import commit_of, without_passwords
from rgbt.runs.result import RunResult
from rgbt.tables import ABSENT, TextTable, number
from sweeps.judge.agreement import signs_of
from sweeps.judge.effects import effects_of
from sweeps.judge.judged_claim import NOT_RUN
from sweeps.judge.judged_table import JudgedTable
from sweeps.plan.request import TAG
from sweeps.run.progress import duration
from sweeps.score.efficiency import million_parameters
from sweeps.score.reader import RunReader
from sweeps.show.agreement import agreement_lines, forest_of
from sweeps.show.claims import claim_grids, claim_lines, claims_frame, counted
from sweeps.show.effects import effects_grids
from sweeps.show.publish import drawn_of, grid_of

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

STUDIES = "studies"
METRICS = (names.MIOU, names.VAR)
PACKAGES = ("torch", "numpy", "hydra-core", "lightning-fabric", "opencv-python-headless")
# A path from the root of a machine; addresses of pages and relative paths do not match.
ABSOLUTE = re.compile(r"(?<![\w.:/)\]])/(?:[\w.+@%~-]+/)+([\w.+@%~-]*)")
# The override that chooses the fold of a seed (`sweeps.plan.table.Table.of_fold`).
FOLD = re.compile(r"( dataset=\w+?)_fold\d+(?= |$)")
# Errors that a record may raise that somebody has edited.
ODD = (InputError, OSError, KeyError, ValueError, TypeError, AttributeError)


class TableSection:
    """A judged table as a section of a page; texts are Markdown.

    Attributes:
        page: the folder of its file; all studies of ours have one.
        is_run: whether it has a finished run.
        is_printed: whether it has no run because none of its rows can be run; then its grid has the
            published values alone.
        frame: its claims (`claims_frame`), `counted` by verdict in a sentence, and as `claims`.
        grids: the table, then the effects of its design.
        drawn: its figure, and `figure` the name of its file; None, and "", without one.
        command: what runs it.
    """

    def __init__(self, judged: JudgedTable) -> None:
        request = judged.request
        folder, slash, _ = request.name.partition("/")
        self.judged, self.is_run = judged, bool(judged.runs)
        self.is_printed = not self.is_run and not request.table.runnable_rows
        self.page = folder if slash else STUDIES
        form = "released form" if request.form == "released" else ""
        words = shlex.join(request.extra)
        self.title = request.table.number if slash else request.name
        if self.is_run:
            self.title += f" ({_joined(f'scale={request.scale}', form, words)})"
        self.caption = request.table.caption.rstrip(".") + "."
        self.frame = claims_frame(judged.claims, _joined(form, words))
        self.counted = counted(self.frame)
        self.claims = "\n".join(claim_lines(self.frame))
        self.command = _command_of(judged)
        self.grids: list[str] = []
        self.drawn: Figure | None = None
        self.figure = ""
        if self.is_run:
            self._show(*effects_of(judged))
        elif self.is_printed:
            self.grids = [markdown(replace(grid_of(judged, "markdown"), title=""))]

    def _show(self, effects: pd.DataFrame, lacking: Sequence[str]) -> None:
        """Set the grids and the figure of a table that was run."""
        judged, request = self.judged, self.judged.request
        grids = [replace(grid_of(judged, "markdown"), title="")]
        if request.table.design is not None:
            grids += effects_grids(effects, lacking, request.table.design)
        self.grids = [markdown(grid) for grid in grids]
        if len({label for label, _ in judged.runs}) > 1:  # one row compares nothing
            self.drawn = drawn_of(judged, effects)
        if self.drawn is not None:
            self.figure = f"{request.name.replace('/', '-')}_{request.variant}.svg"


def _joined(*parts: str) -> str:
    return ", ".join(part for part in parts if part)


def _command_of(judged: JudgedTable) -> str:
    """The command that runs what a table lacks."""
    request, seeds = judged.request, judged.scored.seeds
    typed = "3"
    if seeds:
        is_first = seeds == tuple(range(len(seeds)))
        typed = str(len(seeds)) if is_first else ",".join(map(str, seeds))
    words = [f"table={request.name}", f"seeds={typed}"]
    if request.scale != DEFAULT_SCALE:
        words.append(f"scale={request.scale}")
    if request.form != "paper":
        words.append(f"form={request.form}")
    return shlex.join(["rgbt", "reproduce", *words, *request.extra])


def paper_section(
    name: str,
    title: str,
    reference: str,
    tables: Sequence[TableSection],
    contrasts: pd.DataFrame,
    ranks: pd.DataFrame,
) -> dict[str, Any]:
    """Return what the template shows of a page of tables: of a paper, of ours, or of the user.

    Its contrasts and ranks (`sweeps.judge.agreement`) become one picture, and a sentence.
    """
    own = [table for table in tables if table.page == name]
    frame = claims_of(own)
    is_run = frame["verdict"] != NOT_RUN
    of_paper = contrasts[contrasts["paper"] == name]
    own_ranks = ranks[ranks["table"].isin([table.judged.request.name for table in own])]
    forest = forest_of(of_paper, title)
    of_tables = frame["table"].str.split("/").str[-1]
    lines = "- " + of_tables + ", `" + frame["claim"] + "`: " + frame["says"]
    return {
        "name": name,
        "title": title,
        "reference": reference,
        "tables": own,
        "printed": all(table.is_printed for table in own),
        "counted": counted(frame),
        "judged": [markdown(grid) for grid in claim_grids(frame[is_run])],
        "not_run": "\n".join(lines[~is_run]),
        "agreement": agreement_lines(signs_of(of_paper), own_ranks),
        "forest": forest,
        "picture": f"{name}_contrasts.svg" if forest is not None else "",
    }


def markdown(grid: TextTable) -> str:
    """Return a grid in Markdown; "" for one without rows."""
    return grid.to_markdown().rstrip() if grid.rows else ""


def claims_of(tables: Sequence[TableSection]) -> pd.DataFrame:
    """Return the claims of all these tables, once for every way that they were run."""
    import pandas as pd

    frames = [table.frame for table in tables if len(table.frame)]
    return pd.concat(frames, ignore_index=True) if frames else claims_frame(())


def runs_section(
    runs: Sequence[RunResult], reader: RunReader, remarks: list[str]
) -> dict[str, Any]:
    """Return the runs by method and where they come from; a damaged one becomes a remark.

    Returns:
        "runs": one grid for each kind of images and scale; "origin": the versions and machines.
    """
    import pandas as pd

    rows, facts = [], []
    for run in runs:
        try:
            row, origin = _scores(run, reader), _origin(run)
        except ODD as error:
            remarks.append(f"Run {run.key} is left out: {one_line(error)}.")
        else:
            rows.append(row)
            facts.append(origin)
    if not rows:
        return {"runs": [], "origin": ""}
    grids = []
    for (images, scale), kind in pd.DataFrame(rows).groupby(["images", "scale"]):
        grids.append(_runs_of_kind(str(images), str(scale), kind))
    lines = []
    for name, column in pd.DataFrame(facts).items():
        texts = sorted(set(column.dropna()) - {""})
        lines.append((str(name), ", ".join(texts) or ABSENT))
    return {"runs": grids, "origin": markdown(TextTable("", ("what", "value"), tuple(lines)))}


def _scores(run: RunResult, reader: RunReader) -> dict[str, Any]:
    """The method, seed, scores, time and tables of a run."""
    tags, counts, origin = run.tags, reader.counts(run, ()), reader.origin(run)
    tables = [tag.removeprefix(TAG) for tag in tags if tag.startswith(TAG)]
    group = tags.get(GROUP, run.key)
    method = FOLD.sub(r"\1", group)
    return {
        "method": method,
        "dataset": counts.dataset if method == group else "",  # its folds are seeds of a method
        "images": origin.images,
        "scale": origin.scale,
        "seed": int(tags[SEED]),
        **{name: value(name, counts, counts.absent) for name in METRICS},
        "time": float(run.result["seconds_of_last_process"]),
        "tables": sorted(tables),
    }


def _origin(run: RunResult) -> dict[str, str | None]:
    """The code, the versions and the machine of a run."""
    first = next(iter(run.provenance), {})
    packages, gpus = first.get("packages") or {}, ", ".join(first.get("gpus") or [])
    return {
        "git commit": commit_of(first),
        "Python": first.get("python"),
        **{name: packages.get(name) for name in PACKAGES},
        "hardware": gpus or f"{first['cpu']}, {first['cpu_usable']} cores",
    }


def _runs_of_kind(images: str, scale: str, runs: pd.DataFrame) -> str:
    """The runs on one kind of images at one scale, a line for each method and data set."""
    named, shared = short_names(runs["method"])
    lines = []
    for (method, _), group in runs.groupby(["method", "dataset"]):
        seeds = ", ".join(map(str, sorted(group["seed"])))
        scores = []
        for name in METRICS:
            spread = f" ± {number(group[name].std())}" if len(group) > 1 else ""
            scores.append(f"{number(group[name].mean())}{spread}")
        tables = dict.fromkeys(group["tables"].explode().dropna())
        time = duration(group["time"].median())
        lines.append((f"`{named[method]}`", seeds, *scores, time, "; ".join(tables)))
    header = ("method", "seeds", *METRICS, "time", "rows of")
    hours = duration(runs["time"].sum())
    title = f"{number_of(len(runs), 'run')} on {images}, scale={scale}, {hours} in all"
    grid = markdown(TextTable(title, header, tuple(lines)))
    common = " ".join(word for word in shared if word != f"scale={scale}")
    return f"{grid}\n\nAll of them with `{common}`." if common else grid


def short_names(methods: Iterable[str]) -> tuple[dict[str, str], list[str]]:
    """Return names of methods without the overrides that all of them have, and these."""
    words = {method: method.split() for method in methods}
    first = next(iter(words.values()))
    shared = [word for word in first[1:] if all(word in others for others in words.values())]
    named = {}
    for method, of_method in words.items():
        named[method] = " ".join(word for word in of_method if word not in shared)
    return named, shared


def public(text: str) -> str:
    """Return a text without passwords, and with the last part alone of absolute paths."""
    return ABSOLUTE.sub(r".../\1", without_passwords(text))


def number_of(count: int, noun: str) -> str:
    """Write "1 run", "2 runs"."""
    return f"{count} {noun}{'s' * (count != 1)}"


def networks_section(networks: Sequence[Mapping[str, Any]]) -> dict[str, str]:
    """Return the grids of the page of networks, which are built without memory to be counted."""
    sizes, weights, tests = [], [], []
    for network in networks:
        name = network["name"]
        for model in network["models"]:
            words = (*network.get("overrides", ()), *f"model={model}".split())
            sizes.append((name, f"`model={model}`", f"{million_parameters(words):.2f}"))
        for file, address in network["weights"]:
            weights.append((name, file, f"<{address}>"))
        tests.append((name, ", ".join(f"`{test}`" for test in network["tests"])))
    header = ("network", "configuration", "million parameters")
    return {
        "networks": markdown(TextTable("", header, tuple(sizes))),
        "weights": markdown(TextTable("", ("network", "file", "published at"), tuple(weights))),
        "tests": markdown(TextTable("", ("network", "test"), tuple(tests))),
    }
